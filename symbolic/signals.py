"""Signals: what a symbol stands for, with bounds and unit, and how one is declared."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction
from typing import Any

import numpy as np
import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import ALIASES, BY_NAME
from obsynth.symbolic.text import WORDS

RESERVED = (WORDS | BY_NAME.keys() | ALIASES.keys()) - {"phi1", "tanhc"}
"""Names that would read as something else; phi1 is too good a name for an angle."""

_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,99}")
LONGEST_NAME, LONGEST_UNIT = 200, 60
"""Characters of a plant's name, and of a unit."""


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
        one_line(self.unit, f"{who}: unit", LONGEST_UNIT, symbol=self.name)
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
    def middle(self) -> float:
        """The middle of the range, zero without one."""
        return 0.5 * (self.lower + self.upper) if self.bounded else 0.0

    @property
    def usual(self) -> float:
        """The nominal value, the middle of the range where none is declared."""
        return self.middle if self.nominal is None else float(self.nominal)


def one_line(text: Any, what: str, longest: int, **facts: Any) -> str:
    """Return a text that stands in titles and guarantees: one line of printable characters."""
    if not isinstance(text, str) or not text.isprintable() or len(text) > longest:
        given = f"{text[:longest]!r}..." if isinstance(text, str) else repr(text)
        raise PlantError(
            f"{what} is text of one line, at most {longest} printable characters, not {given}",
            **facts,
        )
    return text


def is_name(text: str) -> bool:
    """Whether a text is the name of one signal, without expanding it."""
    return _IDENTIFIER.fullmatch(text) is not None and text not in RESERVED


def expand_names(names: str | Sequence[str], what: str = "signal") -> tuple[str, ...]:
    """Expand names as ``sympy.symbols`` does."""
    parts = [names] if isinstance(names, str) else names
    if not isinstance(parts, Sequence) or not all(isinstance(part, str) for part in parts):
        raise PlantError(f"{what}: names are a string such as 'h1:5', not {names!r}", names=names)
    try:
        found = [str(s) for part in parts for s in sp.symbols(part, seq=True)]
    except (TypeError, ValueError) as error:
        raise PlantError(f"{what}: {names!r} names nothing: {error}", names=names) from error
    if not found:
        raise PlantError(f"{what}: {names!r} names nothing", names=names)
    for name in found:
        if not _IDENTIFIER.fullmatch(name):
            raise PlantError(
                f"{what}: {name!r} is no name; use letters, digits and underscores, at most 100",
                symbol=name,
            )
        if name in RESERVED:
            raise PlantError(
                f"{what}: {name!r} is a word of the equation language; choose another name",
                symbol=name,
            )
        if found.count(name) > 1:
            raise PlantError(f"{what}: the name {name!r} is given twice", symbol=name)
    return tuple(found)


def per_symbol(value: Any, names: Sequence[str], what: str) -> list[Any]:
    """Return one value per symbol: a list is taken in order, anything else holds for all."""
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if not isinstance(value, list | tuple):
        return [value] * len(names)
    if len(value) != len(names):
        raise PlantError(
            f"{what}= has {len(value)} entries for {len(names)} symbols ({', '.join(names)})",
            symbols=tuple(names),
            keyword=what,
        )
    return list(value)


