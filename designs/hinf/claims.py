"""Proofs of the attenuation level for the stored numbers, and that these speak of the plant."""

from collections.abc import Iterator
from fractions import Fraction
from itertools import compress
from typing import Any

import numpy as np

from obsynth.derive.rigour import UNIT, ExactMatrix, is_positive_definite, prove_positive_definite
from obsynth.designs.core import signals
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.equations import covered_inputs
from obsynth.designs.core.method import Numbers
from obsynth.designs.hinf import lmis
from obsynth.designs.hinf.lmis import PrintedLoop
from obsynth.designs.hinf.model import Derived
from obsynth.designs.hinf.record import HinfDesign
from obsynth.designs.hinf.system import FilterData, build_sector, covers_sector
from obsynth.designs.lmi.problem import Arithmetic, he, lift
from obsynth.designs.lmi.proof import RUMP
from obsynth.symbolic.arrays import FloatArray

EXACT = "exact rational elimination at the worst vertex"
# What rounding F and H may leave of the fault, relative to what they take away.
RESIDUAL = 1e-12
# What rounding C and L may move in one step, relative to the sizes of the signals.
ALLOWED = 2.0**-40


def claims(design: HinfDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    yield prove_decoupling(design)
    yield from prove_level(design)


def proof_blocks(
    design: HinfDesign, arithmetic: Arithmetic, data: FilterData | None = None
) -> dict[str, Any]:
    """Form every matrix that has to be positive definite, in an arithmetic."""
    data = design.data if data is None else data
    bound = design.bound

    def number(value: float) -> Any:
        return lift(np.array([[value]]), arithmetic)

    mu = number(bound.mu)
    P = lift(bound.P, arithmetic)
    if bound.printed.size:
        loop = PrintedLoop.of(data, design.gains, arithmetic)
        alpha, beta, Q = number(bound.printed[0]), number(bound.printed[1]), bound.Q
        N = P @ lift(design.gains.K, arithmetic)
        return {
            "lmi": lmis.printed_block(loop, P, N, lift(Q, arithmetic), alpha, beta, mu @ mu),
            "lipschitz": lmis.printed_bound(loop, P, alpha),
            "Q": lift(Q, arithmetic),
        }
    error = lmis.loop_of_filter(data, design.gains, P, arithmetic)
    tau = [number(value) for value in bound.tau]
    blocks = {"lmi": lmis.dissipation_block(error, mu @ mu, data.sector, tau)}
    if bound.decay is not None:
        extra = [number(value) for value in (() if bound.tau_decay is None else bound.tau_decay)]
        blocks["decay"] = lmis.decay_block(error, number(bound.decay), data.sector, extra)
    return blocks


def prove_level(design: HinfDesign) -> Iterator[Claim]:
    """Prove every matrix inequality behind the level."""
    data, bound = design.data, design.bound
    count = data.count
    printed = bool(bound.printed.size)
    where = (
        f"at all {count} vertices of the Jacobian set"
        if data.sector is None
        else f"for every nonlinearity in the sector ({data.sector.groups} multipliers)"
    )
    plant, centre = design.plant, signals.noise_centre(design.plant)
    about, quiet = signals.about_centre(plant, centre), signals.at_centre(plant, centre)
    level = f"V+ - V + |f - fhat|^2 < mu^2 |{about}|^2 with mu = {bound.mu:.9g}"
    statements = {
        "lmi": f"{level} {where}" + (", by (45)" if printed else ""),
        "lipschitz": "(37): P > alpha M'M",
        "Q": "Q > 0",
        "decay": f"V+ < {bound.decay} V where {quiet}, {where}",
    }
    exact = {}
    for name, block in proof_blocks(design, "enclosure").items():
        result = prove_positive_definite(block)
        worst = int(result.worst()[0]) if data.sector is None else 0
        if worst not in exact:
            exact[worst] = proof_blocks(design, "exact", data.vertex(worst))
        confirmed = is_positive_definite(he(exact[worst][name]) * Fraction(1, 2))
        yield Claim(
            name,
            statements[name],
            bool(result.all_proved and confirmed),
            float(result.relative.min()),
            f"{RUMP}; {EXACT}",
        )
    if printed:
        least = float(min(bound.printed[0], bound.printed[1]))
        # (45) knows neither an output feedthrough D nor a decay rate.
        plain = not design.gains.D.any() and bound.decay is None
        yield Claim(
            "multipliers",
            "alpha > 0, beta > 0, D = 0",
            bool(least > 0.0 and plain),
            least,
            "comparison",
        )


def decoupling_residual(design: HinfDesign) -> tuple[float, float]:
    """Return the largest entries of (I - F C) L and of H C L - [I, 0], computed exactly."""
    F, H, C, L = (
        ExactMatrix.of(value) for value in (design.gains.F, design.gains.H, design.C, design.L)
    )
    n_f, s = len(design.gains.H), design.L.shape[1]
    CL = C @ L
    state = (L - F @ CL).to_floats()
    fault = (H @ CL - ExactMatrix.of(np.eye(n_f, s))).to_floats()
    return float(np.abs(state).max()), float(np.abs(fault).max())


def prove_decoupling(design: HinfDesign) -> Claim:
    """Prove that the faults themselves drop out of both errors."""
    state, fault = decoupling_residual(design)
    size = float(np.abs(design.L).max())
    exact = state == 0.0 and fault == 0.0
    return Claim(
        "decoupling",
        "(I - F C) L = 0 and H C L = I: the errors do not depend on the faults"
        if exact
        else f"|(I - F C) L| <= {state:.1e} and |H C L - I| <= {fault:.1e}: what rounding leaves "
        "of the faults",
        bool(state <= RESIDUAL * size and fault <= RESIDUAL),
        0.0 - max(state / size, fault),
        "exact rational arithmetic on the stored F, H, C, L",
    )


def covers(design: HinfDesign, fresh: Derived) -> Iterator[Claim]:
    """Compare the stored matrices, family and sector with those derived from the equations."""
    parts = fresh.split
    rounding = parts.proof.rounding
    pairs = (
        (design.A, parts.A),
        (design.B, parts.B),
        (design.C, parts.C),
        (design.L, np.hstack([parts.B_f, parts.D])),
        (design.W, parts.W1),
    )
    same = all(np.array_equal(stored, derived) for stored, derived in pairs)
    held = bool(np.all(design.W_radius >= rounding["W1"])) and not parts.W2.any()
    lost, size = _rounding_of_signals(design, rounding)
    yield Claim(
        "model",
        "A x + B u + L f + W w + g equals the stored dynamics, C x the outputs",
        bool(same and held and parts.proof.holds),
        0.0,
        str(parts.proof),
    )
    yield Claim(
        "matrix_rounding",
        f"rounding C and L to doubles moves no signal by more than {ALLOWED:.0e} of its size "
        f"(signals without a range up to {signals.LARGEST_SIGNAL:g})",
        bool(lost <= ALLOWED * size),
        ALLOWED * size - lost,
        "bounds of |exact - double| times the ranges",
    )
    # The step and the refusal of unstable gains use the vertices in every form.
    yield signals.covers_jacobian("g", design.family, fresh.bounds.family)
    if design.sector is not None:
        yield _covers_sector(design, fresh)


def _covers_sector(design: HinfDesign, fresh: Derived) -> Claim:
    found, form = fresh.majorant, design.sector_form
    holds, room = False, -np.inf
    if design.sector is not None and found is not None and form is not None:
        holds, room = covers_sector(design.sector, build_sector(found, form))
        holds = holds and bool(np.all(design.A_radius >= found.rounding))
    return Claim(
        "majorant",
        "g(a) - g(b) lies in the stored sector for all a, b in the box",
        holds,
        room,
        "interval branch and bound of sum_j (dg_i/dx_j)^2 / R_jj",
    )


def _rounding_of_signals(
    design: HinfDesign, rounding: dict[str, FloatArray]
) -> tuple[float, float]:
    """Bound what rounding C, B_f and D moves in one step, and the size to compare it with."""
    lost, size = 0.0, 1.0
    for kind, name in (("x", "C"), ("f", "B_f"), ("d", "D")):
        box = np.abs(signals.finite_box(design.plant, kind)).max(axis=1, initial=0.0)
        lost += float((rounding[name] @ box).max(initial=0.0))
        size = max(size, float(box.max(initial=0.0)))
    return lost, size


def numbers(design: HinfDesign) -> Numbers:
    """Return gains and performance; no set is carried along, so there are no half widths."""
    searched = () if design.bound.least_mu is None else ("least_mu",)
    return Numbers(_gains(design), _performance(design), searched=searched)


def _gains(design: HinfDesign) -> dict[str, FloatArray]:
    """Gains by the paper's letters, (16)-(19), and of the general filter, Z and Y projected."""
    data, gains = design.data, design.gains
    G, C = data.G, data.C
    base = data.standard_filter(gains.K)
    HC = data.H[: data.n_f] @ C
    return {
        "K": gains.K,
        "F": gains.F,
        "H": gains.H,
        "D": gains.D,
        "Z": gains.F - base.F,
        "Y": gains.H - base.H,
        "G": G,
        "Abar": G @ design.A,
        "Bbar": G @ design.B,
        "Lbar": data.L @ data.H,
        "Wbar": G @ design.W,
        "Hbar": HC.T @ HC,
    }


def _performance(design: HinfDesign) -> dict[str, float]:
    bound = design.bound
    found = {"l2_gain": bound.mu, "mu": bound.mu, "trace_P": float(np.trace(bound.P))}
    more = {"least_mu": bound.least_mu, "decay": bound.decay}
    return found | {name: value for name, value in more.items() if value is not None}


def guarantee(design: HinfDesign) -> Guarantee:
    """Return what is promised of the fault estimates, and what has to hold for it."""
    plant, bound = design.plant, design.bound
    faults = ", ".join(plant.names("f"))
    centre = signals.noise_centre(plant)
    about, quiet = signals.about_centre(plant, centre), signals.at_centre(plant, centre)
    start = "e_0'Pe_0 + s_0'Qs_0" if bound.printed.size else "e_0'Pe_0"
    claims = [
        f"sum_k |f_k - fhat_k|^2 <= mu^2 sum_k |w_k|^2 + {start} over every horizon, with "
        f"mu = {bound.mu:.9g}, f = ({faults}), w = {about} and e = x - xhat",
        f"xhat -> x and fhat -> ({faults}) where {quiet}, whatever ({faults}) does",
    ]
    if bound.decay is not None:
        claims.append(f"V+ <= {bound.decay:g} V for V = e'Pe where {quiet}")
    if plant.d:
        claims.append(f"whatever {', '.join(plant.names('d'))} does")
    residual = max(decoupling_residual(design))
    seen = "[monitored: status bits 4 and 8, as far as xhat and y show it]"
    inside = "x lies in the box" if design.sector is not None else "x and xhat lie in the box"
    assumptions = [
        f"the plant is {plant.name} in discrete time with Ts = {plant.Ts:g}",
        f"{inside}: {signals.within(plant.x, units=True)} {seen}",
        *_inputs_assumed(design),
        "every reading arrives (status bit 32); one that is missing counts as a new initial error",
        f"{about} has finite energy over the horizon; no bound is used",
        f"rounding errors of the step, about {UNIT[design.precision]:.0e} of the signals, are not "
        "counted as disturbances",
    ]
    if residual > 0.0:
        assumptions.append(
            f"nor is what rounding of F and H leaves of the faults, {residual:.1e} of their size"
        )
    return Guarantee(tuple(claims), tuple(assumptions))


def _inputs_assumed(design: HinfDesign) -> list[str]:
    held = compress(design.plant.u, covered_inputs(design.plant))
    bounded = [s for s in held if np.isfinite([s.lower, s.upper]).any()]
    return [f"{signals.within(bounded)} [monitored: status bit 4]"] if bounded else []
