"""What is known of nodes never cuts a point off that has led to it, and cuts what it can."""

import casadi as ca
import mpmath as mp
import numpy as np
import pytest
from operations import FAR, TRIED, drawn, program_of, result

from obsynth.derive.intervals.rules import RULES
from obsynth.designs.core.backward import contract
from obsynth.designs.core.lifted import Lifted, Rounding


def code(program, ranges, rounding=None, known=()):
    """Contraction as a function of the ends of the variables and of every output.

    Returns lower ends, upper ends, whether something is empty. Exponents in `known` are numbers.
    """
    ends = [[ca.SX.sym("l"), ca.SX.sym("h")] for _ in ranges]
    told = [[ca.SX.sym("a"), ca.SX.sym("b")] for _ in program.outputs]
    variables = [
        Lifted.number(*r) if k in known else Lifted(*e, *r)
        for k, (e, r) in enumerate(zip(ends, ranges, strict=True))
    ]
    given = {node: Lifted(*pair) for node, pair in zip(program.outputs, told, strict=True)}
    cut, empty = contract(program, given, variables, rounding or Rounding())
    outputs = [*(v.lower for v in cut), *(v.upper for v in cut), empty]
    inputs = [e for pair in [*ends, *told] for e in pair]
    return ca.Function("f", inputs, [ca.SX(v) for v in outputs])


def run(function, boxes, told):
    """Rows of lower ends, of upper ends, and of what is empty."""
    given = [end[None, :] for box in [*boxes, *told] for end in box]
    found = [np.array(v).ravel() for v in function(*given)]
    n = len(boxes)
    return found[:n], found[n : 2 * n], found[-1]


def doubles(value):
    """The doubles around a number, and FAR for what is beyond."""
    near = float(value)
    low = near if mp.mpf(near) <= value else np.nextafter(near, -np.inf)
    high = near if mp.mpf(near) >= value else np.nextafter(near, np.inf)
    return np.array([max(low, -FAR), min(high, FAR)])


def lost(case, count=24, rounding=None, seed=0):
    """Return how many points of boxes are cut off by an interval around their value."""
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    ranges_tried, value = TRIED[case]
    outside = 0
    for ranges in ranges_tried:
        known = [k for k, r in enumerate(ranges) if r[0] == r[1]]
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.stack([np.minimum(*boxes)[0], np.maximum(*boxes)[1]])
        share = rng.choice([0.0, 1.0, 0.3, 0.8], (len(ranges), count))
        points = [np.clip(b[0] + s * (b[1] - b[0]), *b) for b, s in zip(boxes, share, strict=True)]
        told, exact = (
            np.zeros((2, count)),
            [result(value, [p[k] for p in points]) for k in range(count)],
        )
        for k, known_value in enumerate(exact):
            if known_value is not None:
                wide = rng.choice([0.0, 0.0, 1e-3, 1.0], 2) * (1.0 + abs(float(known_value)))
                told[:, k] = doubles(known_value) + wide * [-1.0, 1.0]
        program = program_of(op, int(number or 0), len(ranges))
        function = code(program, ranges, rounding, known)
        lower, upper, empty = run(function, boxes, [told])
        for k in range(count):
            if exact[k] is not None:
                inside = zip(lower, points, upper, strict=True)
                kept = all(a[k] <= p[k] <= b[k] for a, p, b in inside)
                outside += not kept or empty[k] != 0
    return outside


def test_every_operation_is_tried():
    assert {name.split()[0] for name in TRIED} == set(RULES)


@pytest.mark.parametrize("case", TRIED)
def test_no_point_is_lost(case):
    assert lost(case) == 0
