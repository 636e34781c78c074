"""Affine forms hold every value, with an error that is of second order where that is possible."""

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from operations import FAR, PRECISION, TRIED, drawn, points, program_of, result

from obsynth.designs.core.lifted import Lifted, Rounding
from obsynth.designs.core.relaxation import relax


def code(program, ranges, rounding=None, known=()):
    """Slopes, centre and error of every output as a function of the ends of the variables."""
    ends = [[ca.SX.sym("l"), ca.SX.sym("h")] for _ in ranges]
    variables = [
        Lifted.number(*r) if k in known else Lifted(*e, *r)
        for k, (e, r) in enumerate(zip(ends, ranges, strict=True))
    ]
    found = relax(program, program.outputs, variables, rounding or Rounding())
    zero = ca.SX(0)
    outputs = [
        part
        for a in found
        for part in (*(a.slopes.get(j, zero) for j in range(len(ranges))), a.centre, a.error)
    ]
    return ca.Function("f", [e for pair in ends for e in pair], [ca.SX(v) for v in outputs])


def run(function, boxes):
    """Slopes, centre, error of every output, rows of numbers."""
    return [np.array(v).ravel() for v in function(*[end[None, :] for box in boxes for end in box])]


def missed(case, count=12, rounding=None, seed=0):
    """Return how many values are further from their form than its error."""
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    tried, value = TRIED[case]
    outside = 0
    for ranges in tried:
        known = [k for k, r in enumerate(ranges) if r[0] == r[1]]
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.stack([np.minimum(*boxes)[0], np.maximum(*boxes)[1]])
        program = program_of(op, int(number or 0), len(ranges))
        *slopes, centre, error = run(code(program, ranges, rounding, known), boxes)
        assert not np.isnan([*slopes, centre, error]).any()
        for given in points(rng, boxes):
            for k in range(count):
                point = [g[k] for g in given]
                exact = result(value, point)
                if exact is not None and error[k] < FAR:
                    with mp.workprec(PRECISION):
                        terms = (
                            mp.mpf(s[k]) * mp.mpf(p) for s, p in zip(slopes, point, strict=True)
                        )
                        outside += abs(exact - sum(terms) - mp.mpf(centre[k])) > mp.mpf(error[k])
    return outside


@pytest.mark.parametrize("case", TRIED)
def test_no_value_is_missed(case):
    assert missed(case) == 0
