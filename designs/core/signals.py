"""What methods read and say of ranges: sizes where there is none, the nominal w."""

from collections.abc import Iterable
from typing import NamedTuple

import casadi as ca
import numpy as np

from obsynth.derive.jacobian.family import AffineFamily
from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import LIMITS
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.equations import covered_inputs, curved_states
from obsynth.symbolic import Plant, Signal
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

LARGEST_SIGNAL = 1e6
"""Magnitude up to which signals without a declared range are covered, in doubles."""
DECLARED = "hold the declared disturbances and fault rates"
NOTHING = np.zeros(0)
IEEE = {"double": "IEEE doubles", "single": "IEEE single precision"}


def finite_box(plant: Plant, kind: str, precision: str = "double") -> FloatArray:
    """Return the declared box of signals, `LARGEST_SIGNAL` where there is none, shape (k, 2).

    In single precision, whose rounding of such a number would be seen, what takes some state
    through its range in one call, if that is less. Limits are watched, so any number will do.
    """
    box, largest = plant.box(kind), np.full(len(plant.names(kind)), LARGEST_SIGNAL)
    if precision == "single" and not np.isfinite(box).all():
        largest = np.minimum(largest, _pushes(plant, kind))
    return np.where(np.isfinite(box), box, np.sign(box) * largest[:, None])


def _pushes(plant: Plant, kind: str) -> FloatArray:
    """Return what takes a state through its range in one call, about the middle, (k,)."""
    names = ("x", "u", "d", "f", "w", "p", "rho")
    symbols = [ca.SX.sym(name, len(plant.names(name))) for name in names]
    k = names.index(kind)
    slopes = ca.jacobian(plant.function()(*symbols)[0], symbols[k])
    boxes = [plant.box(name).reshape(-1, 2) for name in names]
    finite = [np.where(np.isfinite(b).all(axis=1, keepdims=True), b, 0.0) for b in boxes]
    at = [b.mean(axis=1) for b in finite]
    J = np.abs(np.array(ca.DM(ca.Function("slopes", symbols, [slopes])(*at))))
    J = J.reshape(len(boxes[0]), len(boxes[k])) * (plant.Ts is not None)
    if kind == "x":
        np.fill_diagonal(J, 0.0)
    with np.errstate(all="ignore"):
        push = np.diff(boxes[0], axis=1) / J
    found: FloatArray = np.where(push > 0.0, push, np.inf).min(axis=0, initial=np.inf)
    return found


def held_in_single(plant: Plant) -> Plant:
    """Return a plant with ranges in single precision, measured ones outwards, or refuse it."""
    limit = LIMITS["single"].huge
    ends: dict[str, tuple[float, float]] = {}
    for kind in ("x", "u", "d", "f", "w", "p", "rho"):
        signals = getattr(plant, kind)
        box = plant.box(kind).reshape(-1, 2)
        for s, size in zip(signals, np.where(np.isfinite(box), np.abs(box), 0.0), strict=True):
            if size.max() > limit:
                raise ObsynthError(
                    f"{s.name} is declared up to {size.max():.3g}, more than the {limit:.3g} that "
                    "precision='single' has room for: take precision='double', or another unit",
                    option="precision",
                )
        wide = outward(box, "single")
        if kind == "u" or kind == "rho":
            pairs = zip(signals, wide.tolist(), (wide != box).any(axis=1), strict=True)
            ends |= {s.name: (a, b) for s, (a, b), moved in pairs if moved and s.measured}
    return plant.with_ranges(ends) if ends else plant


def wider(box: FloatArray) -> FloatArray:
    """Return a finite box that reaches beyond another by its width, up to `LARGEST_SIGNAL`."""
    wide = np.clip(box + np.diff(box, axis=1) * [-1.0, 1.0], -LARGEST_SIGNAL, LARGEST_SIGNAL)
    return np.column_stack([np.minimum(box, wide)[:, 0], np.maximum(box, wide)[:, 1]])


class Limits(NamedTuple):
    """Where a bound goes on: boxes of states and their estimates, of faults, of inputs, (., 2).

    Inputs that do not enter with constant factors keep to their ranges, all else may leave its by
    its width; `LARGEST_SIGNAL` stands where there is none.
    """

    x: FloatArray
    f: FloatArray
    u: FloatArray

    @classmethod
    def of(cls, plant: Plant, precision: str = "double", held: bool = True) -> "Limits":
        """Read them; held: states on which a derivative depends keep to their ranges too."""
        x, f, u = (finite_box(plant, kind, precision).reshape(-1, 2) for kind in "xfu")
        kept = curved_states(plant)[:, None] & held, covered_inputs(plant)[:, None]
        return cls(np.where(kept[0], x, wider(x)), wider(f), np.where(kept[1], u, wider(u)))


def within(signals: Iterable[Signal], units: bool = False) -> str:
    """Write the ranges of signals in the user's names, ``x in [0, 2] m, w in [-1, 1]``."""
    return ", ".join(
        f"{s.name} in [{s.lower:g}, {s.upper:g}]{f' {s.unit}' if units and s.unit else ''}"
        for s in signals
    )


def beyond(signals: Iterable[Signal], boxes: FloatArray) -> str:
    """Write the boxes of signals, (k, 2), that are not their declared ranges."""
    pairs = zip(signals, boxes.tolist(), strict=True)
    other = [(s.name, a, b) for s, (a, b) in pairs if (a, b) != (s.lower, s.upper)]
    return ", ".join(f"{name} in [{a:g}, {b:g}]" for name, a, b in other)


def prove_boxes(
    what: str, box: FloatArray, centre: FloatArray, radius: FloatArray, more: FloatArray = NOTHING
) -> Claim:
    """Prove that stored middles and radii hold a box, (k, 2); more: what else is not negative."""
    room = np.concatenate([box[:, 0] - (centre - radius), (centre + radius) - box[:, 1], more])
    margin = float(room.min(initial=np.inf))
    return Claim("boxes", f"the stored boxes {what}", bool(margin >= 0.0), margin, "comparison")


def covers_jacobian(what: str, stored: AffineFamily, derived: AffineFamily) -> Claim:
    """Claim that a stored family holds the Jacobians that were derived anew."""
    return Claim(
        "jacobian",
        f"every Jacobian of {what} over the box lies in the stored family",
        stored.covers(derived),
        stored.room(derived),
        "interval branch and bound with outward rounding; dependences proved symbolically",
    )


def noise_centre(plant: Plant) -> FloatArray:
    """Return the middle of the declared disturbances, 0 where they have no bound, shape (n_w,)."""
    w = np.where(np.isfinite(plant.box("w")), plant.box("w"), 0.0)
    return np.asarray(0.5 * w[:, 0] + 0.5 * w[:, 1])


def about_centre(plant: Plant, centre: FloatArray) -> str:
    """Write w - centre in the user's names, ``(w1 - 2.5, w2)``."""
    pairs = zip(plant.names("w"), centre.tolist(), strict=True)
    words = (f"{w} {'-' if c > 0 else '+'} {abs(c):.17g}" if c else w for w, c in pairs)
    return f"({', '.join(words)})"


def at_centre(plant: Plant, centre: FloatArray) -> str:
    """Say that w is at the centre in the user's names, ``w1 = 2.5, w2 = 0``."""
    pairs = zip(plant.names("w"), centre.tolist(), strict=True)
    return ", ".join(f"{w} = {c:.17g}" for w, c in pairs)
