"""From CasADi expressions over a box to what branch and bound works on."""

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.program import Program
from obsynth.derive.intervals.rewriting.quotients import Quotients
from obsynth.derive.intervals.rewriting.removable import remove_singularities
from obsynth.derive.intervals.rules import JUMPS
from obsynth.derive.intervals.search.batch import Problem, Source


def make_problem(
    expressions: Any,
    variables: Any,
    box: ArrayLike,
    constants: Any = None,
    constant_box: Sequence[tuple[float, float]] = (),
    quotients: Quotients | None = None,
) -> Problem:
    """Program of expressions and their gradients, ready for `maximise`."""
    box = np.asarray(box, dtype=float)
    column = ca.densify(ca.vec(ca.SX(expressions)))
    variables = ca.vec(ca.SX(variables))
    m, v = column.numel(), variables.numel()
    if box.shape != (v, 2) or np.isnan(box).any() or (box[:, 0] > box[:, 1]).any():
        raise DerivationError(
            f"the box needs one (lower, upper) pair in this order for each of the {v} variables, "
            f"shape ({v}, 2); given was {box.tolist()}",
            box=box,
        )
    extra = ca.SX(0, 1) if constants is None else ca.vec(ca.SX(constants))
    if extra.numel() != len(constant_box):
        raise DerivationError(
            f"{extra.numel()} constants came with {len(constant_box)} enclosures",
            constants=extra.numel(),
            enclosures=len(constant_box),
        )
    given = ca.SX(0, 1) if quotients is None else quotients.column
    inputs = [variables, extra, given]
    free = sorted(map(str, ca.Function("f", inputs, [column], {"allow_free": True}).free_sx()))
    if free:
        raise DerivationError(
            f"the expressions contain the symbols {', '.join(free)}, which have no range here",
            symbols=tuple(free),
        )
    source = None
    if quotients is None:
        source = Source(column, variables, extra, list(constant_box))
        found = remove_singularities(column, variables, extra, box, constant_box)
        column, quotients = (column, Quotients()) if found is None else found
    jacobian = quotients.jacobian(column, variables)
    rows, columns = jacobian.sparsity().get_triplet()
    slopes = ca.SX(jacobian.nz[:]) if rows else ca.SX(0, 1)
    function = ca.Function("ranges", [variables, extra, quotients.column], [column, slopes])
    program = Program(n_variables=v)
    nodes = [program.variable(j) for j in range(v)]
    fixed = [program.number(*pair) for pair in constant_box]
    inside = quotients.insert(program, (variables, nodes), (extra, fixed))
    program.outputs = program.insert(function, [nodes, fixed, inside])
    gradient = np.full((m, v), -1, dtype=np.int64)
    relevant, affine = np.zeros((m, v), dtype=bool), np.zeros((m, v), dtype=bool)
    for k, (e, j) in enumerate(zip(rows, columns, strict=True)):
        gradient[e, j] = m + k
    for e in range(m):
        relevant[e, list(program.support(e))] = True
        if any(program.nodes[k].op in JUMPS for k in program.breaks(e)):
            continue
        for j in np.flatnonzero(relevant[e]).tolist():
            position = int(gradient[e, j])
            affine[e, j] = position >= 0 and j not in program.support(position)
    lower, upper = box[:, 0].copy(), box[:, 1].copy()
    return Problem(program, gradient, relevant, affine, lower, upper, source)
