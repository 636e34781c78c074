"""Guaranteed peak (l1) bounds of every error of the general class, with their proof.

Adding up absolute impulse responses of `ErrorSystem`, with p_k the largest ``[|e_q|; |e_c|]`` up to
the instant k,

    |[e_q; e_c] at k| <= n + G p_k ,

n from disturbances, rounding and the channels that disturbances drive, G from those that errors
drive. Errors e_q at k follow from instants before, e_c at k from these and e_q at k, so if
``n + G b <= b`` then b bounds both at every k. Responses of e_q to an input B of e_p are those of
``T (A0 - back C0)`` to T B, and of e_c ``I - Z C0`` times these, so one sequence of powers serves
both. The certificate is one inequality in numbers that are all rounded up.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from obsynth.derive.rigour import TINY, Enclosure, add_up, lowered, product_up, raised
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.general.responses import PowerSum, power_sum, response
from obsynth.designs.general.system import ErrorSystem, Extra, magnitude
from obsynth.symbolic.arrays import FloatArray

# Room that the certificate leaves for other orders of summation on other machines.
SLACK = 2.0**-40


@dataclass(frozen=True, eq=False)
class Sums:
    """``n + G b`` of the bounds, and the powers that they come from. Shapes (2 N,), (2 N, 2 N)."""

    n: FloatArray
    G: FloatArray
    powers: PowerSum


def error_sums(system: ErrorSystem, extra: Extra) -> Sums:
    """Add up the responses, rounded up."""
    N, n_v = system.size, len(system.v_radius)
    h, F = system.of_h, system.of_F
    eye = Enclosure.of(np.eye(N))
    parts = [system.B_v, system.B_y, Enclosure.of(F.columns), eye]
    B = Enclosure(np.hstack([p.mid for p in parts]), np.hstack([p.rad for p in parts]))
    powers = power_sum(system.closed)
    S = response(powers, system.seen, system.T @ B).total
    at = np.cumsum([0, n_v, len(h.radii), len(F.radii), N])
    S_v, S_h, S_F, U = (S[:, a:b] for a, b in pairwise(at.tolist()))
    Z = np.abs(system.Z)
    S_v = add_up(S_v, np.vstack([magnitude(system.through), magnitude(system.direct)]))
    own = np.vstack([np.zeros((N, len(h.radii))), product_up(Z, np.abs(h.columns))])
    S_h = add_up(S_h, own)
    R_F, R_h = system.rest[:N], system.rest[N:]
    v_F, v_h = (product_up(R[:, N:], system.v_radius) for R in (R_F, R_h))
    back = magnitude(system.back)
    at_once = np.concatenate([extra.q, add_up(extra.c, product_up(Z, v_h))])
    n = add_up(
        product_up(S_v, system.v_radius),
        product_up(S_h, h.sizes(N, system.v_radius)),
        product_up(S_F, F.sizes(N, system.v_radius)),
        product_up(U, add_up(extra.p, v_F, product_up(back, v_h))),
        at_once,
    )
    drawn_h = add_up(product_up(S_h, h.coupling(N)), product_up(U, product_up(back, R_h[:, :N])))
    drawn_h[N:] = add_up(drawn_h[N:], product_up(Z, R_h[:, :N]))
    drawn_F = add_up(product_up(S_F, F.coupling(N)), product_up(U, R_F[:, :N]))
    return Sums(n, np.hstack([drawn_h, drawn_F]), powers)


def spectral_radius(matrix: FloatArray) -> float:
    """Return the largest absolute eigenvalue as computed."""
    return float(np.max(np.abs(np.linalg.eigvals(matrix)), initial=0.0))


def small_gain_solution(G: FloatArray, n: FloatArray) -> FloatArray:
    """Return a b, barely above ``(I - G)^-1 n``, with ``n + G b <= b`` in rounded-up numbers."""
    eye = np.eye(len(n))
    b = np.maximum(np.linalg.solve(eye - G, n), n)
    b = np.maximum(np.linalg.solve(eye - G, n + SLACK * b + 64.0 * TINY), n)
    for _ in range(100):
        image = add_up(n, product_up(G, b))
        if np.all(image <= b) and np.all(np.isfinite(b)):
            return b
        b = np.maximum(b, image * (1.0 + 2.0**-45))
    raise InfeasibleDesign(
        "peak bounds: the small-gain condition holds without a margin that doubles can prove",
        ["use other gains, or a smaller domain"],
        rho=spectral_radius(G),
        G=G,
    )


def contraction(G: FloatArray, b: FloatArray) -> float:
    """Return max (G v)_i / v_i for a positive v, over the errors that feed back, rounded up.

    Below one it proves that the spectral radius of G is below one.
    """
    coupled = np.flatnonzero(np.any(G, axis=0))
    if coupled.size == 0:
        return 0.0
    inner, scale = G[np.ix_(coupled, coupled)], np.maximum(b[coupled], 64.0 * TINY)
    v = np.linalg.solve(np.eye(coupled.size) - inner, scale)
    v = np.maximum(v, 2.0**-500 * np.max(np.abs(v)))
    return float(np.max(raised(product_up(inner, v) / v, 1)))


@dataclass(frozen=True, eq=False)
class PeakProof:
    """Why a vector b bounds the errors at every instant.

    slack: lower bounds of ``b - n - G b``; none is negative
    small_gain: upper bound of the spectral radius of G, below one
    remainder: upper bound of the remainder of the sums of powers, below one half, which proves that
        the error system at the middle is Schur
    steps: number of powers that were summed
    """

    slack: FloatArray
    small_gain: float
    remainder: float
    steps: int


def prove_peak(sums: Sums, b: FloatArray, names: tuple[str, ...]) -> PeakProof:
    """Prove that a given b bounds the errors, whatever it came from; names of the N errors."""
    image = add_up(sums.n, product_up(sums.G, b))
    short = ~(image <= b)
    if np.any(short):
        worst = int(np.argmax(np.where(short, (image - b) / np.maximum(image, 1e-300), -1.0)))
        raise CertificateError(
            f"peak bounds: {b[worst]:.9g} is not proved for the error of "
            f"{names[worst % len(names)]}",
            [f"n + G b = {image[worst]:.9g} exceeds it by {image[worst] - b[worst]:.3g}"],
        )
    gain = contraction(sums.G, b)
    if not gain < 1.0:
        raise CertificateError(
            "peak bounds: the spectral radius of G is not proved to be below one",
            [f"max (G v)_i / v_i = {gain:.9g}"],
            small_gain=gain,
        )
    slack = lowered(np.maximum(b - image, 0.0), 2)
    return PeakProof(slack, gain, sums.powers.contraction, sums.powers.steps)
