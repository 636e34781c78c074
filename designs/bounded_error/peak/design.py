"""Peak bounds for the observer: design and proof."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from obsynth.designs.bounded_error.lmis import (
    ErrorKind,
    build_error_system,
    kept_coordinates,
)
from obsynth.designs.bounded_error.model import UioModel
from obsynth.designs.bounded_error.peak.bound import (
    PeakBound,
    peak_bound,
    prove_peak,
)
from obsynth.designs.bounded_error.peak.fading import fade, prove_fading
from obsynth.designs.bounded_error.peak.gain import peak_gain
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system
from obsynth.designs.bounded_error.record import PeakData, UioDesign
from obsynth.designs.bounded_error.synthesis import largest_gamma, synthesise
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.core.signals import finite_box
from obsynth.symbolic.arrays import FloatArray

if TYPE_CHECKING:
    from obsynth.designs.bounded_error.method import BoundedErrorUIO


# Of the largest feasible gamma: where the ellipsoidal design gives a good first gain.
START_SHARE = 2.0 / 3.0
FAULT_WEIGHT = 0.01


def _system(design: UioDesign) -> PeakSystem:
    family = design.family
    return peak_system(
        A=design.A,
        B_f=design.B_f,
        C=design.C,
        D=design.D,
        W1=design.W1,
        W2=design.W2,
        E=design.E,
        K=design.K,
        F=design.F,
        constant=family.constant,
        directions=family.directions,
        ranges=family.ranges,
        radius=family.radius,
    )


def _unknown_input_bound(design: UioDesign) -> FloatArray:
    box = np.abs(design.plant.box("d")).max(axis=1, initial=0.0)
    return np.where(np.isfinite(box), box, 0.0)


def bound_peak(design: UioDesign) -> UioDesign:
    """Attach proved peak bounds to a design with gains."""
    peak = peak_bound(
        _system(design),
        design.w_radius,
        design.rate,
        rounding=design.rounding,
        dbar=_unknown_input_bound(design),
    )
    return replace(design, bound=PeakData(peak.b, fade(peak, _widest_start(design))))


def _widest_start(design: UioDesign) -> FloatArray:
    """Bounds of ``|zeta_0|`` for a state anywhere in its box, and one step of every fault."""
    width = np.diff(finite_box(design.plant, "x"))[:, 0]
    return np.concatenate([np.abs(design.T) @ width, design.rate])


def design_peak(model: UioModel, method: BoundedErrorUIO) -> UioDesign:
    """Find gains with narrow peak bounds: an LMI for the start, then the bounds themselves.

    The bounds are not attached, see `bound_peak`.
    """
    design = model.design
    n, n_f = design.A.shape[0], design.rate.size
    weights = np.ones(n + n_f) if method.weights is None else np.array(method.weights)
    diagonal = not np.any(design.T - np.diag(np.diag(design.T)))
    error: ErrorKind = "shifted" if diagonal else "plain"
    system = build_error_system(design.data, error)
    kept = kept_coordinates(design.T) if diagonal else list(range(n))
    gamma = method.gamma
    if gamma is None:
        gamma = START_SHARE * largest_gamma(system, rtol=0.05)
    if gamma <= 0:
        raise InfeasibleDesign(
            "no gain makes the error contract at all vertices with one P",
            ["what helps: a smaller box of the states, or another measurement"],
            largest_gamma=0.0,
        )
    start_weights = np.concatenate([np.ones(len(kept)), np.full(n_f, FAULT_WEIGHT)])
    first = synthesise(system, gamma, None, "trace_inverse", start_weights)
    K = np.zeros_like(design.K)
    K[kept] = first.gain[: len(kept)]
    F = first.gain[len(kept) :]
    given = replace(design, K=K, F=F, options={**method.options(), "start_error": error})
    found = peak_gain(
        _system(given),
        design.w_radius,
        design.rate,
        weights=weights,
        rounding=design.rounding,
        dbar=_unknown_input_bound(design),
    )
    return replace(given, K=found.K, F=found.F)


def prove_peak_claims(design: UioDesign) -> tuple[Claim, ...]:
    """Prove the stored peak bounds from the stored data."""
    bound = peak_data(design)
    statement = "n + G b <= b: the stored b bounds every error at every k"
    try:
        proof = prove_peak(
            _system(design),
            design.w_radius,
            design.rate,
            bound.b,
            rounding=design.rounding,
            dbar=_unknown_input_bound(design),
        )
        peak = stored_bound(design)
    except (CertificateError, InfeasibleDesign) as error:
        return (Claim("peak", statement, False, -np.inf, str(error)),)
    slack = float((proof.slack / bound.b).min())
    return (
        Claim(
            "peak",
            statement,
            True,
            slack,
            f"sums of {proof.steps} powers with an enclosed remainder of {proof.remainder:.1e}, "
            "all numbers rounded up",
        ),
        Claim(
            "small_gain",
            "the spectral radius of G is below 1",
            True,
            1.0 - proof.small_gain,
            "max (G v)_i / v_i for a positive v, rounded up",
        ),
        *prove_fading(peak, bound.fading),
    )


def peak_data(design: UioDesign) -> PeakData:
    """Return the bound of a design by peaks."""
    if not isinstance(design.bound, PeakData):
        raise TypeError("the design has no peak bound")
    return design.bound


def stored_bound(design: UioDesign) -> PeakBound:
    """Return the peak bound of a design with what it was found from."""
    return peak_bound(
        _system(design),
        design.w_radius,
        design.rate,
        rounding=design.rounding,
        dbar=_unknown_input_bound(design),
    )
