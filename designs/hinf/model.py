"""From a model to the numeric data of the method, structural conditions first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from obsynth.derive import JacobianBounds, Majorant, Split, jacobian_bounds, majorant, split
from obsynth.designs.hinf.conditions import check_class, check_decoupling, check_detectability
from obsynth.designs.hinf.record import Bound, HinfDesign
from obsynth.designs.hinf.sector import Multipliers, build_sector, derive_majorant
from obsynth.designs.hinf.system import Filter
from obsynth.symbolic import Plant


@dataclass(frozen=True, eq=False)
class Prepared:
    """A model of the class (1)-(2) with everything derived from it.

    design: complete except for gains and bound, which are zero
    """

    split: Split
    bounds: JacobianBounds
    majorant: Majorant | None
    design: HinfDesign


def prepare(
    model_or_split: Plant | Split,
    multipliers: Multipliers | None,
    drop_zero_rows: bool = True,
    given: tuple[float, ...] | None = None,
    bounds: JacobianBounds | None = None,
) -> Prepared:
    """Split, check the structural conditions, bound the nonlinearity."""
    model = model_or_split if isinstance(model_or_split, Plant) else model_or_split.model
    check_class(model)
    if isinstance(model_or_split, Plant):
        point = (np.zeros(len(model.x)), np.zeros(len(model.u)))
        parts = split(model, at=point, linear="terms")
    else:
        parts = model_or_split
    L = check_decoupling(parts)
    if bounds is None:
        bounds = jacobian_bounds(parts)
    n, m, n_f = len(model.x), len(parts.C), len(model.f)
    found = sector = None
    A_radius = np.zeros((n, n))
    if multipliers is not None:
        found = derive_majorant(parts, given) if multipliers == "single" else majorant(parts)
        sector = build_sector(found, multipliers, drop_zero_rows, given)
    if found is not None and sector is not None:
        A_radius = found.rounding
    design = HinfDesign(
        plant=model,
        linear=parts.linear,
        x_at=np.asarray(parts.at.x, dtype=float),
        u_at=np.asarray(parts.at.u, dtype=float),
        A=parts.A,
        B=parts.B,
        C=parts.C,
        L=L,
        W=parts.W1,
        A_radius=A_radius,
        W_radius=parts.proof.rounding["W1"],
        family=bounds.family,
        sector=sector,
        gains=Filter(np.zeros((n, m)), np.zeros((n, m)), np.zeros((n_f, m)), np.zeros((n_f, m))),
        bound=Bound(1.0, np.zeros((n, n)), np.zeros(0), np.zeros(0)),
        options={},
    )
    check_detectability(parts, L, design.data.G, design.data.vertices)
    return Prepared(parts, bounds, found, design)
