"""Proofs for the numbers as they are stored, and that they speak of the stored plant."""

from collections.abc import Iterator

import numpy as np

from obsynth.derive.rigour import ExactMatrix
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.signals import prove_boxes, within
from obsynth.designs.set_adaptive.bounds import BLOCKS
from obsynth.designs.set_adaptive.gain import settled_response
from obsynth.designs.set_adaptive.model import SetModel
from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.designs.set_adaptive.transition import LARGEST_PRODUCT
from obsynth.symbolic.arrays import FloatArray

_EXACT = "exact rational arithmetic on the stored numbers"


def claims(design: SetDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    yield _signs(design)
    yield _boxes(design)
    yield _metzler(design)
    yield _decay(design, "decay", design.A_upper, design.alpha, "the continuous form")
    yield _decay(design, "decay_step", design.A_upper_step, design.alpha_step, "the frozen bounds")
    if design.coordinates is not None:
        yield _coordinates(design)
    yield _uniformisation(design)
    yield _law(design)


def covers(design: SetDesign, fresh: SetModel) -> Iterator[Claim]:
    """Compare the stored form, bounds and rates with those derived from the stored equations."""
    yield _model(design, fresh)
    yield _bounds(design, fresh)
    yield _speed(design, fresh)


def _signs(design: SetDesign) -> Claim:
    own = design.coordinates is None
    low = float(design.plant.box("x")[:, 0].min()) if own else 0.0
    smallest = float(design.C.min(initial=np.inf))
    where = "x >= 0 over the declared ranges and C >= 0 (Assumption 1)" if own else "C >= 0"
    return Claim(
        "signs",
        f"{where}; {'' if own else 'x and '}G of any sign",
        bool(low >= 0.0 and smallest >= 0.0),
        min(low, smallest),
        "comparison",
    )


def _boxes(design: SetDesign) -> Claim:
    box = design.plant.box("w") if design.noisy else np.zeros((len(design.w_centre), 2))
    what = "hold the declared disturbances" if design.noisy else "are zero, as assumed"
    return prove_boxes(what, box, design.w_centre, design.w_radius)


def _metzler(design: SetDesign) -> Claim:
    own = design.coordinates is None
    entries = _error_matrix(design, design.A_lower_box).to_fractions()
    outside = [entries[i][j] for i in range(len(entries)) for j in range(len(entries)) if i != j]
    margin = min(outside, default=0)
    return Claim(
        "metzler",
        "A_m - L C is a Metzler matrix for all ends of the outputs in their ranges"
        if own
        else "D is a Metzler matrix",
        margin >= 0,
        float(margin),
        _EXACT,
    )


def _decay(design: SetDesign, name: str, A_upper: FloatArray, alpha: float, what: str) -> Claim:
    p, own = ExactMatrix.of(design.p[None]), design.coordinates is None
    margin = min(((-alpha) * p - p @ _error_matrix(design, A_upper)).to_fractions()[0])
    return Claim(
        name,
        f"p'{'(A_M - L C)' if own else 'D'} <= -{alpha:.7g} p' with p > 0: {what} decays",
        bool(margin >= 0 and alpha > 0.0 and design.p.min() > 0.0),
        float(margin),
        _EXACT,
    )


def _uniformisation(design: SetDesign) -> Claim:
    diagonal = np.diag(design.error_matrix(design.A_lower_box))
    matrix = "(A_o - L C)" if design.coordinates is None else "D"
    room = float((design.mu + diagonal).min())
    product = design.Ts * design.mu
    return Claim(
        "transition",
        f"I + {matrix} / mu is nonnegative for mu = {design.mu:.6g}, so every term of the "
        f"exponential over Ts = {design.Ts:g} is",
        bool(room > 1e-13 * design.mu and 0.0 < product <= LARGEST_PRODUCT),
        room,
        "comparison",
    )


def _error_matrix(design: SetDesign, A: FloatArray) -> ExactMatrix:
    """Return A - L C exactly, or D in coordinates of their own."""
    if design.coordinates is not None:
        return ExactMatrix.of(design.coordinates.D)
    return ExactMatrix.of(A) - ExactMatrix.of(design.L) @ ExactMatrix.of(design.C)


def _coordinates(design: SetDesign) -> Claim:
    """Prove that S tells the states apart: its exact inverse exists, or reading it had failed."""
    frame, given = design.frame, design.coordinates
    size = 0.0
    if frame.back is not None and given is not None:
        size = float(np.abs(given.S).sum(axis=1).max() * np.abs(frame.back).sum(axis=1).max())
    return Claim(
        "coordinates",
        "z = S x tells the states apart; z' = D z + (S A - D S - L C) x + L C x + ... for the "
        "stored S, D and L, the second term between bounds of x",
        bool(size > 0.0 and np.isfinite(size)),
        1.0 / max(size, 1.0),
        _EXACT,
    )


def _law(design: SetDesign) -> Claim:
    margin = float(design.Gamma.min(initial=np.inf))
    if design.law == "printed":
        statement = "the printed law: its order is not guaranteed, so no fault bound is reported"
    else:
        statement = "with Gamma > 0 a step of theta is a mean of bounds"
    return Claim("law", statement, margin > 0.0, margin, "comparison")


def _model(design: SetDesign, fresh: SetModel) -> Claim:
    names = ("C", "G", "W1", "W2")
    same = all(np.array_equal(getattr(design, name), getattr(fresh, name)) for name in names)
    return Claim(
        "model",
        "A(rho) x + B u + offset + G theta + W1 w equals the stored dynamics, C x + W2 w the "
        "outputs",
        bool(same and fresh.form.proof.holds),
        0.0,
        str(fresh.form.proof),
    )


def _bounds(design: SetDesign, fresh: SetModel) -> Claim:
    mine, derived = design.bounds, fresh.bounds
    same = [s.name for s in mine.states] == [s.name for s in derived.states]
    for side in ("lower", "upper"):
        for block in BLOCKS:
            same = same and getattr(mine, side)[block] == getattr(derived, side)[block]
    low, high = fresh.A_span
    high_step = fresh.extremes(design.Ts)[1]
    room = min(
        float((high_now - high_fresh).min())
        for high_now, high_fresh in (
            (low, design.A_lower),
            (fresh.A_lower_box, design.A_lower_box),
            (design.A_upper, high),
            (design.A_upper_step, high_step),
        )
    )
    return Claim(
        "bounds",
        "A_m <= A(rho) <= A_M elementwise between the ends of the outputs, and their extremes "
        "over the ranges are the stored ones",
        bool(same and room >= 0.0),
        room,
        "monotonicity of entries and terms, interval branch and bound with outward rounding",
    )


def _speed(design: SetDesign, fresh: SetModel) -> Claim:
    pairs = [(design.rate, design.input_rate, fresh.rate, fresh.input_rate)]
    if design.coordinates is not None:
        pairs.append((design.coordinates.rate, design.coordinates.input_rate, *fresh.motion))
    room = min(
        min(float((new[:, 0] - old[:, 0]).min()), float((old[:, 1] - new[:, 1]).min()))
        for old, _, new, _ in pairs
    )
    same = all(np.array_equal(old, new) for _, old, _, new in pairs)
    who = "outputs" if design.coordinates is None else "outputs and states"
    return Claim(
        "speed",
        f"between two samples the {who} move no faster than the stored rates",
        bool(room >= 0.0 and same),
        room,
        "interval branch and bound with outward rounding",
    )


def numbers(design: SetDesign) -> Numbers:
    """Return gains and performance; the steady widths are not predicted."""
    gains = {"L": design.L, "p": design.p, "Gamma": design.Gamma}
    if design.coordinates is not None and design.frame.back is not None:
        gains |= {"L": design.frame.back @ design.L, "S": design.coordinates.S}
    return Numbers(gains, _performance(design))


def guarantee(design: SetDesign) -> Guarantee:
    """Return what is promised of the intervals, and what has to hold for it."""
    plant = design.plant
    x, f = ", ".join(plant.names("x")), ", ".join(plant.names("f"))
    shown = ", ".join(s.name for s in design.bounds.states)
    if design.law == "cooperative":
        claims = [
            f"{f}, constant, lie in [f_lower, f_upper] at every sample; so a constant fault of "
            "zero is never excluded (no false alarm)",
            f"{x} lie in [x_lower, x_upper] at every sample",
            "after a fault has changed, its interval holds the new value again up to an error "
            f"that decays (rate {design.alpha_step:.3g} per second of the states, then Gamma); "
            "during that time it need not",
            f"the step is exact for the bounding systems: no discretisation error, for every Ts up "
            f"to {LARGEST_PRODUCT / design.mu:.3g} s",
            "the exact solution of ode, fed with y(t) and u(t), gives bounds of the same kind; "
            "what an integration formula leaves out is not covered",
        ]
    else:
        claims = [
            "zeta, Omega and xi stay bounded; neither fault bounds nor state bounds are "
            "guaranteed by the printed law, so what is returned are the declared ranges and what "
            "the readings say",
        ]
    assumptions = [
        f"the plant is {plant.name} in continuous time, its inputs held between the samples "
        f"(Ts = {design.Ts:g} s)",
        f"the states stay in {within(plant.x, units=True)} at all times "
        f"[monitored for {shown}: status bit 8]",
        "the faults are constant and lie in the box given to memory0, later in their ranges",
        f"a fault within {', '.join(f'[{s.lower:g}, {s.upper:g}]' for s in plant.f)} moves the "
        "outputs between the samples",
    ]
    if plant.w:
        if design.noisy:
            assumptions.append(f"{within(plant.w)} [monitored in part: status bit 8]")
        else:
            assumptions.append(f"the disturbances {', '.join(plant.names('w'))} are zero")
    assumptions.append(
        f"the step is evaluated in IEEE {design.precision} precision: the rounding errors of one "
        f"step stay below {design.rounding:.1e} of the size of its terms, which is "
        "added to the bounds"
    )
    return Guarantee(tuple(claims), tuple(assumptions))


def _performance(design: SetDesign) -> dict[str, float]:
    fastest = float((-np.diag(design.error_matrix(design.A_lower))).max())
    frame, M = design.frame, design.error_matrix(design.A_upper)
    shown = settled_response(-M, frame.C, frame.G)
    shown = shown[design.fault_outputs, np.arange(len(design.Gamma))]
    return {
        "decay": design.alpha,
        "decay_step": design.alpha_step,
        "alpha": design.alpha,
        "adaptation": float((design.Gamma * shown**2).max()),
        "euler_step": 1.0 / fastest,
        "longest_step": LARGEST_PRODUCT / design.mu,
    }
