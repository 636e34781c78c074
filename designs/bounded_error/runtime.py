"""From a proved bound to what runs: half-width recursions and their first values."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from obsynth.designs.bounded_error.error_system import kept_coordinates
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign, ellipsoid_of
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

ROUND_UP = 1.0 + 2.0**-50
# covers the rounding of estimate - half and estimate + half
ULPS = 2.0**-50
# Above the relative rounding error of the few dozen operations of each formula below.
UP = 1.0 + 2.0**-44
CORNERS = 14


@dataclass(frozen=True, eq=False)
class RuntimeBound:
    """How the guaranteed half widths evolve, one scalar recursion per component.

    ``s+ = decay * s + offset``; the half width of a component is
    ``sqrt(s * scale) + add`` if `root` is set (ellipsoids, eqs. (35)-(36)) and
    ``s * scale + add`` otherwise (peak bounds). All arrays have shape (n + n_f,).

    reset: value of s that holds whenever the state, the fault and their estimates lie in the
        declared boxes; infinite where no such box is declared
    """

    decay: FloatArray
    offset: FloatArray
    scale: FloatArray
    add: FloatArray
    root: bool
    reset: FloatArray

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = s * self.scale
        return (np.sqrt(inner) if self.root else inner) * ROUND_UP + self.add

    @property
    def steady(self) -> FloatArray:
        """Half widths in the limit k to infinity."""
        return self.half_widths(self.offset / (1.0 - self.decay))


def noise_offset(design: UioDesign) -> FloatArray:
    """Return the bound of ``E W2 w_k``, which separates e from zeta, shape (n,)."""
    bound: FloatArray = np.abs(design.E) @ (np.abs(design.W2) @ design.w_radius) * UP
    return bound


def largest_level(P: FloatArray, lower: FloatArray, upper: FloatArray) -> float:
    """Return an upper bound of ``xi'P xi`` over a box: the delta of eq. (48).

    Exact up to rounding at the corners for up to 14 components, by the sum of
    ``|P_ij| r_i r_j`` beyond.
    """
    reach = np.maximum(np.abs(lower), np.abs(upper))
    rounding = 2.0**-40 * float(reach @ np.abs(P) @ reach)
    if len(P) > CORNERS:
        return float(reach @ np.abs(P) @ reach) * UP + rounding
    pairs = [(a, b) if a != b else (a,) for a, b in zip(lower, upper, strict=True)]
    corners = np.array(list(itertools.product(*pairs)))
    levels = np.einsum("ki,ij,kj->k", corners, P, corners)
    return float(levels.max()) + rounding


class StartBox:
    """Where the error can be at k = 0, as boxes of zeta, e and e_f.

    z0 (n,)
    x_range (n, 2)
    fhat0 (n_f,)
    f_range (n_f, 2)
    """

    def __init__(
        self,
        design: UioDesign,
        z0: FloatArray,
        x_range: FloatArray,
        fhat0: FloatArray,
        f_range: FloatArray,
    ) -> None:
        middle, radius = x_range.mean(axis=1), 0.5 * (x_range[:, 1] - x_range[:, 0])
        reach = np.abs(design.T) @ (np.abs(middle) + radius) + np.abs(z0)
        slack = 2.0**-44 * reach
        spread = np.abs(design.T) @ radius + slack
        centre = design.T @ middle - z0
        noise = noise_offset(design)
        self.zeta = (centre - spread, centre + spread)
        self.e = (self.zeta[0] - noise, self.zeta[1] + noise)
        self.e_f = (f_range[:, 0] - fhat0, f_range[:, 1] - fhat0)

    def xi(self, design: UioDesign, error: str) -> tuple[FloatArray, FloatArray]:
        """Box of the error coordinates, (lower, upper)."""
        if error == "plain":
            sides = self.e
        else:
            kept = kept_coordinates(design.T)
            sides = (self.zeta[0][kept], self.zeta[1][kept])
        return (
            np.concatenate([sides[0], self.e_f[0]]),
            np.concatenate([sides[1], self.e_f[1]]),
        )


def _component_map(design: UioDesign, bound: EllipsoidBound) -> list[int | None]:
    """For each of the n + n_f errors the component of xi that bounds it, or None."""
    n, n_f = design.A.shape[0], design.rate.size
    if bound.error == "plain":
        return list(range(n + n_f))
    kept = kept_coordinates(design.T)
    states: list[int | None] = [kept.index(i) if i in kept else None for i in range(n)]
    return states + [len(kept) + j for j in range(n_f)]


def ellipsoid_runtime(design: UioDesign) -> RuntimeBound:
    """Return the recursion of eq. (36) for every component, rounding errors of the step included.

    An error of at most `UioDesign.rounding` per step is at most rho in the norm
    of P, so ``V+ <= ((1 - gamma) V + gamma) (1 + rho) + rho + rho^2``.
    """
    bound = ellipsoid_of(design)
    n, n_f = design.A.shape[0], design.rate.size
    size = n + n_f
    decay, offset, scale = np.zeros(size), np.zeros(size), np.zeros(size)
    add = design.rounding * UP
    if bound.error == "shifted":
        add[:n] += noise_offset(design)
    reset = np.full(size, np.inf)
    box = reset_box(design)
    for i, component in enumerate(_component_map(design, bound)):
        if component is None:
            continue
        shape = bound.shape_of(component)
        gamma, P = float(bound.gamma[shape]), bound.P[shape]
        kept = [j for j, c in enumerate(_component_map(design, bound)) if c is not None]
        tau = design.rounding[kept]
        rho = float(np.sqrt(tau @ np.abs(P) @ tau)) * UP
        decay[i] = (1.0 - gamma) * (1.0 + rho) * UP
        offset[i] = (gamma * (1.0 + rho) + rho + rho**2) * UP
        scale[i] = bound.inverse_diagonal[component] * UP
        if box is not None:
            reset[i] = largest_level(P, *box.xi(design, bound.error))
    return RuntimeBound(decay, offset, scale, add, True, reset)


def reset_box(design: UioDesign) -> StartBox | None:
    """Return the errors when state, fault and their estimates lie in their declared boxes."""
    x_box, f_box = design.plant.box("x"), design.plant.box("f")
    if not (np.isfinite(x_box).all() and np.isfinite(f_box).all()):
        return None
    if isinstance(design.bound, EllipsoidBound) and design.bound.error == "shifted":
        # zeta has to lie in the range of T, which a missing measurement does not keep.
        return None
    width, f_width = np.diff(x_box)[:, 0], np.diff(f_box)[:, 0]
    n, n_f = design.A.shape[0], design.rate.size
    box = StartBox(design, np.zeros(n), np.zeros((n, 2)), np.zeros(n_f), np.zeros((n_f, 2)))
    noise = noise_offset(design)
    box.e = (-width, width)
    box.zeta = (-width - noise, width + noise)
    box.e_f = (-f_width, f_width)
    return box


def check_range_of_T(design: UioDesign, bound: EllipsoidBound, z: FloatArray) -> None:
    """Refuse a first z that a recursion in the range of T would not keep."""
    if bound.error == "shifted" and np.any(design.T @ z != z):
        raise ObsynthError(
            "z0 has to lie in the range of T (zero in the coordinates that the unknown input "
            'takes away) for error="shifted"; give the guess alone',
            z0=z,
        )


def first_levels(design: UioDesign, box: StartBox) -> FloatArray:
    """Return V_0 of every component's ellipsoid for a box of first errors, delta of (48)."""
    bound = ellipsoid_of(design)
    lower, upper = box.xi(design, bound.error)
    levels = [largest_level(P, lower, upper) for P in bound.P]
    components = _component_map(design, bound)
    return np.array([0.0 if c is None else levels[bound.shape_of(c)] for c in components])
