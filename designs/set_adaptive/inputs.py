"""Checks of the signals that the steps are given."""

from __future__ import annotations

import casadi as ca
import sympy as sp

from obsynth.designs.core.stepping import all_finite, finite_or
from obsynth.symbolic import Plant


def known_signals(plant: Plant, u: ca.SX, theta: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Return inputs and scheduling made finite, whether they were, and whether they are covered.

    Covered are measured scheduling variables inside of their ranges, and inputs inside of theirs
    where an equation is not affine in them with a constant factor: elsewhere their size does not
    matter to what was derived.
    """
    measured = [s for s in plant.rho if s.measured]
    nominal = [0.0 if s.nominal is None else float(s.nominal) for s in plant.u]
    middle = [0.5 * (s.lower + s.upper) if s.bounded else 0.0 for s in measured]
    finite = ca.logic_and(all_finite(u), all_finite(theta))
    u_used, theta_used = finite_or(u, nominal), finite_or(theta, middle)
    covered = ca.SX(1)
    for value, signal in [(theta_used[i], s) for i, s in enumerate(measured)] + [
        (u_used[i], s) for i, s in enumerate(plant.u) if not _enters_linearly(plant, s.symbol)
    ]:
        fits = ca.logic_and(value >= signal.lower, value <= signal.upper)
        covered = ca.logic_and(covered, fits)
    return u_used, theta_used, finite, covered


def _enters_linearly(plant: Plant, symbol: sp.Symbol) -> bool:
    constants = set(plant.constant_values)
    return all(not sp.expand(sp.diff(row, symbol)).free_symbols - constants for row in plant.rhs)
