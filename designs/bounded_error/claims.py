"""Proofs for the gains and matrices as they are stored, and that they speak of the stored plant."""

from collections.abc import Iterator
from fractions import Fraction
from itertools import compress
from typing import Any

import numpy as np

from obsynth.derive.rigour import is_positive_definite, prove_positive_definite
from obsynth.derive.structure.conditions import decouple
from obsynth.designs.bounded_error import lmis
from obsynth.designs.bounded_error.lmis import ModelData
from obsynth.designs.bounded_error.model import MATRICES, Derived, noise_box
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign
from obsynth.designs.bounded_error.rounding import of_matrices, prove_rounding, step_error
from obsynth.designs.bounded_error.step import running_bound
from obsynth.designs.core import signals
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.equations import curved_states
from obsynth.designs.core.method import Numbers
from obsynth.designs.lmi.problem import Arithmetic, lift
from obsynth.designs.lmi.proof import RUMP, inverse_bounds, prove_inverse
from obsynth.symbolic.arrays import FloatArray

EXACT = "exact rational LDL' on the worst vertex"


def claims(design: UioDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    rates = design.rate - noise_box(design.plant).rate
    w = design.plant.box("w")
    yield signals.prove_boxes(signals.DECLARED, w, design.w_centre, design.w_radius, rates)
    yield _prove_decoupling(design)
    yield prove_rounding(design)
    yield from prove_ellipsoid(design)


def _prove_decoupling(design: UioDesign) -> Claim:
    fresh = decouple(design.C, design.D)
    same = np.array_equal(fresh.E, design.E) and np.array_equal(fresh.T, design.T)
    return Claim(
        "decoupling",
        "(I + E C) D = 0: the unknown input does not enter the error"
        if fresh.residual == 0
        else f"|(I + E C) D| <= {fresh.residual:.1e}: covered by the rounding allowance",
        bool(same and np.array_equal(fresh.Pi, design.Pi)),
        0.0 - fresh.residual,
        "exact rational arithmetic on the stored E, C, D",
    )


def recursion_block(
    data: ModelData,
    gain: FloatArray,
    bound: EllipsoidBound,
    number: int,
    arithmetic: Arithmetic,
) -> Any:
    """Form the matrix whose definiteness makes ellipsoid `number` invariant."""
    system = lmis.build_error_system(data, bound.error, arithmetic)
    X, Z = system.closed_loop(lift(gain, arithmetic))
    gamma = lift(np.array([[bound.gamma[number]]]), arithmetic)
    one = lift(np.ones((1, 1)), arithmetic)
    noise = gamma * lift(np.diag(bound.weights[number]), arithmetic)
    P = lift(bound.P[number], arithmetic)
    return lmis.boundedness_block(P, P @ X, P @ Z, one - gamma, noise)


def prove_ellipsoid(design: UioDesign) -> tuple[Claim, ...]:
    """Prove every matrix inequality behind an `EllipsoidBound`."""
    bound = design.bound
    claims = [_prove_weights(bound), _prove_lmi(design, bound), _prove_half_widths(bound)]
    if bound.error == "shifted":
        kept = design.kept(bound.error)
        dropped = [i for i in range(len(design.A)) if i not in kept]
        largest = float(np.abs(design.K[dropped]).max(initial=0.0))
        claims.append(
            Claim(
                "dropped_gain",
                "K is zero in the coordinates that the unknown input takes away",
                largest == 0.0,
                -largest,
                "comparison of the stored gains with zero",
            )
        )
    return tuple(claims)


def _prove_weights(bound: EllipsoidBound) -> Claim:
    sums = [sum(map(Fraction, row.tolist()), Fraction(0)) for row in bound.weights]
    room = float(min(1 - total for total in sums))
    inside = bool(
        room >= 0
        and np.all(bound.weights >= 0)
        and np.all(bound.gamma > 0)
        and np.all(bound.gamma < 1)
    )
    return Claim(
        "weights",
        "every admissible v lies in the ellipsoid v'Q_v v <= 1, and 0 < gamma < 1",
        inside,
        room,
        "exact sum of the weights over the boxes",
    )


def _prove_lmi(design: UioDesign, bound: EllipsoidBound) -> Claim:
    gain = design.gain(bound.error)
    holds, exact, margin = True, True, np.inf
    count = len(design.data.vertices)
    for number in range(len(bound.P)):
        block = recursion_block(design.data, gain, bound, number, "enclosure")
        result = prove_positive_definite(block)
        holds = holds and result.all_proved
        margin = min(margin, float(result.relative.min()))
        worst = int(result.worst()[0])
        at = design.data.at(design.data.vertices[[worst]])
        exact = exact and is_positive_definite(recursion_block(at, gain, bound, number, "exact"))
    return Claim(
        "lmi",
        f"V+ <= (1 - gamma) V + gamma v'Q_v v at all {count} vertices of the Jacobian set "
        f"({len(bound.P)} ellipsoid{'s' if len(bound.P) > 1 else ''})",
        bool(holds and exact),
        margin,
        f"{RUMP}; {EXACT}",
    )


def _prove_half_widths(bound: EllipsoidBound) -> Claim:
    upper, units = bound.inverse_diagonal, np.eye(len(bound.inverse_diagonal))
    shapes = [bound.P[bound.shape_of(i)] for i in range(len(units))]
    proofs = [prove_inverse(P, units[[i]], upper[[i]]) for i, P in enumerate(shapes)]
    return Claim(
        "half_widths",
        "(P^-1)_ii stays below the stored value for every component",
        all(holds for holds, _ in proofs),
        min(margin for _, margin in proofs),
        RUMP,
    )


def inverse_diagonal_bounds(shapes: FloatArray) -> FloatArray:
    """Doubles just above ``(P^-1)_ii``, proved, component i from its own ellipsoid; P (s, p, p)."""
    every = np.broadcast_to(shapes, (shapes.shape[-1], *shapes.shape[1:]))
    return np.array([inverse_bounds(P, np.eye(len(P))[[i]])[0] for i, P in enumerate(every)])


def covers(design: UioDesign, fresh: Derived) -> Iterator[Claim]:
    """Compare the stored split and family with those derived from the stored equations."""
    parts, family = fresh.split, fresh.bounds.family
    same = all(np.array_equal(getattr(design, name), getattr(parts, name)) for name in MATRICES)
    yield Claim(
        "model",
        "A x + B u + D d + B_f f + W1 w + g equals the stored dynamics, C x + W2 w the outputs",
        bool(same and parts.proof.holds),
        0.0,
        str(parts.proof),
    )
    left = design.rounding - step_error(design)[0] - of_matrices(design, parts.proof.rounding)
    room = float(left.min(initial=np.inf))
    yield Claim(
        "matrix_rounding",
        "what rounding the matrices to doubles moves in one step is within the allowance too",
        bool(room >= 0.0),
        room,
        "bounds of |exact - double| times the limits of the signals",
    )
    yield signals.covers_jacobian("g", design.family, family)


def numbers(design: UioDesign) -> Numbers:
    """Return gains, performance and steady half widths."""
    widths = running_bound(design).steady
    return Numbers(_gains(design), _performance(design, widths), widths)


def guarantee(design: UioDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    names = (*design.plant.names("x"), *design.plant.names("f"))
    where = signals.within(compress(design.plant.x, curved_states(design.plant)), units=True)
    noise = signals.within(design.plant.w)
    rates = ", ".join(
        f"|{name}(k+1) - {name}(k)| <= {rate:g}"
        for name, rate in zip(design.plant.names("f"), design.rate, strict=True)
    )
    claims = [
        f"{', '.join(names)} lie inside the returned (ellipsoidal) intervals while this holds",
    ]
    if design.plant.d:
        claims.append(f"whatever {', '.join(design.plant.names('d'))} does")
    assumptions = [
        f"the plant is {design.plant.name} in discrete time with Ts = {design.plant.Ts:g}",
        *([f"{where} [monitored in part: status bit 8]"] if where else []),
        "the first state and fault lie in the boxes given to memory0",
    ]
    if noise:
        assumptions.append(f"{noise} [monitored in part: status bit 8]")
    if rates:
        assumptions.append(rates)
    assumptions.extend(_on_rounding(design))
    return Guarantee(tuple(claims), tuple(assumptions))


def _on_rounding(design: UioDesign) -> Iterator[str]:
    """Say where the rounding of a step is bounded, or that it is assumed to be."""
    largest = float(design.rounding.max(initial=0.0))
    said = f"the rounding errors of one step stay below {largest:.1e} in every component"
    if not step_error(design)[1]:
        yield f"{said}, which is not proved for this plant"
        return
    plant = design.plant
    listed = signals.beyond((*plant.x, *plant.f, *plant.u), np.concatenate(design.limits))
    where = f"{listed}, estimates too: there " if listed else ""
    yield (
        f"{where}{said}, which is proved for {signals.IEEE[design.precision]} rounded to nearest"
    )


def _gains(design: UioDesign) -> dict[str, FloatArray]:
    """Gains by the paper's letters, eqs. (10)-(15)."""
    N = design.T @ design.A - design.K @ design.C
    return {
        "K": design.K,
        "F": design.F,
        "E": design.E,
        "T": design.T,
        "N": N,
        "L": design.K - N @ design.E,
        "G": design.T @ design.B,
    }


def _performance(design: UioDesign, widths: FloatArray) -> dict[str, float]:
    bound = design.bound
    eigenvalues = np.linalg.eigvalsh(bound.P[0])
    return {
        "sum_half_widths": float(widths.sum()),
        "gamma": float(bound.gamma.min()),
        "decay": float(1.0 - bound.gamma.min()),
        "trace_P_inv": float((1.0 / eigenvalues).sum()),
        "log_det_P": float(np.log(eigenvalues).sum()),
        "lambda_min_P": float(eigenvalues[0]),
        "trace_P": float(eigenvalues.sum()),
    }
