"""Lamouchi, Raissi, Amairi, Aoun: what is printed of the interval observer, and what holds."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from obsynth.derive.rigour import exact, nearest
from obsynth.designs import InfeasibleDesign, IntervalObserver, printed_faults
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.synthesis import sylvester_gain
from obsynth.evaluate.papers.claim import Claim
from obsynth.evaluate.simulate import simulate
from obsynth.symbolic import Plant, plants, scenarios

_P, _L = np.array([[10.0, -5.0], [-10.0, 6.0]]), np.array([[-0.3], [-2.1]])
_R, _Q = np.diag([0.5, 0.6]), np.array([[7.5], [-9.6]])
_A = np.array([[-1.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, -1.0, -1.0]])
_MIRROR = np.diag([1.0, -1.0])
_ALPHA = 0.057
_SEEDS = 10


def claims() -> Iterator[Claim]:
    """Try Section 5 with its gains, and (32) with gains whose bounds are stable."""
    plant = plants.interval_example()
    options: dict[str, Any] = {"bound": "paper", "contraction": False}
    apart = {**options, "centred": False, "nominal": _A}
    own = IntervalObserver(gains=(_MIRROR, [0.0, -1.0]), **apart).design(plant)
    design = IntervalDesign.from_record(own.record)
    A2 = nearest(design.decoupled.T2 @ exact(design.nominal) @ design.decoupled.W)
    sign = np.sign(design.transformation.H[1:, 1:].diagonal())
    C2 = nearest(design.decoupled.C2) * sign
    P, L = sylvester_gain(np.outer(sign, sign) * A2, C2, _R, _Q)
    off = float(max(np.abs(P - _P).max(), np.abs(L - _L).max()))
    yield Claim(
        "Section 5",
        "P and L follow from R = diag(.5, .6) by Sylvester's equation",
        f"off by {off:.1e} at most",
        off < 1e-9,
    )
    jacobian = plant.rhs.jacobian([signal.symbol for signal in plant.x])
    middle = jacobian.subs({signal.symbol: 0 for signal in plant.rho})
    constant = float(np.abs(np.array(middle, dtype=float) - _A).max())
    yield Claim(
        "Section 5",
        "Delta A is what varies around A",
        f"it has constant entries of up to {constant:g}, which belong to A",
        constant == 0.0,
    )
    try:
        IntervalObserver(form="printed", gains=(_P, _L), **apart).design(plant)
    except InfeasibleDesign as error:
        yield Claim(
            "Section 5",
            f"alpha = {_ALPHA:g}, so that (20) is feasible",
            f"alpha = {error.alpha:.4f}; (20) is feasible below {error.largest_alpha:.3f}",
            error.alpha < error.largest_alpha,
        )
        yield Claim(
            "Theorem 1, Section 5",
            "the widths stay bounded with P and L",
            f"they grow by a factor of {error.radius:.4f} a step",
            error.radius < 1.0,
        )
    inside = _inside(plant, options)
    yield Claim(
        "(32)",
        "the bounds hold the fault",
        f"at {100.0 * inside:.1f} % of the instants of {_SEEDS} runs with bounds that are stable",
        inside == 1.0,
    )


def _inside(plant: Plant, options: dict[str, Any]) -> float:
    """Return the share of instants at which (32) holds the fault, its states bounded rightly."""
    given = {"gains": (_MIRROR, [0.4, -1.0]), **options, "cuts": (), "horizon": 10**9}
    observer = IntervalObserver(**given).design(plant)
    turned = IntervalObserver(**given, H=np.diag([-1.0, 1.0, 1.0])).design(plant)
    held = []
    for seed in range(_SEEDS):
        scenario = scenarios.interval_example(seed)
        run = simulate(plant, observer, scenario)
        memory, rows = observer.memory0(scenario.guess, x_range=scenario.x_range), []
        for u, y in zip(run.u, run.y, strict=True):
            rows.append(np.array(memory).ravel())
            memory = observer.step(memory, u, y)[0]
        # what r is at the first call is not in the memory
        r = np.array(rows)[1:]
        low, high = printed_faults(turned, r[:, :2], r[:, 2:4], run.y[1:], run.u[1:])
        f = run.f[1:-1]
        held.append(np.mean((low <= f) & (f <= high)))
    return float(np.mean(held))