def exact_number(value: Any, what: str) -> sp.Expr:
    """Return a number as SymPy holds it: rationals exact, floats as their double."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Fraction):
        return sp.Rational(value.numerator, value.denominator)
    if isinstance(value, float) and not math.isfinite(value):
        raise PlantError(f"{what}: {value} is not finite", value=value)
    if isinstance(value, bool) or not isinstance(value, int | float | sp.Expr):
        raise PlantError(f"{what}: {value!r} is not a number", value=value)
    number = sp.sympify(value)
    if not (number.is_number and number.is_extended_real and number.is_finite):
        raise PlantError(f"{what}: {value} is not a finite real number", value=value)
    return sp.Float(float(number)) if isinstance(number, sp.Float) else number


def make_signals(
    role: Role, names: str | Sequence[str], *, limits: Any = None, **keywords: Any
) -> tuple[Signal, ...]:
    """Make the signals of one declaration; keywords of `_one` are one value, or one per symbol."""
    found = expand_names(names, str(role))
    if limits is not None and keywords.get("bound") is not None:
        raise PlantError(f"{role} {found[0]}: give bound= or range=, not both", symbol=found[0])
    columns = {word: per_symbol(value, found, word) for word, value in keywords.items()}
    columns["limits"] = _pairs(limits, found)
    rows = [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]
    return tuple(_one(role, name, **row) for name, row in zip(found, rows, strict=True))


def _one(
    role: Role,
    name: str,
    *,
    limits: Any = None,
    bound: Any = None,
    nominal: Any = None,
    unit: Any = "",
    rate: Any = None,
    constant: Any = False,
    measured: Any = True,
    of: str | None = None,
    value: Any = None,
    tolerance: Any = None,
) -> Signal:
    who = f"{role} {name}"
    one_line(unit, f"{who}: unit=", LONGEST_UNIT, symbol=name)
    for flag, word in ((constant, "constant"), (measured, "measured")):
        if not isinstance(flag, bool):
            raise PlantError(f"{who}: {word}= is True or False, not {flag!r}", symbol=name)
    exact = None if value is None else exact_number(value, f"{who}: value")
    lower, upper = (-math.inf, math.inf) if limits is None else limits
    if bound is not None:
        upper = _float(bound, f"{who}: bound")
        if not 0.0 <= upper < math.inf:
            raise PlantError(f"{who}: bound={bound} is not a finite, non-negative number")
        lower = -upper
    if role is Role.PARAM:
        lower, upper, nominal = _parameter(who, exact, tolerance, limits, nominal)
    return Signal(
        name=name,
        symbol=sp.Symbol(name, real=True),
        role=role,
        lower=_float(lower, f"{who}: range"),
        upper=_float(upper, f"{who}: range"),
        unit=unit,
        nominal=None if nominal is None else _float(nominal, f"{who}: nominal"),
        rate=None if rate is None else _float(rate, f"{who}: rate"),
        constant=constant,
        measured=measured,
        of=of,
        value=exact,
    )


def _parameter(
    who: str, exact: sp.Expr | None, tolerance: Any, limits: Any, nominal: Any
) -> tuple[float, float, float]:
    """Return interval and nominal value of a parameter."""
    if exact is None and limits is None:
        raise PlantError(f"{who}: give value=, value= with tolerance=, or range=")
    if tolerance is not None and (exact is None or limits is not None):
        raise PlantError(f"{who}: tolerance= goes with value= and without range=")
    if limits is not None:
        lower, upper = (_float(limit, f"{who}: range") for limit in limits)
        if not (math.isfinite(lower) and math.isfinite(upper)):
            raise PlantError(f"{who}: the range of a parameter has to be finite")
        middle = (lower + upper) / 2.0 if exact is None else float(exact)
    else:
        middle = float(exact) if exact is not None else 0.0
        share = 0.0 if tolerance is None else _float(tolerance, f"{who}: tolerance")
        if not 0.0 <= share < math.inf:
            raise PlantError(f"{who}: tolerance={tolerance} is not a finite, non-negative number")
        lower, upper = middle - share * abs(middle), middle + share * abs(middle)
    if nominal is None:
        nominal = middle
    return lower, upper, _float(nominal, f"{who}: nominal")


def _pairs(limits: Any, names: Sequence[str]) -> list[Any]:
    """Return one (lower, upper) per symbol from one pair or a list of pairs."""
    if limits is None:
        return [None] * len(names)
    if isinstance(limits, np.ndarray):
        limits = limits.tolist()
    if not isinstance(limits, list | tuple):
        raise PlantError(f"range= is a pair (lower, upper) or a list of pairs, not {limits!r}")
    single = not any(isinstance(item, list | tuple | np.ndarray) or item is None for item in limits)
    pairs = [limits] * len(names) if single else per_symbol(list(limits), names, "range")
    for name, pair in zip(names, pairs, strict=True):
        if not (pair is None or (isinstance(pair, list | tuple | np.ndarray) and len(pair) == 2)):
            raise PlantError(f"range of {name}: a pair (lower, upper), not {pair!r}", symbol=name)
    return pairs


def output_ranges(limits: Any, names: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """Read what healthy sensors show, one pair each; either end may be infinite."""
    found = []
    for name, pair in zip(names, _pairs(limits, names), strict=True):
        who = f"output {name}: range"
        lower, upper = (-math.inf, math.inf) if pair is None else (_float(v, who) for v in pair)
        if not lower < upper:
            raise PlantError(
                f"{who} ({lower}, {upper}) has no room for a reading; give the smallest value that "
                "a healthy sensor shows and then the largest, -inf or inf where it has no limit",
                symbol=name,
                lower=lower,
                upper=upper,
            )
        found.append((lower, upper))
    return tuple(found)


def _float(value: Any, what: str) -> float:
    if isinstance(value, bool | str | complex):
        raise PlantError(f"{what}: {value!r} is not a number", value=value)
    try:
        return float(value)
    except (TypeError, ValueError) as error:
        raise PlantError(f"{what}: {value!r} is not a number", value=value) from error
