"""Numbers that depend on the precision of code, and stand for what has no bound."""

from typing import NamedTuple

FAR = 1e100
"""Numbers from which on a signal is not bounded at all, whatever the precision of code."""


class Limits(NamedTuple):
    """Numbers that a precision has room for, each small enough for products of three of the next.

    tiny: above what underflow takes
    far: ends of signals that are not bounded; the truth is not beyond
    finite: what is larger counts as no number; CasADi folds ``y == y`` to 1, so size is what tells
    huge: widths of sets from which on they say nothing; declared ranges are within
    largest: ends of nodes that are not bounded
    angle: from which on sine and cosine are not followed; functions of single precision give no
        number beyond
    """

    tiny: float
    far: float
    finite: float
    huge: float
    largest: float
    angle: float


LIMITS = {
    "double": Limits(2.0**-1021, FAR, 1e90, 1e50, FAR, 1e8),
    "single": Limits(2.0**-125, 2.0**40, 2.0**39, 2.0**36, 2.0**120, 6433.0),
}
