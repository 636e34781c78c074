"""Options of a method: what their own annotations say of them is checked."""

from __future__ import annotations

from dataclasses import dataclass, fields
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True)
class Number:
    """What a number among the options has to satisfy, every entry of a sequence alike.

    because: how a refusal goes on after "gamma is 1.5; "
    """

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
MATRIX = "matrix"
"""In ``Annotated``: finite numbers, kept as a tuple of rows; a vector serves as one column."""


def check_options(method: Any) -> None:
    """Hold every field of a frozen dataclass against its annotation; sequences become tuples.

    Literals, bool, int, float, tuples of floats or of pairs and their unions with None are
    checked, numbers also by a `Number` in ``Annotated``, one number or a tuple of them too, and
    what is a `MATRIX`; whatever else a method takes it checks by itself.
    """
    hints = get_type_hints(type(method), include_extras=True)
    for field in fields(method):
        value = read_option(field.name, hints[field.name], getattr(method, field.name))
        object.__setattr__(method, field.name, value)


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
        return _one_of(name, value, [*literals, *([None] if _optional(kind) else [])])
    if allowed == [bool]:
        return _one_of(name, value, [True, False])
    if allowed in ([float], [int]):
        return _number(name, value, limits, whole=allowed == [int])
    if allowed == [float, tuple[float, ...]] and isinstance(value, int | float):
        return _number(name, value, limits, whole=False)
    if tuple[float, ...] in allowed:
        return _numbers(name, value, limits)
    if allowed == [tuple[tuple[float, float], ...]]:
        return _pairs(name, value)
    return value


def _optional(kind: Any) -> bool:
    return get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind)


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


def _numbers(name: str, value: Any, limits: Number) -> tuple[float, ...]:
    try:
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
    except (TypeError, ValueError):
        numbers = np.array([np.nan])
    if numbers.ndim != 1 or not numbers.size or not limits.holds(numbers):
        raise ObsynthError(f"{name} is {value!r}; {limits.because}", option=name)
    return tuple(numbers.tolist())


def _pairs(name: str, value: Any) -> tuple[tuple[float, float], ...]:
    try:
        return tuple((float(low), float(high)) for low, high in value)
    except (TypeError, ValueError) as error:
        raise ObsynthError(
            f"{name} is {value!r}; it has to be pairs (lower, upper)", option=name
        ) from error


def read_matrix(name: str, value: Any, dimensions: tuple[int, ...] = (2,)) -> np.ndarray[Any, Any]:
    """Return an option that is an array of finite numbers; a vector serves as one column."""
    try:
        array = np.array(value, dtype=float)
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
