"""The design and analysis problems as the solver sees them.

They are stated in the units of `find_units`, where the entries are about one, so that caps and
margins mean the same for every plant.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from obsynth.designs.hinf.lmis import (
    Loop,
    PrintedLoop,
    decay_block,
    dissipation_block,
    loop_of_filter,
    printed_block,
    printed_bound,
)
from obsynth.designs.hinf.system import Filter, FilterData
from obsynth.designs.lmi import Problem, full, scalar, symmetric, trace

Structure = Literal["standard", "general", "printed"]

# Several infima need one direction of P to go to infinity; within these limits, in units in
# which the rest of P is about one, the least mu is off by less than 1e-6 of itself.
CAP = 1e4
FLOOR = 1e-3
# Room between the solver's answer and the boundary: large against the solver's tolerance.
MARGIN = 1e-7


def state_problem(
    data: FilterData,
    structure: Structure,
    mu: float | None,
    decay: float | None = None,
    gains: Filter | None = None,
    margin: float = MARGIN,
    cap: float = CAP,
) -> Problem:
    """State the design LMI, or with `gains` the analysis LMI."""
    name = "least mu" if mu is None else f"mu = {mu:.6g}"
    problem = Problem(f"H-infinity {'analysis' if gains else 'design'}, {name}")
    P = symmetric("P", len(data.A))
    mu2: Any = scalar("mu2") if mu is None else mu**2
    if structure == "printed":
        _state_printed(problem, data, P, mu2, gains, margin)
        loop = None
    else:
        loop = open_loop(data, structure, P, gains)
        tau = multipliers("tau", data)
        block = dissipation_block(loop, mu2, data.sector, tau)
        problem.add_lmi("dissipation", block, ">>", margin=margin)
    if decay is not None and loop is not None:
        block = decay_block(loop, decay, data.sector, multipliers("decay.tau", data))
        problem.add_lmi("decay", block, ">>", margin=margin)
    problem.add_lmi("P.cap", cap * np.eye(len(data.A)) - P, ">>", strict=False)
    problem.add_lmi("P.floor", P - FLOOR * np.eye(len(data.A)), ">>", strict=False)
    problem.minimise(trace(P) if mu is not None else mu2)
    return problem


def multipliers(name: str, data: FilterData) -> list[Any]:
    """Return one scalar unknown per group of the sector."""
    groups = 0 if data.sector is None else data.sector.groups
    return [scalar(f"{name}{k + 1}") for k in range(groups)]


def open_loop(data: FilterData, structure: Structure, P: Any, gains: Filter | None) -> Loop:
    """Form the error system with free gains, or with the given ones."""
    if gains is not None:
        return loop_of_filter(data, gains, P)
    n, m = len(data.A), len(data.C)
    standard = data.standard_filter(np.zeros((n, m)))
    PG: Any = P @ data.G
    HC: Any = standard.H @ data.C
    DC: Any = np.zeros((data.n_f, n))
    if structure == "general":
        r = len(data.null)
        DC = full("D", data.n_f, m) @ data.C
        if r:
            PG = PG - full("N2", n, r) @ (data.null @ data.C)
            HC = full("Y", data.n_f, r) @ (data.null @ data.C) + HC
    return Loop(P, PG, full("N", n, m) @ data.C, HC, DC, data.dynamics(), data.W)


def _state_printed(
    problem: Problem, data: FilterData, P: Any, mu2: Any, gains: Filter | None, margin: float
) -> None:
    n, m = len(data.A), len(data.C)
    loop = PrintedLoop.of(data, gains)
    N = full("N", n, m) if gains is None else P @ gains.K
    Q, alpha, beta = symmetric("Q", n), scalar("alpha"), scalar("beta")
    problem.add_lmi("(45)", printed_block(loop, P, N, Q, alpha, beta, mu2), ">>", margin=margin)
    problem.add_lmi("(37)", printed_bound(loop, P, alpha), ">>", margin=margin)
    problem.add_lmi("Q", Q, ">>", margin=margin)
    # Not implied by (45): with beta < 0 the Lipschitz condition (35) would count backwards.
    problem.add_lmi("beta", beta, ">>", margin=margin)
