"""The paper's forms as printed: Theorem 1 and equation (32), and what refuses them."""

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import exact, image, inverse, nearest, negative, positive
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.frequency import peak_gain
from obsynth.designs.core.observer import Observer
from obsynth.designs.interval.record import NEGATIVE, IntervalDesign
from obsynth.designs.interval.rows import Part
from obsynth.symbolic import ObsynthError
from obsynth.symbolic.arrays import FloatArray

FLAWS = ("y", "theta", "product")
"""Of (32): y_{k+1} in place of y_k; the upper theta_1 in the lower bound; K0 R0^-1 times bounds."""


def lipschitz_alpha(sigma_lower: FloatArray, sigma_upper: FloatArray) -> float:
    """Return alpha = 2 max{a1 + b1, a2 + b2} of Theorem 1, with the constants of (14)."""
    up = float(np.linalg.norm(positive(sigma_upper), 2))
    down = float(np.linalg.norm(negative(sigma_lower), 2))
    return 2.0 * (up + down)


def largest_alpha(R: FloatArray) -> float:
    """Return the largest alpha of (20): 1 / ||(z I - R)^-1||_inf, 0 if unstable."""
    eye = np.eye(len(R))
    return 1.0 / float(peak_gain(R[None], eye, eye, np.zeros(R.shape))[0][0])


def divergence(design: IntervalDesign, headline: str = "the bounds diverge") -> InfeasibleDesign:
    """Return the refusal for gains whose bounds are not bounded, with the numbers of Theorem 1."""
    radius = design.spectral_radius
    parts = design.prediction.split(exact(design.nominal))
    R = nearest(parts.R)
    least = float(R.min(initial=0.0))
    alpha = lipschitz_alpha(nearest(parts.sigma_lower), nearest(parts.sigma_upper))
    limit = largest_alpha(R)
    details = [
        f"the errors of one step grow by the factor {radius:.6g} (spectral radius; below 1 needed)",
        f"the condition of Theorem 1 {'is' if alpha < limit else 'is not'} met: alpha = "
        f"{alpha:.6g}, (20) is feasible for alpha below {limit:.6g}",
        'use gains="lp" with centred=True, narrower ranges of the scheduling variables, or measure '
        "more states",
    ]
    if design.bound == "paper" and least < -NEGATIVE:
        details.insert(
            0,
            f"R = P (A2 - L C2) P^-1 has an entry {least:.4g} below zero, which Theorem 1 does "
            'not allow; bound="vertex" needs no sign',
        )
        headline = "R is not nonnegative" if radius < 1.0 else headline
    return InfeasibleDesign(
        f"{headline}: spectral radius {radius:.6g}",
        details,
        radius=radius,
        alpha=alpha,
        largest_alpha=limit,
        least_entry=least,
    )


def refuse_printed(design: IntervalDesign) -> InfeasibleDesign:
    """Return the refusal of (32) as printed, for gains whose bounds are stable."""
    chosen = design.transformation
    least = float(nearest(exact(chosen.K0) @ inverse(exact(chosen.R0))).min(initial=0.0))
    details = [
        "Gamma_f takes y_{k+1} where (31) has y_k: the bounds belong to no instant",
        "the lower bound adds the upper theta_1",
        "f_k needs y_{k+1} and z_{2,k+1}: what (32) returns at k is f_{k-1}",
    ]
    if least < 0.0:
        details.append(
            f"K0 R0^-1 has an entry {least:.4g} below zero and exchanges lower and upper bounds"
        )
    details.append('form="corrected" repairs all of them')
    return InfeasibleDesign(
        "(32) as printed does not enclose the fault", details, least_entry=least
    )


