"""What a method is given, checked: options, the class of the plant, gains, the first set."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import StructureError
from obsynth.designs.core.equations import curved_states
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.taking import labelled


@dataclass(frozen=True)
class Number:
    """What every number of an option has to satisfy; because: how "gamma is 1.5; " goes on."""

    above: float = -np.inf
    below: float = np.inf
    at_least: float = -np.inf
    at_most: float = np.inf
    because: str = "it has to be finite"

    def holds(self, values: Any) -> bool:
        """Whether finite numbers all lie within the limits."""
        numbers = np.asarray(values, dtype=float)
        inside = (numbers > self.above) & (numbers < self.below)
        inside &= (numbers >= self.at_least) & (numbers <= self.at_most)
        return bool(np.all(inside & np.isfinite(numbers)))


POSITIVE = Number(above=0.0, because="it has to be positive and finite")
CONTRACTION = Number(0.0, 1.0, because="the contraction per step lies between 0 and 1")
WEIGHTS = Number(at_least=0.0, because="they have to be finite, not negative and not all zero")
MATRIX = "matrix"
"""In ``Annotated``: finite numbers, kept as a tuple of rows; a vector serves as one column."""


def check_options(method: Any) -> None:
    """Hold every option against its annotation, see `read_option`; sequences become tuples."""
    hints = get_type_hints(type(method), include_extras=True)
    for option in fields(method):
        value = read_option(option.name, hints[option.name], getattr(method, option.name))
        object.__setattr__(method, option.name, value)


def changed(method: Any, *names: str) -> list[str]:
    """Return which of some options differ from their default."""
    asked = [option for option in fields(method) if option.name in names]
    return [o.name for o in asked if getattr(method, o.name) != o.default]


def refuse_idle(method: Any, where: str, *names: str) -> None:
    """Refuse options that differ from their default where they have no effect."""
    for name in changed(method, *names):
        raise ObsynthError(f"{name} has no effect with {where}: leave it out", option=name)


def read_option(name: str, kind: Any, value: Any) -> Any:
    """Return the value of an option as its annotation describes it, or refuse it."""
    limits, extras = Number(), []
    if get_origin(kind) is Annotated:
        kind, *extras = get_args(kind)
        limits = next((extra for extra in extras if isinstance(extra, Number)), limits)
    allowed = list(get_args(kind)) if get_origin(kind) in (Union, UnionType) else [kind]
    if value is None and NoneType in allowed:
        return None
    if MATRIX in extras:
        return read_rows(name, value)
    allowed = [one for one in allowed if one is not NoneType]
    literals = [v for one in allowed if get_origin(one) is Literal for v in get_args(one)]
    if literals and len(allowed) == 1:
        return _one_of(name, value, [*literals, *([None] if NoneType in get_args(kind) else [])])
    if allowed == [bool]:
        return _one_of(name, value, [True, False])
    if allowed in ([float], [int]):
        return _number(name, value, limits, whole=allowed == [int])
    if allowed == [float, tuple[float, ...]] and isinstance(value, int | float):
        return _number(name, value, limits, whole=False)
    if tuple[float, ...] in allowed:
        return _finite_numbers(name, value, limits)
    if allowed == [tuple[tuple[float, float], ...]]:
        return _pairs(name, value)
    return value


def _one_of(name: str, value: Any, allowed: list[Any]) -> Any:
    for one in allowed:
        if type(value) is type(one) and value == one:
            return one
    words = ", ".join(map(repr, allowed))
    raise ObsynthError(f"{name} is {value!r}; it has to be one of {words}", option=name)


def _number(name: str, value: Any, limits: Number, whole: bool) -> float | int:
    kinds = int | np.integer if whole else int | float | np.integer | np.floating
    fits = isinstance(value, kinds) and not isinstance(value, bool)
    if not fits or not limits.holds(value):
        raise ObsynthError(f"{name} is {value!r}; {limits.because}", option=name)
    return int(value) if whole else float(value)


def _finite_numbers(name: str, value: Any, limits: Number) -> tuple[float, ...]:
    try:
        numbers = np.atleast_1d(_floats(value))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if numbers.ndim != 1 or not numbers.size or not limits.holds(numbers):
        raise ObsynthError(f"{name} is {value!r}; {limits.because}", option=name)
    return tuple(numbers.tolist())


def _pairs(name: str, value: Any) -> tuple[tuple[float, float], ...]:
    pairs = _numbers(value)
    if pairs is None or pairs.ndim != 2 or pairs.shape[1] != 2 or not np.all(np.diff(pairs) >= 0):
        raise ObsynthError(
            f"{name} is {value!r}; it has to be pairs (lower, upper) of numbers", option=name
        )
    return tuple((low, high) for low, high in pairs.tolist())


def refuse_no_weights(weights: tuple[float, ...] | None) -> None:
    """Refuse weights that are all zero."""
    if weights is not None and not any(weights):
        raise ObsynthError(f"weights are {weights}; {WEIGHTS.because}", option="weights")


def read_weights(weights: tuple[float, ...] | None, plant: Plant) -> FloatArray:
    """Return weights of states and faults, 1 where they are not given, (n + n_f,)."""
    names = (*plant.names("x"), *plant.names("f"))
    found = np.ones(len(names)) if weights is None else np.array(weights)
    if found.shape != (len(names),):
        raise ObsynthError(
            f"weights are {found.size} numbers; {len(names)} are needed ({', '.join(names)})",
            option="weights",
        )
    return found


def read_matrix(name: str, value: Any, dimensions: tuple[int, ...] = (2,)) -> np.ndarray[Any, Any]:
    """Return an option that is an array of finite numbers; a vector serves as one column."""
    try:
        array = np.array(_floats(value))
    except (TypeError, ValueError) as error:
        raise ObsynthError(f"{name} is no array of numbers: {value!r}", option=name) from error
    if array.ndim == 1 and 1 not in dimensions:
        array = array[:, None]
    if array.ndim not in dimensions or not np.isfinite(array).all():
        raise ObsynthError(
            f"{name} has to hold finite numbers in {' or '.join(map(str, dimensions))} dimensions; "
            f"got {value!r}",
            option=name,
        )
    return array


def read_rows(name: str, value: Any) -> tuple[tuple[float, ...], ...]:
    """Return a matrix of finite numbers as a tuple of rows, which can be compared."""
    return tuple(map(tuple, read_matrix(name, value).tolist()))


WORDS = {
    "d": "unknown input",
    "p": "parameter",
    "rho": "scheduling variable",
    "x": "state",
    "u": "input",
    "w": "disturbance",
    "f": "fault",
}
"""Kinds of signals as refusals call them."""


@dataclass(frozen=True)
class PlantClass:
    """What a plant has to be for a method; each refusal is a clause after the symbols' names.

    who: the method as a refusal calls it, "the bounded-error observer"
    discretised: whether a discretisation stands for the continuous plant that it was made from
    forbids: kind of signal -> why the method has none of it and what to do instead
    finite: kind of signal -> why each of it needs a finite range and how to declare it
    linear: whether states that enter linearly, on which no derivative depends, need none
    needs: kind of signal -> why at least one is needed
    faults: roles of the faults that the method estimates
    """

    who: str
    time: Literal["discrete", "continuous"]
    discretised: bool = False
    forbids: Mapping[str, str] = field(default_factory=dict)
    finite: Mapping[str, str] = field(default_factory=dict)
    linear: bool = False
    needs: Mapping[str, str] = field(default_factory=dict)
    faults: tuple[Role, ...] = (Role.ACTUATOR_FAULT, Role.PROCESS_FAULT)

    def check(self, plant: Plant) -> Plant:
        """Return the plant in the method's time, or refuse it by the user's own names."""
        plant = self._in_time(plant.check())
        for kind, clause in self.forbids.items():
            self._refuse(kind, plant.names(kind), clause)
        sensors = [s.name for s in plant.f if s.role not in self.faults]
        if sensors:
            raise StructureError(
                f"sensor fault {', '.join(sensors)}: this method estimates faults that enter the "
                "dynamics (actuator and process faults)",
                symbols=tuple(sensors),
                condition="faults in the dynamics",
            )
        for kind, clause in self.finite.items():
            loose = np.array([not s.bounded for s in getattr(plant, kind)], dtype=bool)
            if kind == "x" and self.linear and loose.any():
                loose &= curved_states(plant)
            self._refuse(kind, tuple(np.array(plant.names(kind))[loose].tolist()), clause)
        for kind, clause in self.needs.items():
            if not getattr(plant, kind):
                raise StructureError(
                    f"{plant.name!r} declares no {WORDS[kind]}; {clause}",
                    symbol=plant.name,
                    condition=f"at least one {WORDS[kind]}",
                )
        return plant

    def _in_time(self, plant: Plant) -> Plant:
        if self.time == "continuous":
            behind = plant.continuous if self.discretised and plant.Ts is not None else plant
            if behind is None or behind.Ts is not None:
                raise StructureError(
                    f"{plant.name!r} is a discrete plant and {self.who} does not work in discrete "
                    "time: give the continuous plant, and Ts= of the observer for the sampling of "
                    "its step",
                    symbol=plant.name,
                    condition="continuous time",
                )
            return behind
        if plant.Ts is None:
            raise StructureError(
                f"{plant.name} is in continuous time and {self.who} works in discrete time: "
                'call discretise("euler", Ts=...) first',
                condition="discrete time",
            )
        return plant

    @staticmethod
    def _refuse(kind: str, names: tuple[str, ...], clause: str) -> None:
        if names:
            raise StructureError(
                f"{WORDS[kind]} {', '.join(names)}{clause}",
                symbols=names,
                symbol=names[0],
                condition=f"{WORDS[kind]}s",
            )


@dataclass(frozen=True, eq=False)
class Start:
    """What `Observer.memory0` is given, checked: None where it is not."""

    plant: Plant
    guess: FloatArray
    x_range: FloatArray | None
    f_range: FloatArray | None
    y0: FloatArray | None = None

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
            None if y0 is None else read_vector(y0, "y0", plant.output_names, finite=False),
        )

    @property
    def x(self) -> FloatArray:
        """The box of the first state, by default the declared one."""
        return self.plant.box("x") if self.x_range is None else self.x_range

    @property
    def f(self) -> FloatArray:
        """The box of the first faults; by default there is none."""
        return np.zeros((len(self.plant.f), 2)) if self.f_range is None else self.f_range


def read_vector(value: Any, what: str, names: tuple[str, ...], finite: bool = True) -> FloatArray:
    """Return one number for each name, finite unless said otherwise."""
    array = _unlabelled(value, what, names)
    fits = array is not None and array.shape == (len(names),)
    if array is None or not fits or (finite and not np.isfinite(array).all()):
        word = "finite numbers" if finite else "numbers"
        raise ObsynthError(
            f"{what} has to be {len(names)} {word} ({', '.join(names)}); got {value!r}",
            option=what,
        )
    return array


def read_box(value: Any, what: str, names: tuple[str, ...]) -> FloatArray:
    """Return a finite pair (lower, upper) for each name, shape (n, 2)."""
    array = _unlabelled(value, what, names)
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


def _unlabelled(value: Any, what: str, names: tuple[str, ...]) -> FloatArray | None:
    """Return an array of numbers, None where it is none; labels, in any order, are refused."""
    if told := labelled(what, value, names):
        raise ObsynthError(told, option=what)
    return _numbers(value)


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
        return _floats(value)
    except (TypeError, ValueError):
        return None


def _floats(value: Any) -> FloatArray:
    """Return numbers as doubles; texts, truth values and complex numbers are none."""
    entries = np.ravel(np.array(value, dtype=object))
    if any(isinstance(one, str | bool | np.bool_ | complex) for one in entries):
        raise TypeError(f"{value!r} holds no numbers")
    return np.asarray(value, dtype=float)
