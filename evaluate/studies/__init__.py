"""Whole ways from equations to C on published examples, set against what was printed."""

from obsynth.evaluate.studies.quadruple_tank import RUN, QuadrupleTank, quadruple_tank

__all__ = ["RUN", "QuadrupleTank", "quadruple_tank"]
