"""Which of a bank's filters is returned, called with numbers."""

import casadi as ca
import numpy as np
import pytest

from obsynth.designs.core.boxes import Ends
from obsynth.designs.filter_bank.step import telling


def told(*filters):
    """Intervals of two faults by every filter: those that are returned."""
    ends = [Ends(*(ca.SX(list(side)) for side in zip(*pair, strict=True))) for pair in filters]
    found = telling(ends)
    return np.array(ca.DM(ca.horzcat(found.lower, found.upper))).tolist()


SILENT, NEAR, FAR, BELOW, NO = (-1.0, 2.0), (0.1, 3.0), (0.5, 1.0), (-4.0, -0.6), (-0.2, 0.2)


@pytest.mark.parametrize(
    ("filters", "wanted"),
    [
        # a fault that the first filter shows is that filter's, however far others are
        ([NEAR, FAR, BELOW], NEAR),
        ([BELOW, FAR, NEAR], BELOW),
        # where it is silent, the one farthest from zero, in any order and of any sign
        ([SILENT, NEAR, FAR], FAR),
        ([SILENT, FAR, NEAR], FAR),
        ([SILENT, FAR, BELOW, NEAR], BELOW),
        ([SILENT, BELOW, NO], BELOW),
        # a zero at an end is silent
        ([(0.0, 2.0), NO, NEAR], NEAR),
        ([(-2.0, 0.0), NO, NEAR], NEAR),
        ([(0.0, 2.0), (0.0, 1.0)], (0.0, 2.0)),
        ([SILENT, NO, NO], SILENT),
    ],
)
def test_the_first_filter_or_the_one_farthest_from_zero(filters, wanted):
    """Fault by fault. Mutants: silence not asked, the nearest, the last, the first alone."""
    for other in (SILENT, FAR):
        pairs = [(f, other) for f in filters], [(other, f) for f in filters]
        assert told(*pairs[0]) == [list(wanted), list(other)]
        assert told(*pairs[1]) == [list(other), list(wanted)]
