"""Signs that the box decides: |g| = g and sign(g) = 1 where g is positive on the whole box."""

from collections.abc import Sequence

import sympy as sp

from obsynth.derive.forms.quasi_lpv.centre import Centre
from obsynth.derive.intervals.ranges import bound_ranges
from obsynth.derive.jacobian.matrix_entries import matrix_entries
from obsynth.symbolic.plant import Plant


def decide_signs(rows: Sequence[sp.Expr], model: Plant, centre: Centre) -> list[sp.Expr]:
    """Write sign(g) and |g| without a kink where g keeps its sign on the box and at the centre.

    A secant from the centre to a point of the box exists in closed form only for what is smooth
    between them.
    """
    kinked = sorted(
        {a for row in rows for a in row.atoms(sp.sign, sp.Abs)}, key=sp.default_sort_key
    )
    inner = list(dict.fromkeys(atom.args[0] for atom in kinked))
    if not inner:
        return list(rows)
    symbols = [s.symbol for s in (*model.x, *model.u)]
    at = dict(zip(symbols, (*centre.x, *centre.u), strict=True))
    entries = matrix_entries({(0, k): g for k, g in enumerate(inner)}, model)
    found = bound_ranges(
        entries.values,
        entries.variables,
        entries.box,
        entries.constants,
        entries.constant_box,
        rtol=1e-2,
        effort="fast",
    )
    signs: dict[sp.Expr, int] = {}
    for k, (_, position) in enumerate(entries.places):
        value = inner[position].xreplace(at)
        if found.lower[k] > 0.0 and value.is_positive:
            signs[inner[position]] = 1
        elif found.upper[k] < 0.0 and value.is_negative:
            signs[inner[position]] = -1
    replacements = {
        atom: signs[g] * (g if isinstance(atom, sp.Abs) else 1)
        for atom in kinked
        if (g := atom.args[0]) in signs
    }
    return [row.xreplace(replacements) for row in rows]
