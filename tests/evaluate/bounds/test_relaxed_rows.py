"""Every inequality of the linear program holds at every point of its boxes, in 400 bits.

Mistakes that are seen here: a plane of a product through the other corner, a tangent on the other
side, a chord through a middle, a chord or tangent without what rounding loses, a multiple of a
multiple with a rounded factor.
"""

import mpmath as mp
import numpy as np
import pytest
from operations import NEAR, PRECISION, TRIED, UP, drawn, points, result

from obsynth.derive.intervals.graph import Node, Schedule
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rules import NAMES, RULES
from obsynth.evaluate.bounds.relaxation import relax

NEGATIVE = {
    f"power_int {n}": ([(UP,), (NEAR,), ((-3.0, -0.5),)], lambda a, n=n: a**n) for n in (-1, -2, -3)
}
CASES = {name: case for name, case in (TRIED | NEGATIVE).items() if name != "with_zero"}


def ranges_of(program, boxes):
    """Intervals of all nodes, nothing known for nan."""
    nodes = range(len(program.nodes))
    stacked = np.stack(boxes) if boxes else np.empty((0, 2, 1))
    found = Schedule(program, nodes, nodes).run(stacked[:, 0], stacked[:, 1])
    ends = {k: found.of(k) for k in nodes}
    unknown = {k: np.isnan(low) | np.isnan(high) for k, (low, high) in ends.items()}
    return {
        k: (np.where(unknown[k], -np.inf, low), np.where(unknown[k], np.inf, high))
        for k, (low, high) in ends.items()
    }


def broken(rows, k, values):
    """Rows that exact values of nodes do not meet at a box; the values are rounded at 400 bits."""
    found = []
    for row in rows:
        if np.isfinite(row.right[k]):
            terms = [mp.mpf(f[k]) * values[n] for f, n in zip(row.factors, row.nodes, strict=True)]
            terms.append(-mp.mpf(row.right[k]))
            lost = sum(map(abs, terms)) * mp.mpf(2) ** (20 - PRECISION)
            if sum(terms) > lost or (row.equal and sum(terms) < -lost):
                found.append(row)
    return found


def missed(case, count=12, seed=0):
    """Return how many values are outside of some row, and how many rows say something."""
    rng = np.random.default_rng(seed)
    op, _, number = case.partition(" ")
    tried, value = CASES[case]
    outside = said = 0
    for ranges in tried[:: 1 + len(tried) // 12]:
        boxes = [drawn(rng, r, count) for r in ranges]
        if op == "meet":
            boxes[1] = np.stack([np.minimum(*boxes)[0], np.maximum(*boxes)[1]])
        program = Program(n_variables=len(ranges))
        args = [program.variable(k) for k in range(len(ranges))]
        if op == "power_const":
            args[1] = program.number(*ranges[1])
        node = program.append(Node(op, tuple(args), int(number or 0)))
        known = ranges_of(program, boxes)
        rows = relax(program, [node], known)
        said += sum(int(np.isfinite(row.right).sum()) for row in rows)
        for given in points(rng, boxes):
            for k in range(count):
                point = [g[k] for g in given]
                exact = result(value, point)
                if exact is not None:
                    with mp.workprec(PRECISION):
                        values = {a: mp.mpf(float(v)) for a, v in zip(args, point, strict=True)}
                        outside += len(broken(rows, k, values | {node: exact}))
    return outside, said


@pytest.mark.parametrize("case", CASES)
def test_no_value_is_cut_off(case):
    outside, said = missed(case)
    assert outside == 0
    jumps = {
        "sign",
        "floor",
        "ceiling",
        "less",
        "less_equal",
        "equal",
        "logical_not",
        "disjunction",
    }
    jumps |= {"conjunction", "copysign", "boundary_weight", "select", "if_else_zero", "remainder"}
    without = jumps | {"power", "hypotenuse", "arctangent2", "meet"}
    assert said or case in without


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_no_value_is_cut_off_by_many(case):
    assert not any(missed(case, 60, seed)[0] for seed in range(1, 6))


def test_every_operation_is_tried():
    rewritten = {"square", "inverse", "not_equal", "assign", "with_zero", "power_int"}
    assert (
        set(NAMES.values()) | set(RULES) <= {case.partition(" ")[0] for case in CASES} | rewritten
    )


def test_multiples_of_products():
    """Factors 2^27 + 1 and 2^27 - 1, in parts of 24 bits: their product rounds to 2^54."""
    program = Program(n_variables=3)
    x, y, z = (program.variable(k) for k in range(3))
    boxes = [drawn(np.random.default_rng(k), NEAR, 40) for k in range(3)]

    def multiple(node, *numbers):
        for number in numbers:
            node = program.plain("multiply", [node, program.number(number, number)])
        return node

    program.plain("multiply", [multiple(x, 1539.0, 87211.0), multiple(y, 511.0, 262657.0)])
    program.plain("multiply", [x, y])
    program.plain("multiply", [x, z])
    program.plain("multiply", [multiple(x, 2.0), multiple(z, -0.5)])
    moving = [k for k in range(len(program.nodes)) if program.nodes[k].op == "multiply"]
    rows = relax(program, moving, ranges_of(program, boxes))
    assert rows[-1].equal and len(rows[-1].nodes) == 2
    for k in range(40):
        with mp.workprec(PRECISION):
            values = {}
            for index, node in enumerate(program.nodes):
                if node.op == "input":
                    values[index] = mp.mpf(boxes[node.number][0, k])
                elif index in program.constants:
                    values[index] = mp.mpf(program.exact(index))
                else:
                    values[index] = values[node.args[0]] * values[node.args[1]]
            assert not broken(rows, k, values)
