"""Plants ready to use, one file each."""

from obsynth.symbolic.plants.quadruple_tank import quadruple_tank

__all__ = ["quadruple_tank"]
