"""Ellipsoids and energy gains as they are stored: backed off until they are proved, and proofs.

Also how much of an energy gain is attained at a Jacobian that stays as it is: searched, not proved.
"""

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction

import numpy as np

from obsynth.derive.rigour import Enclosure, prove_positive_definite
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import CertificateError, SolverTrouble
from obsynth.designs.core.frequency import peak_gain
from obsynth.designs.general.lmis import Loop, closed_rows, error_loop, storage_block
from obsynth.designs.general.record import EllipsoidBound, EnergyBound, GeneralDesign
from obsynth.designs.general.synthesis import Found
from obsynth.designs.general.system import error_system
from obsynth.designs.lmi.proof import RUMP, inverse_bounds, prove_inverse
from obsynth.symbolic.arrays import FloatArray

# What P gives up until rounding and the solver's tolerance have their margin.
LOSSES = (0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3)
CORNERS = 48


def with_ellipsoid(design: GeneralDesign, found: Found) -> GeneralDesign:
    """Attach an ellipsoid to a design with a gain, P made smaller until it is proved."""
    design = design.changed(Z=found.Z)
    loop = error_loop(error_system(design))
    for loss in LOSSES:
        P = found.P * (1.0 - loss)
        bound = EllipsoidBound(P, found.gamma, found.noise, found.tau * (1.0 - loss), np.ones(0))
        if invariance(design, bound, loop).holds:
            bound = replace(bound, inverse_diagonal=inverse_bounds(P, np.eye(len(P))))
            return design.changed(bound=bound)
    raise SolverTrouble(
        "the ellipsoid that was found is not proved",
        ['give another gamma=, or bounds="peak"'],
        gamma=found.gamma,
    )


def with_energy(
    design: GeneralDesign, found: Found, weights: FloatArray, attained: float
) -> GeneralDesign:
    """Attach an energy gain to a design with a gain, raised until it is proved."""
    design = design.changed(Z=found.Z)
    loop = error_loop(error_system(design))
    for loss in LOSSES:
        bound = EnergyBound(found.P, found.level * (1.0 + loss), weights, found.tau, attained)
        if dissipation(design, bound, loop).holds:
            return design.changed(bound=bound)
    raise SolverTrouble(
        f"an energy gain of {found.level:.6g} was found, but none up to .1 % above it is proved",
        ["give other weights="],
        level=found.level,
    )


def prove_storage(design: GeneralDesign) -> Iterator[Claim]:
    """Prove every inequality behind the stored ellipsoid or energy gain."""
    bound = design.bound
    loop = error_loop(error_system(design))
    if isinstance(bound, EllipsoidBound):
        yield _simplex(bound)
        yield invariance(design, bound, loop)
        yield _half_widths(bound)
    elif isinstance(bound, EnergyBound):
        yield _multipliers(bound)
        yield dissipation(design, bound, loop)


def _tau(loop: Loop, tau: FloatArray) -> Enclosure | None:
    _, _, n_q = loop.sizes
    if len(tau) != n_q:
        raise CertificateError(
            f"the stored design has {len(tau)} multipliers; the error system has {n_q} channels"
        )
    return Enclosure.of(np.diag(tau)) if n_q else None


def _one(value: float) -> Enclosure:
    return Enclosure.of(np.array([[value]]))


def _closed(design: GeneralDesign, P: FloatArray, loop: Loop) -> Enclosure:
    return Enclosure.of(P) @ closed_rows(loop, design.Z)


def invariance(design: GeneralDesign, bound: EllipsoidBound, loop: Loop) -> Claim:
    """Prove that V <= 1 is invariant."""
    _, n_w, _ = loop.sizes
    if len(bound.noise) != n_w:
        raise CertificateError(
            f"the stored design has {len(bound.noise)} weights; the error system has {n_w} "
            "disturbances"
        )
    block = storage_block(
        Enclosure.of(bound.P),
        _closed(design, bound.P, loop),
        _one(1.0) - _one(bound.gamma),
        Enclosure.of(np.diag(bound.noise)) if n_w else None,
        _tau(loop, bound.tau),
        loop.z,
    )
    return _definite(
        "lmi", "V+ <= (1 - gamma) V + v'N v for every Jacobian of the stored family", block
    )


