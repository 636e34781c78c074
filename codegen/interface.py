"""What the code generator reads of an observer and of its plant."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import casadi as ca

from obsynth.symbolic.arrays import FloatArray


class SignalLike(Protocol):
    """One signal of the plant."""

    @property
    def name(self) -> str:
        """Name as the user typed it."""
        ...

    @property
    def unit(self) -> str:
        """Label of the unit, may be empty."""
        ...

    @property
    def nominal(self) -> Any:
        """Value in normal operation, or None."""
        ...


class SchedulingLike(SignalLike, Protocol):
    """One scheduling signal of the plant."""

    @property
    def measured(self) -> bool:
        """Whether it is known at run time."""
        ...


class PlantLike(Protocol):
    """The discrete plant that the observer's guarantee speaks of."""

    @property
    def name(self) -> str:
        """Name of the plant."""
        ...

    @property
    def Ts(self) -> float | None:
        """Sample time in seconds."""
        ...

    @property
    def x(self) -> Sequence[SignalLike]:
        """States."""
        ...

    @property
    def u(self) -> Sequence[SignalLike]:
        """Measured inputs."""
        ...

    @property
    def f(self) -> Sequence[SignalLike]:
        """Faults."""
        ...

    @property
    def rho(self) -> Sequence[SchedulingLike]:
        """Scheduling signals; read only for a step with the input theta."""
        ...

    @property
    def output_names(self) -> Sequence[str]:
        """Names of the measurements."""
        ...

    @property
    def output_units(self) -> Sequence[str]:
        """Labels of their units, each may be empty."""
        ...

    def box(self, kind: str) -> FloatArray:
        """Return the declared ranges of one kind of signals, shape (n, 2)."""
        ...

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho) -> (next x, y)."""
        ...

    def to_dict(self) -> Mapping[str, Any]:
        """Return the plant as JSON-able data."""
        ...


class GuaranteeLike(Protocol):
    """What the observer promises and under which assumptions."""

    @property
    def claims(self) -> Sequence[str]:
        """What is guaranteed."""
        ...

    @property
    def assumptions(self) -> Sequence[str]:
        """Under which conditions."""
        ...


class ObserverLike(Protocol):
    """The part of an observer that ships."""

    @property
    def method(self) -> str:
        """Name of the design method."""
        ...

    @property
    def model(self) -> PlantLike:
        """The discrete plant that the guarantee speaks of."""
        ...

    @property
    def step(self) -> ca.Function:
        """The function of one step, the truth at run time."""
        ...

    @property
    def memory_layout(self) -> Mapping[str, slice]:
        """Which entries of the memory hold what."""
        ...

    @property
    def guarantee(self) -> GuaranteeLike:
        """Claims and assumptions."""
        ...

    @property
    def fault_delay(self) -> int:
        """By how many samples the fault estimate lags behind, 0 or 1."""
        ...

    def memory0(self, guess: Any) -> FloatArray:
        """Return the memory for the first call of the step."""
        ...
