"""The commands of ``obsynth``, a file per question; ``told`` prints for all of them."""
