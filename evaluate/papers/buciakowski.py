"""Buciakowski et al.: what is printed of the bounded-error observer, and what holds."""

import re
from collections.abc import Iterator

import numpy as np

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.designs import BoundedErrorUIO, InfeasibleDesign
from obsynth.evaluate.papers.claim import Claim
from obsynth.symbolic import Plant, plants, scenarios

# M_min and M_max of Section 6, by row and column from 1.
PRINTED_BOUNDS = {
    (1, 1): (0.0026, 0.0065),
    (1, 3): (-0.0144, 0.0039),
    (2, 2): (0.0008, 0.0033),
    (2, 4): (-0.0078, 0.0037),
    (3, 3): (-0.0039, 0.0144),
    (4, 4): (-0.0037, 0.0078),
}
PRINTED_GAMMA = 0.01
PRINTED_Z0 = (125.0, 165.0, 25.0, 35.0)
# Of (51) as printed, and of the direct LMI at the printed gamma.
Refusals = tuple[InfeasibleDesign, InfeasibleDesign]

_GAMMA = 0.005


def tank() -> Plant:
    """Return the plant of Section 6, sampled every second by Euler's rule."""
    return plants.quadruple_tank().discretise("euler", Ts=1.0)


def ask(parts: Split, bounds: JacobianBounds) -> Refusals:
    """Ask for what the paper solves, and return why there is none of it."""
    found = []
    for form in ("printed", "corrected"):
        method = BoundedErrorUIO(form=form, gamma=PRINTED_GAMMA)
        try:
            method.design(parts, bounds)
        except InfeasibleDesign as error:
            found.append(error)
        else:
            raise InfeasibleDesign(f"form={form!r} was expected to be infeasible and is not")
    return found[0], found[1]


def claims() -> Iterator[Claim]:
    """Derive, ask for the printed designs, and compare what (49) makes with what is least."""
    parts = split(tank())
    bounds = jacobian_bounds(parts)
    yield from claims_of(parts, bounds, ask(parts, bounds))
    sums = [
        BoundedErrorUIO(gamma=_GAMMA, objective=objective).design(parts, bounds)
        for objective in ("trace", "trace_inverse")
    ]
    by_trace, least = (float(o.performance["core_half_widths"].sum()) for o in sums)
    yield Claim(
        "(49)",
        "max trace(P) makes the set small",
        f"half widths of {by_trace:.2f} in sum; min trace(P⁻¹), which bounds them, {least:.2f}",
        by_trace <= least,
    )


def claims_of(parts: Split, bounds: JacobianBounds, refusals: Refusals) -> Iterator[Claim]:
    """Say what holds of Section 6 and of the formulas it uses."""
    printed, direct = refusals
    for (i, j), (low, high) in PRINTED_BOUNDS.items():
        least, most = float(bounds.min[i - 1, j - 1]), float(bounds.max[i - 1, j - 1])
        # the printed ones are those of forward differences of 1 cm, which miss the ends of the box
        narrow = low > least + 6e-5 or high < most - 6e-5
        yield Claim(
            f"Section 6, M, entry {i}{j}",
            f"[{low:.4f}, {high:.4f}]".replace("-", "−"),
            f"[{least:.6f}, {most:.6f}]{', printed too narrow' * narrow}".replace("-", "−"),
            not narrow,
        )
    count = len(bounds.vertices())
    naive = bounds.naive_vertex_count
    # a constant of 1e-17 is what the doubles of A leave of the exact dependence
    why = [
        re.sub(r" (?:[+-]|up to) [\d.]+e-1[5-9]", "", str(dependence).split("; ")[0])
        for dependence in bounds.dependences
        if dependence.coefficients
    ]
    yield Claim(
        "Remark 2",
        "N = 2^((n−c)²) vertices",
        f"{naive} = 2⁶ for six varying entries; {count} suffice: {'; '.join(why)}",
        count == naive,
    )
    E = -parts.D @ np.linalg.pinv(parts.C @ parts.D)
    n, m = parts.A.shape[0], parts.C.shape[0]
    yield Claim(
        "(18)",
        "the third block of Wbar is E W1",
        f"E W2; E is {n}×{m} and W1 has {n} rows, so E W1 is no product",
        n == m,
    )
    point = printed.certificate
    vector = ", ".join(f"{float(v):.4g}" for v in point.e_f)
    forms = f"{float(point.q1):.3g}, {float(point.q2):.3g}"
    yield Claim(
        "(51)",
        f"has a solution, γ = {PRINTED_GAMMA:g}",
        "infeasible for every γ and gain: an exact fixed point of the error, e = (0, 0, 0, 1), "
        f"e_f = ({vector}), has both quadratic forms ≥ 0: {forms}",
        False,
    )
    largest = direct.largest_gamma
    yield Claim(
        "Section 6",
        f"γ = {PRINTED_GAMMA:g}",
        f"above the largest feasible value of the direct LMI, {largest:.5f}",
        largest >= PRINTED_GAMMA,
    )
    corner = 100 * float(np.sum(parts.model.box("w")[:, 1] ** 2))
    yield Claim(
        "Section 6",
        "Q_w = 100 I holds the noise",
        f"a corner of the cube gives w'Q_w w = {corner:g}; (100/3) I holds it",
        corner <= 1.0,
    )
    x0 = np.asarray(scenarios.quadruple_tank("FS1").x0)
    off = x0 - (PRINTED_Z0 - E @ (parts.C @ x0))
    e0 = ", ".join(f"{v:.1f}".replace("-", "−") for v in off)
    yield Claim(
        "Section 6",
        "z_0 is 5 cm off in every level",
        f"x̂_0 = z_0 − E y_0, so e_0 = ({e0})",
        bool(np.allclose(np.abs(off), 5.0)),
    )