def printed_faults(
    observer: Observer,
    r_lower: ArrayLike,
    r_upper: ArrayLike,
    y: ArrayLike,
    u: ArrayLike,
    flaws: Collection[str] = FLAWS,
) -> tuple[FloatArray, FloatArray]:
    """Bound the fault by (32) as printed, or with some of its flaws.

    For showing what the printed equation does; without flaws it is what the observer's step
    returns, but for rounding and cuts.

    Parameters
    ----------
    observer : Observer
        Made by `IntervalObserver`.
    r_lower, r_upper : array_like, shape (..., N, n - q)
        Bounds of r, in the memory of the observer under these names.
    y, u : array_like, shape (..., N, m), (..., N, n_u)
        Outputs and inputs of the same instants.
    flaws : collection of str
        Any of "y" (the output of k + 1 in place of that of k), "theta" (the upper noise term in
        the lower bound) and "product" (bounds times a matrix of any sign).

    Returns
    -------
    (ndarray, ndarray), each of shape (..., N - 1, n_f)
        Lower and upper bounds of the fault at all instants but the last.

    Raises
    ------
    ObsynthError
        An observer of another method; an unknown flaw.

    References
    ----------
    Lamouchi, Raissi, Amairi, Aoun: Interval observer design for actuator fault estimation of linear
    parameter-varying systems, IFAC PapersOnLine 51-24, 2018, equation (32).

    Examples
    --------
    >>> import numpy as np
    >>> from obsynth.designs import IntervalObserver, printed_faults
    >>> from obsynth.symbolic.plants import interval_example
    >>> observer = IntervalObserver().design(interval_example())
    >>> r, y, u = np.full((2, 2), 0.1), np.zeros((2, 2)), np.zeros((2, 1))
    >>> low, high = printed_faults(observer, -r, r, y, u, flaws=())
    >>> low.shape, bool((low < 0).all() and (high > 0).all())
    ((1, 1), True)
    """
    if observer.method != "interval_observer":
        raise ObsynthError(
            f"an observer of the method {observer.method!r} has no fault bounds (32)",
            method=observer.method,
        )
    unknown = set(flaws) - set(FLAWS)
    if unknown:
        raise ObsynthError(f"flaws {sorted(unknown)} are not among {FLAWS}", option="flaws")
    r_lower, r_upper, y, u = (np.asarray(a, dtype=float) for a in (r_lower, r_upper, y, u))
    design: IntervalDesign = observer.certificate.design
    model, free, chosen = design.model, design.decoupled, design.transformation
    K = exact(chosen.K0) @ inverse(exact(chosen.R0))
    rows = inverse(K) @ free.F_left
    part = Part(model, free, design.S, -rows, exact(np.zeros((model.q, len(free.N12)))))
    parts = part.split(exact(design.nominal))
    _, b, o = model.columns
    constant = model.vertices[0]
    Phi, W = nearest(rows @ free.Phi), nearest(rows @ free.W @ design.S)
    theta = image(-Phi, *image(nearest(model.W2), *nearest(model.box("w")).T))
    R, B = nearest(parts.R), nearest(part.X @ constant[:, b])
    sigma_lower, sigma_upper = nearest(parts.sigma_lower), nearest(parts.sigma_upper)
    M_lower, M_upper = nearest(parts.M_lower), nearest(parts.M_upper)

    seen = y[..., 1:, :] if "y" in flaws else y[..., :-1, :]
    low, high = r_lower[..., :-1, :], r_upper[..., :-1, :]
    low_next, high_next = r_lower[..., 1:, :], r_upper[..., 1:, :]
    known = y[..., 1:, :] @ Phi.T + u[..., :-1, :] @ B.T + nearest(part.X @ constant[:, o])[:, 0]
    upper = known + positive(seen) @ M_upper.T - negative(seen) @ M_lower.T
    lower = known + positive(seen) @ M_lower.T - negative(seen) @ M_upper.T
    upper += high_next @ positive(W).T - low_next @ negative(W).T
    lower += low_next @ positive(W).T - high_next @ negative(W).T
    upper += high @ positive(R).T - low @ negative(R).T
    lower += low @ positive(R).T - high @ negative(R).T
    upper += _product(sigma_lower, sigma_upper, low, high)
    lower -= _product(-sigma_upper, -sigma_lower, low, high)
    upper += theta[1] + nearest(parts.noise[1])
    lower += theta[1 if "theta" in flaws else 0] + nearest(parts.noise[0])
    gain = nearest(K)
    if "product" in flaws:
        return lower @ gain.T, upper @ gain.T
    plus, minus = positive(gain), negative(gain)
    return lower @ plus.T - upper @ minus.T, upper @ plus.T - lower @ minus.T


def _product(
    lower: FloatArray, upper: FloatArray, r_lower: FloatArray, r_upper: FloatArray
) -> FloatArray:
    """Upper end of (4) for an interval matrix times an interval vector."""
    value: FloatArray = (
        positive(r_upper) @ positive(upper).T
        - negative(r_upper) @ positive(lower).T
        - positive(r_lower) @ negative(upper).T
        + negative(r_lower) @ negative(lower).T
    )
    return value