def dissipation(design: GeneralDesign, bound: EnergyBound, loop: Loop) -> Claim:
    """Prove the energy gain."""
    _, n_w, _ = loop.sizes
    C = Enclosure.of(np.diag(bound.weights))
    block = storage_block(
        Enclosure.of(bound.P),
        _closed(design, bound.P, loop),
        _one(1.0),
        Enclosure.of(np.eye(n_w)) * (_one(bound.mu) * bound.mu) if n_w else None,
        _tau(loop, bound.tau),
        loop.z,
        C @ C,
    )
    return _definite(
        "lmi",
        f"V+ - V + |C e|^2 < mu^2 |v|^2 with mu = {bound.mu:.9g} for every Jacobian of the stored "
        "family",
        block,
    )


def _definite(name: str, statement: str, block: Enclosure) -> Claim:
    result = prove_positive_definite(block)
    return Claim(name, statement, result.all_proved, float(result.relative.min()), RUMP)


def _simplex(bound: EllipsoidBound) -> Claim:
    room = Fraction(bound.gamma) - sum(map(Fraction, bound.noise.tolist()), Fraction(0))
    least = min([0.0, *bound.noise.tolist(), *bound.tau.tolist()])
    return Claim(
        "weights",
        "v'N v <= gamma for every admissible v, multipliers are not negative and 0 < gamma < 1",
        bool(room >= 0 and least >= 0.0 and 0.0 < bound.gamma < 1.0),
        float(room) if least >= 0.0 else least,
        "exact sum of the weights over the boxes",
    )


def _multipliers(bound: EnergyBound) -> Claim:
    least = min([bound.mu, *bound.tau.tolist()])
    return Claim(
        "multipliers",
        "multipliers are not negative and mu > 0",
        bool(least >= 0.0 and bound.mu > 0.0),
        float(least),
        "comparison",
    )


def _half_widths(bound: EllipsoidBound) -> Claim:
    statement = "(P^-1)_ii stays below the stored value for every component"
    proof = prove_inverse(bound.P, np.eye(len(bound.P)), bound.inverse_diagonal)
    return Claim("half_widths", statement, *proof, RUMP)


def attained_gain(design: GeneralDesign, weights: FloatArray) -> float:
    """Return the largest gain from v, in units of its bounds, to the weighted errors."""
    family, N, radius = design.family, design.size, design.v_radius
    loop = error_loop(error_system(design))
    if not len(radius):
        return 0.0
    picks = np.random.default_rng(0).integers(0, 2, (CORNERS, len(family.ranges)))
    corners = family.ranges[np.arange(len(family.ranges)), picks]
    corners = np.vstack([family.ranges.mean(axis=1), corners])
    J = family.constant + np.tensordot(corners, family.directions, axes=1)
    A, W, C, V = J[:, :N, :N], J[:, :N, N:] * radius, J[:, N:, :N], J[:, N:, N:] * radius
    kept = (np.eye(N) - design.Z @ C) @ (np.eye(N) - design.L0 @ C)
    shown = design.L0 @ V + design.Z @ (V - C @ (design.L0 @ V))
    # what stands in rows and outputs counts twice
    count = np.bincount(np.append(loop.before, loop.after), minlength=len(radius))
    share = np.where(count > 0, 1.0 / np.sqrt(np.maximum(count, 1)), 0.0)
    # e+ = kept (A e + W v) - shown v+, its part that v+ moves at once taken apart
    closed, output = kept @ A, np.diag(weights)
    drive = (kept @ W - closed @ shown) * share
    return float(peak_gain(closed, drive, output, -output @ shown * share)[0].max())
