"""Guaranteed peak (l1) bounds of every error of the bounded-error observer, with their proof.

The errors of `PeakSystem` are driven by w, by the increments of the faults and
by the channels ``delta_j c_j' (x - xhat)`` of the Jacobian. Adding up absolute
impulse responses, with ``p_k`` the largest outputs up to the instant k,

    |outputs at k| <= n + G p_{k-1},
    n = Hw wbar + He epsbar + ...,   G = Hp diag(r) seen + Hm radius,

where ``Hw = |Q D_w| + sum_k |Q A0^k B_w|`` and so on. If ``n + G b <= b`` then b
bounds the outputs at every k: at k = 0 they are at most ``|Q D_w| wbar <= n``,
and each instant follows from those before. Nothing else is needed, so the
certificate is one inequality in numbers that are all rounded up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import Enclosure, add_up, lowered, product_up, raised
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.general.peak import (
    PeakProof,
    contraction,
    small_gain_solution,
    spectral_radius,
)
from obsynth.designs.general.responses import PowerSum, Response, power_sum, response
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class PeakBound:
    """Bounds of the errors ``x - xhat`` and ``f - fhat`` from a vanishing initial error.

    wbar, epsbar: ``|w_k| <= wbar``, ``|f_{k+1} - f_k| <= epsbar``
    rounding: bound of a further input of xi, such as the rounding of the recursion
    dbar: bound of the unknown input; it counts only where T D is not exactly zero
    b: the bounds: states, faults, then the channels with an output of their own
    n: the part without channels
    G: how the bounds feed back through the channels
    rho: spectral radius of G as computed; `proof` has an upper bound
    Hw, He, Hp: sums of the absolute impulse responses

    All numbers but `rho` are rounded up. They hold while x and xhat stay in the
    domain over which the Jacobians were bounded, and for errors before the
    estimates are rounded for output.
    """

    system: PeakSystem
    wbar: FloatArray
    epsbar: FloatArray
    rounding: FloatArray
    dbar: FloatArray
    b: FloatArray
    n: FloatArray
    G: FloatArray
    rho: float
    Hw: FloatArray
    He: FloatArray
    Hp: FloatArray
    proof: PeakProof

    @property
    def steady(self) -> FloatArray:
        """Half widths once the initial error has gone, shape (n + n_f,), states first."""
        return self.b[: self.system.n + self.system.n_f]

    def check(self) -> PeakProof:
        """Form the system again from its data and prove the stored `b`."""
        system = peak_system(**self.system.data)
        return prove_peak(
            system, self.wbar, self.epsbar, self.b, rounding=self.rounding, dbar=self.dbar
        )


def peak_bound(
    system: PeakSystem,
    wbar: ArrayLike,
    epsbar: ArrayLike,
    *,
    rounding: ArrayLike | None = None,
    dbar: ArrayLike | None = None,
) -> PeakBound:
    """Compute and prove peak bounds for given gains."""
    box = _inputs(system, wbar, epsbar, rounding, dbar)
    sums = _sums(system, *box)
    rho = spectral_radius(sums.G)
    if not rho < 1.0:
        strongest = int(np.argmax(np.max(sums.G, axis=0)))
        raise InfeasibleDesign(
            f"peak bounds: the small-gain condition fails, spectral radius of G is {rho:.6g}",
            [
                "the Jacobian varies too much for these gains; the strongest feedback is through "
                + _output_name(system, strongest),
                "use other gains, or a smaller domain",
            ],
            rho=rho,
            G=sums.G,
        )
    b = small_gain_solution(sums.G, sums.n)
    proof = _prove(system, sums, b)
    wbar, epsbar, rounding, dbar = box
    return PeakBound(
        system=system,
        wbar=wbar,
        epsbar=epsbar,
        rounding=rounding,
        dbar=dbar,
        b=b,
        n=sums.n,
        G=sums.G,
        rho=rho,
        Hw=sums.Hw,
        He=sums.He,
        Hp=sums.Hp,
        proof=proof,
    )


def prove_peak(
    system: PeakSystem,
    wbar: ArrayLike,
    epsbar: ArrayLike,
    b: ArrayLike,
    *,
    rounding: ArrayLike | None = None,
    dbar: ArrayLike | None = None,
) -> PeakProof:
    """Prove that a given b bounds the errors, whatever it came from."""
    sums = _sums(system, *_inputs(system, wbar, epsbar, rounding, dbar))
    return _prove(system, sums, _sized("b", b, len(system.outputs)))


@dataclass(frozen=True, eq=False)
class _Sums:
    n: FloatArray
    G: FloatArray
    Hw: FloatArray
    He: FloatArray
    Hp: FloatArray
    powers: PowerSum


def channel_inputs(system: PeakSystem) -> tuple[Enclosure, FloatArray]:
    """Return the inputs of the uncertainty of the Jacobian and how the outputs drive them."""
    coupling = raised(system.channels.radii[:, None] * system.seen, 1)
    coupling[system.seen == 0.0] = 0.0
    if not np.any(system.radius):
        return system.B_p, coupling
    entrywise = np.zeros((system.n, len(system.outputs)))
    entrywise[:, : system.n] = system.radius
    B = Enclosure(
        np.hstack([system.B_p.mid, system.B_m.mid]), np.hstack([system.B_p.rad, system.B_m.rad])
    )
    return B, np.vstack([coupling, entrywise])


def _sums(
    system: PeakSystem,
    wbar: FloatArray,
    epsbar: FloatArray,
    rounding: FloatArray,
    dbar: FloatArray,
) -> _Sums:
    powers = power_sum(system.A0)
    Q, size = system.outputs, system.A0.mid.shape[0]

    def total(B: Enclosure) -> Response:
        return response(powers, Q, B)

    through = product_up(np.abs(Q), raised(np.abs(system.D_w.mid) + system.D_w.rad, 1))
    Hw = add_up(through, total(system.B_w).total)
    unit = total(Enclosure.of(np.eye(size))).total
    He = unit[:, system.n :]
    B, coupling = channel_inputs(system)
    Hc = total(B).total
    extra = rounding.copy()
    if np.any(system.residual):
        extra[: system.n] = add_up(extra[: system.n], product_up(system.residual, dbar))
    n = product_up(Hw, wbar)
    for H, size_of_input in ((He, epsbar), (unit, extra)):
        if np.any(size_of_input):
            n = add_up(n, product_up(H, size_of_input))
    G = np.zeros((len(Q), len(Q)))
    driven = np.any(coupling, axis=0)
    G[:, driven] = product_up(Hc, coupling[:, driven])
    return _Sums(n=n, G=G, Hw=Hw, He=He, Hp=Hc[:, : len(system.channels)], powers=powers)


def _prove(system: PeakSystem, sums: _Sums, b: FloatArray) -> PeakProof:
    image = add_up(sums.n, product_up(sums.G, b))
    slack = lowered(np.maximum(b - image, 0.0), 2)
    short = ~(image <= b)
    if np.any(short):
        shortfall = np.where(short, image - b, 0.0)
        worst = int(np.argmax(np.where(short, shortfall / np.maximum(image, 1e-300), -1.0)))
        raise CertificateError(
            f"peak bounds: {b[worst]:.9g} is not proved for {_output_name(system, worst)}",
            [f"n + G b = {image[worst]:.9g} exceeds it by {shortfall[worst]:.3g}"],
            output=worst,
            shortfall=float(shortfall[worst]),
        )
    gain = contraction(sums.G, b)
    if not gain < 1.0:
        raise CertificateError(
            "peak bounds: the spectral radius of G is not proved to be below one",
            [f"max (G v)_i / v_i = {gain:.9g}"],
            small_gain=gain,
        )
    return PeakProof(
        slack=slack,
        small_gain=gain,
        remainder=sums.powers.contraction,
        steps=sums.powers.steps,
    )


def _inputs(
    system: PeakSystem,
    wbar: ArrayLike,
    epsbar: ArrayLike,
    rounding: ArrayLike | None,
    dbar: ArrayLike | None,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    box = np.asarray(wbar, dtype=float)
    if box.ndim == 2 and box.shape[1] == 2:
        box = np.max(np.abs(box), axis=1)
    q = system.D.shape[1]
    if np.any(system.residual) and dbar is None:
        raise ObsynthError(
            f"T D is not exactly zero in doubles (up to {np.max(system.residual):.3g}), so the "
            "unknown input has a small effect: give dbar, a bound of it, however large",
            residual=system.residual,
        )
    size = system.n + system.n_f
    return (
        _sized("wbar", box, system.B_w.mid.shape[1]),
        _sized("epsbar", epsbar, system.n_f),
        _sized("rounding", np.zeros(size) if rounding is None else rounding, size),
        _sized("dbar", np.zeros(q) if dbar is None else dbar, q),
    )


def _sized(name: str, value: ArrayLike, size: int) -> FloatArray:
    array = np.asarray(value, dtype=float)
    if array.shape != (size,):
        raise ObsynthError(
            f"{name} has shape {array.shape}, it has to be ({size},)",
            argument=name,
            shape=array.shape,
        )
    if not np.all((array >= 0) & np.isfinite(array)):
        raise ObsynthError(
            f"{name} = {array.tolist()} has an entry that is negative or not finite; it bounds "
            "absolute values",
            argument=name,
        )
    return array


def _output_name(system: PeakSystem, index: int) -> str:
    n, n_f = system.n, system.n_f
    if index < n:
        return f"the error of state {index + 1}"
    if index < n + n_f:
        return f"the error of fault {index - n + 1}"
    row = system.outputs[index, :n]
    return "the combination " + " + ".join(f"{row[i]:g} e{i + 1}" for i in np.flatnonzero(row))
