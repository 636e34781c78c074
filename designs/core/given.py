"""What the user hands over beside the plant: gains, and where the first state may be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Start:
    """What `Observer.memory0` is given, checked.

    guess (n,)
    x_range, f_range (n, 2), (n_f, 2): where they are given
    """

    plant: Plant
    guess: FloatArray
    x_range: FloatArray | None
    f_range: FloatArray | None
    y0: Any = None

    @classmethod
    def read(
        cls,
        plant: Plant,
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> Start:
        """Check what is given against the names of the plant."""
        x, f = plant.names("x"), plant.names("f")
        return cls(
            plant,
            read_vector(guess, "guess", x),
            None if x_range is None else read_box(x_range, "x_range", x),
            None if f_range is None else read_box(f_range, "f_range", f),
            y0,
        )

    @property
    def x(self) -> FloatArray:
        """The box of the first state, by default the declared one, which has to be finite then."""
        box = self.plant.box("x") if self.x_range is None else self.x_range
        if not np.isfinite(box).all():
            raise ObsynthError(
                "x_range is needed: the states have no finite declared range, so the first set "
                "has no bound",
                option="x_range",
            )
        return box

    @property
    def f(self) -> FloatArray:
        """The box of the first faults; by default there is none."""
        return np.zeros((len(self.plant.f), 2)) if self.f_range is None else self.f_range


def read_vector(value: Any, what: str, names: tuple[str, ...]) -> FloatArray:
    """Return one finite number for each name."""
    array = _numbers(value)
    if array is None or array.shape != (len(names),) or not np.isfinite(array).all():
        raise ObsynthError(
            f"{what} has to be {len(names)} finite numbers ({', '.join(names)}); got {value!r}",
            option=what,
        )
    return array


def read_box(value: Any, what: str, names: tuple[str, ...]) -> FloatArray:
    """Return a finite pair (lower, upper) for each name, shape (n, 2)."""
    array = _numbers(value)
    if array is not None and array.size == 0 and not names:
        return np.zeros((0, 2))
    if (
        array is None
        or array.shape != (len(names), 2)
        or not np.isfinite(array).all()
        or np.any(array[:, 0] > array[:, 1])
    ):
        raise ObsynthError(
            f"{what} has to be {len(names)} finite pairs lower <= upper ({', '.join(names)}); got "
            f"{value!r}",
            option=what,
        )
    return array


def read_gains(
    gains: Mapping[str, ArrayLike],
    shapes: Mapping[str, tuple[int, ...]],
    optional: tuple[str, ...] = (),
) -> dict[str, FloatArray]:
    """Return given gains by name, names, shapes and numbers checked; a vector is one column."""
    wanted = ", ".join(
        f"{name} of shape {shape}{' (optional)' if name in optional else ''}"
        for name, shape in shapes.items()
    )
    missing = tuple(sorted(set(shapes) - set(optional) - set(gains)))
    if missing or set(gains) - set(shapes):
        needs = f" and needs {', '.join(missing)}" if missing else ""
        raise ObsynthError(
            f"gains has {sorted(gains)}{needs}; it takes {wanted}", option="gains", missing=missing
        )
    found: dict[str, FloatArray] = {}
    for name, value in gains.items():
        array = _numbers(value)
        if array is not None and array.size == 0 and 0 in shapes[name]:
            array = np.zeros(shapes[name])
        if array is not None and array.ndim == 1 and shapes[name] == (array.size, 1):
            array = array[:, None]
        if array is None or array.shape != shapes[name] or not np.isfinite(array).all():
            given = "no array of numbers" if array is None else f"shape {array.shape}"
            raise ObsynthError(
                f"{name} has {given}; finite numbers of shape {shapes[name]} are needed",
                option="gains",
                gain=name,
            )
        found[name] = array
    return found


def _numbers(value: Any) -> FloatArray | None:
    try:
        return np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return None
