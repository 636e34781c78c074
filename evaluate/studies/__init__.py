"""Whole ways from equations to C on published examples, set against what was printed."""

from obsynth.evaluate.studies.quadruple_tank import RUN as RUN
from obsynth.evaluate.studies.quadruple_tank import QuadrupleTank as QuadrupleTank
from obsynth.evaluate.studies.quadruple_tank import quadruple_tank as quadruple_tank
