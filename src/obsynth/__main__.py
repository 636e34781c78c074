"""``python -m obsynth`` is the command ``obsynth``."""

from obsynth.cli import main

if __name__ == "__main__":
    main()
