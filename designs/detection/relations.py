"""Relations between states and faults of which sums over time are narrow (docs/step.md, Means).

D is simplified as text before it is enclosed: what x, f and ``c'F`` have in common is gone and
widens nothing. Weights c are rows alone, and pairs of rows in which a term that both have cancels.
"""

from itertools import combinations

import casadi as ca
import numpy as np
import sympy as sp

from obsynth.derive.rigour.interval import rational
from obsynth.designs.core.equations import Equations
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.convert import to_sx

MOST = 3
"""Relations that are kept for a fault, the narrowest."""
LONGEST = 100
"""How often a state may enter a row of a step of higher order, about, to be written out."""
_UNKNOWN = 1e9  # half width of a state of which nothing is known beforehand


def relations(
    plant: Plant, half_widths: FloatArray | None, m: int
) -> tuple[list[int], Equations | None]:
    """Return the faults of the relations that should be narrowest over m instants, and their rows.

    half_widths (n + n_f,): to be expected, ranges by default; rows: D of all relations, then P
    """
    n, n_f, hidden = len(plant.x), len(plant.f), [s for s in plant.rho if not s.measured]
    unknown = (*plant.x, *plant.f, *plant.d, *plant.w, *plant.p, *hidden)
    known = (*plant.u, *(s for s in plant.rho if s.measured))
    ports = [ca.SX.sym("v", len(unknown)), ca.SX.sym("known", len(known))]
    symbols = [s.symbol for s in (*unknown, *known)]
    places = dict(zip(symbols, ca.vertsplit(ca.vertcat(*ports)), strict=True))
    sizes = np.array([0.5 * (s.upper - s.lower) for s in unknown])
    if half_widths is not None:
        sizes[: n + n_f] = np.minimum(sizes[: n + n_f], half_widths)
    sizes[:n] = np.minimum(sizes[:n], _UNKNOWN)
    at = dict.fromkeys(symbols, 0.0)
    for s in (*plant.x, *unknown[n + n_f :], *known):
        middle = 0.5 * (s.lower + s.upper) if s.bounded else 0.0
        at[s.symbol] = middle if s.nominal is None else float(s.nominal)
    numbers = np.split([at[s] for s in symbols], [len(unknown)])
    found = []
    pairs = _combined(plant) if _is_short(plant) else []
    for j, (cx, row) in [(j, pair) for j in range(n_f) for pair in pairs]:
        fault = plant.f[j].symbol
        slope = sp.diff(row, fault)
        if not slope.is_number:
            value = float(slope.subs(at)) if slope.subs(at).is_real else np.inf
            slope = rational(value) if np.isfinite(value) else sp.S.Zero
        if slope == 0:
            continue
        pair = _spread(row - cx, 1 / slope) - fault, _spread(cx, 1 / slope)
        code = ca.vertcat(*to_sx(pair, places, [f"the mean of {fault}"] * 2))
        J = ca.Function("J", ports, [ca.densify(ca.jacobian(code, ports[0]))])
        slopes = np.abs(np.array(J(*numbers)))
        wide = (slopes * np.where(slopes == 0.0, 0.0, sizes)).sum(axis=1) @ [1.0, 2.0 / m]
        if np.isfinite(wide):
            found.append((float(wide), j, code))
    found.sort(key=lambda entry: entry[0])
    kept = [e for j in range(n_f) for e in [one for one in found if one[1] == j][:MOST]]
    if not kept:
        return [], None
    rows = ca.vertcat(*(code[side] for side in (0, 1) for _, _, code in kept))
    return [j for _, j, _ in kept], Equations(plant, ca.Function("relations", ports, [rows]))


def _is_short(plant: Plant) -> bool:
    """Whether the rows can be written out: those of a step of order k grow with the power k - 1."""
    if plant.step is None or plant.continuous is None:
        return True
    x, rows = {s.symbol for s in plant.x}, plant.continuous.equations[0]
    most = max(sum(node in x for node in sp.preorder_traversal(row)) for row in rows)
    return bool(most ** (plant.step.order - 1) <= LONGEST)


def _combined(plant: Plant) -> list[tuple[sp.Expr, sp.Expr]]:
    """Return c'x and c'F of every row, and of pairs without a term that they share."""
    x, rows = [s.symbol for s in plant.x], []
    for row in plant.rhs:
        exact = row.xreplace(plant.constant_values)
        rows.append(_spread(exact.xreplace({a: rational(float(a)) for a in exact.atoms(sp.Float)})))
    found = list(zip(x, rows, strict=True))
    terms = [row.as_coefficients_dict() for row in rows]
    for i, k in combinations(range(len(x)), 2):
        a, b = terms[i], terms[k]
        shares = dict.fromkeys(-a[t] / b[t] for t in list(a) if t in b)
        found += [(x[i] + s * x[k], rows[i] + _spread(rows[k], s)) for s in shares]
    return found


def _spread(expression: sp.Expr, factor: sp.Expr = sp.S.One) -> sp.Expr:
    """Multiply a sum with a number, term by term."""
    number, rest = expression.as_coeff_Mul()
    if not rest.is_Add:
        return factor * expression
    return sp.Add(*(_spread(term, factor * number) for term in rest.args))
