"""Signals: what a symbol of a plant stands for, with its bounds and its unit."""

import math
from dataclasses import dataclass
from enum import StrEnum

import sympy as sp

from obsynth.symbolic.errors import PlantError


class Role(StrEnum):
    """What a signal is to the plant; the value is the word used in messages and files.

    Examples
    --------
    >>> str(Role.ACTUATOR_FAULT)
    'actuator fault'
    """

    STATE = "state"
    INPUT = "input"
    UNKNOWN_INPUT = "unknown input"
    PARAM = "parameter"
    SCHEDULING = "scheduling variable"
    DISTURBANCE = "disturbance"
    ACTUATOR_FAULT = "actuator fault"
    SENSOR_FAULT = "sensor fault"
    PROCESS_FAULT = "process fault"


FAULT_ROLES = frozenset({Role.ACTUATOR_FAULT, Role.SENSOR_FAULT, Role.PROCESS_FAULT})
"""The roles whose signals are faults."""

KINDS: dict[str, frozenset[Role]] = {
    "x": frozenset({Role.STATE}),
    "u": frozenset({Role.INPUT}),
    "d": frozenset({Role.UNKNOWN_INPUT}),
    "f": FAULT_ROLES,
    "w": frozenset({Role.DISTURBANCE}),
    "p": frozenset({Role.PARAM}),
    "rho": frozenset({Role.SCHEDULING}),
}
"""The letters of the field and the roles they gather."""


@dataclass(frozen=True)
class Signal:
    """One scalar signal of a plant.

    Parameters
    ----------
    name : str
        The symbol's name.
    symbol : sympy.Symbol
        The real symbol that stands in the equations.
    role : Role
        What the signal is to the plant.
    lower, upper : float
        Bounds, in ``unit``. A disturbance without bounds has finite energy only.
    unit : str
        A label for plots and headers; no arithmetic is done with it.
    nominal : float or None
        Value at the operating point.
    rate : float or None
        Faults only: the largest change per second (per step in a discrete plant).
    constant : bool
        True when the signal does not change with time.
    measured : bool
        False for a scheduling variable that is bounded but not known on line.
    of : str or None
        Name of the input (actuator fault) or output (sensor fault) it adds to.
    value : sympy.Expr or None
        Parameters only: the exact value.

    Raises
    ------
    PlantError
        Bounds that are not numbers or not in order, a nominal value outside of
        them, a rate that is not positive or not of a fault.

    Examples
    --------
    >>> level = Signal("h1", sp.Symbol("h1", real=True), Role.STATE, 60.0, 280.0, "cm")
    >>> level.bounded
    True
    """

    name: str
    symbol: sp.Symbol
    role: Role
    lower: float = -math.inf
    upper: float = math.inf
    unit: str = ""
    nominal: float | None = None
    rate: float | None = None
    constant: bool = False
    measured: bool = True
    of: str | None = None
    value: sp.Expr | None = None

    def __post_init__(self) -> None:
        who = f"{self.role} {self.name}"
        if math.isnan(self.lower) or math.isnan(self.upper):
            raise PlantError(f"{who}: a bound of its range is not a number", symbol=self.name)
        unbounded = self.lower == -math.inf and self.upper == math.inf
        if not (self.bounded or unbounded):
            raise PlantError(
                f"{who}: the range ({self.lower}, {self.upper}) is not finite; give two finite "
                "bounds, or none for an unbounded signal",
                symbol=self.name,
                lower=self.lower,
                upper=self.upper,
            )
        if self.lower > self.upper:
            raise PlantError(
                f"{who}: the range ({self.lower}, {self.upper}) is empty; give the lower bound "
                "first",
                symbol=self.name,
                lower=self.lower,
                upper=self.upper,
            )
        if self.role is Role.PARAM and unbounded:
            raise PlantError(f"{who}: a parameter has a value or a finite range", symbol=self.name)
        if self.nominal is not None and not self.lower <= self.nominal <= self.upper:
            raise PlantError(
                f"{who}: the nominal value {self.nominal} is not a number inside the range "
                f"[{self.lower}, {self.upper}]",
                symbol=self.name,
                nominal=self.nominal,
            )
        if self.rate is not None:
            if self.role not in FAULT_ROLES:
                raise PlantError(
                    f"{who}: only faults have a rate; bound this signal with range=",
                    symbol=self.name,
                    rate=self.rate,
                )
            if not 0.0 < self.rate < math.inf:
                raise PlantError(
                    f"{who}: the rate {self.rate} is not a finite, positive number; a fault that "
                    "does not change has constant=True",
                    symbol=self.name,
                    rate=self.rate,
                )

    @property
    def bounded(self) -> bool:
        """True when both bounds are finite."""
        return math.isfinite(self.lower) and math.isfinite(self.upper)

    @property
    def is_fault(self) -> bool:
        """True for actuator, sensor and process faults."""
        return self.role in FAULT_ROLES
