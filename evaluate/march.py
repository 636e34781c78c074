"""Many calls of a function whose first result its next call takes, many in one call of CasADi."""

from collections.abc import Callable, Iterator
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Call
from obsynth.symbolic.arrays import FloatArray

BLOCK = 4096
"""Instants whose states are held at a time."""
_TOGETHER, _BASE = 64, 8

Before = Callable[[int, FloatArray, FloatArray], None]


def in_rows(function: ca.Function) -> ca.Function:
    """Return f(state, a, b, ...) -> (state, r, s, ...) as one of (state, row) -> (state, row)."""
    sizes = [function.numel_in(i) for i in range(1, function.n_in())]
    state, row = ca.MX.sym("state", function.numel_in(0)), ca.MX.sym("row", sum(sizes))
    call: Any = function
    following, *told = call(state, *ca.vertsplit(row, [0, *np.cumsum(sizes).tolist()]))
    return ca.Function("instant", [state, row], [following, ca.vertcat(*told)])


def march(
    function: ca.Function, state: FloatArray, rows: FloatArray, before: Before | None = None
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Call a function of (state, row) for row after row; `state` ends as what the last one gave.

    Yields the states before and what was told, (n, n_state) and (n, n_told), for blocks of rows.
    `before` (k, state, row) completes rows that depend on the state.
    """
    together = min(_TOGETHER, len(rows)) if before is None else 1
    call = Call(function.mapaccum(together, {"base": _BASE}) if together > 1 else function)
    given, moved, said = (a.reshape(together, -1) for a in (call.args[1], *call.results))
    for begin in range(0, len(rows), BLOCK):
        part = rows[begin : begin + BLOCK]
        states, told = (np.empty((len(part), a.shape[1])) for a in (moved, said))
        for k in range(0, len(part), together):
            n = min(together, len(part) - k)
            if before is not None:
                before(begin + k, state, part[k])
            given[:n], given[n:] = part[k : k + n], part[k + n - 1]
            call.args[0][:] = state
            call.evaluate()
            states[k], states[k + 1 : k + n], told[k : k + n] = state, moved[: n - 1], said[:n]
            state[:] = moved[n - 1]
        yield states, told
