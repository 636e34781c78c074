"""Refusal of jumps: a Jacobian bounds the change of a function only where the function has none.

CasADi differentiates past the jump of a sign, a step or a piecewise definition as if it were not
there. A kink is harmless (both slopes enter the bounds), a jump is not.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray
from sympy.core.relational import Relational

from obsynth.derive.algebra.zero_test import is_zero
from obsynth.derive.errors import StructureError
from obsynth.derive.intervals.ranges import bound_ranges
from obsynth.derive.rigour import enclose_number, substitute
from obsynth.symbolic.convert import to_sx
from obsynth.symbolic.plant import Plant

Box = Mapping[sp.Symbol, tuple[float, float]]
_STEPS = (sp.floor, sp.ceiling, sp.Mod)


def refuse_jumps(model: Plant) -> None:
    """Check that the right-hand side of a plant is continuous over its box.

    Every sign, step and piecewise definition has to agree on both sides of its switching surface,
    provably, or the surface has to lie outside the box.
    """
    kinds = ("x", "u", "d", "f", "w", "p", "rho")
    box = {s.symbol: (s.lower, s.upper) for k in kinds for s in getattr(model, k)}
    for name, row in zip(model.names("x"), model.rhs, strict=True):
        exact = substitute(row, model.constant_values)
        for switch in _switches(exact):
            if not _meets(switch, box):
                continue
            if all(_vanishes_on(d, switch.surface) for d in switch.differences):
                continue
            raise StructureError(
                f"the row of {name} may jump where {switch.surface} = 0, which lies inside the "
                "box; the bounds of its Jacobian would say nothing about the jump. Make both "
                "sides agree there, or restrict the ranges to one side",
                row=name,
                surface=switch.surface,
                condition="continuity",
            )


@dataclass(frozen=True)
class _Switch:
    """Where a row changes its definition, and by what.

    surface: zero on the switching surface
    differences: the row on one side minus the row on the other, for every pair of sides that may
        meet
    only_where_negative: the surface counts only where this expression is not positive
    """

    surface: sp.Expr
    differences: tuple[sp.Expr, ...]
    only_where_negative: sp.Expr | None = None


def _switches(row: sp.Expr) -> Iterator[_Switch]:
    one = sp.Integer(1)
    for atom in sorted(row.atoms(sp.sign, sp.Heaviside, sp.Piecewise, sp.atan2, *_STEPS), key=str):
        if isinstance(atom, _STEPS):
            # jumps wherever the argument passes an integer, none between two of them
            argument = atom.args[0] / atom.args[1] if isinstance(atom, sp.Mod) else atom.args[0]
            yield _Switch(sp.sin(sp.pi * argument), (one,))
        elif isinstance(atom, sp.atan2):
            yield _Switch(atom.args[0], (one,), atom.args[1])
        elif isinstance(atom, sp.Piecewise):
            yield from _branches(row, atom)
        else:
            low = sp.Integer(-1 if isinstance(atom, sp.sign) else 0)
            yield _Switch(atom.args[0], (row.xreplace({atom: one}) - row.xreplace({atom: low}),))


def _branches(row: sp.Expr, atom: sp.Piecewise) -> Iterator[_Switch]:
    for k, (value, condition) in enumerate(atom.args[:-1]):
        for relation in sorted(condition.atoms(Relational), key=str):
            surface = relation.lhs - relation.rhs
            across = []
            for other, later in atom.args[k + 1 :]:
                holds = _on_surface(later, surface)
                if holds is not False:
                    across.append(row.xreplace({atom: value}) - row.xreplace({atom: other}))
                if holds is True:
                    break
            yield _Switch(surface, tuple(across))


def _on_surface(condition: sp.Basic, surface: sp.Expr) -> bool | None:
    """Tell whether a later condition holds near a surface; None when that is open."""
    solution = _solved(surface)
    if condition is sp.true:
        return True
    if solution is None:
        return None
    for relation in condition.atoms(Relational):
        if sp.expand((relation.lhs - relation.rhs).subs(*solution)) == 0:
            return None
    value = condition.subs(*solution)
    return {sp.true: True, sp.false: False}.get(value)


def _solved(surface: sp.Expr) -> tuple[sp.Symbol, sp.Expr] | None:
    """Solve surface = 0 for a symbol that enters linearly."""
    for symbol in sorted(surface.free_symbols, key=str):
        slope = sp.diff(surface, symbol)
        if slope != 0 and not slope.has(symbol):
            return symbol, sp.expand(symbol - surface / slope)
    return None


def _range(expression: sp.Expr, box: Box) -> tuple[float, float]:
    symbols = sorted(expression.free_symbols, key=str)
    if not symbols:
        return enclose_number(expression)
    columns = {s: ca.SX.sym(str(s)) for s in symbols}
    (converted,) = to_sx([expression], columns, ["a switching surface"])
    limits: NDArray[np.float64] = np.array([box[s] for s in symbols], dtype=float)
    found = bound_ranges(converted, ca.vertcat(*columns.values()), limits, rtol=1e-3, effort="fast")
    return float(found.lower[0]), float(found.upper[0])


def _meets(switch: _Switch, box: Box) -> bool:
    """Tell whether the switching surface may have a point inside the box."""
    low, high = _range(switch.surface, box)
    if low > 0.0 or high < 0.0:
        return False
    guard = switch.only_where_negative
    return guard is None or _range(guard, box)[0] <= 0.0


def _vanishes_on(difference: sp.Expr, surface: sp.Expr) -> bool:
    """Prove that the difference is zero wherever the surface is."""
    solution = _solved(surface)
    return solution is not None and bool(is_zero(difference.subs(*solution)))
