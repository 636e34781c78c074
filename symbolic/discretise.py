"""Discrete plants from continuous ones: the formulas of a step, and what they leave out.

What a formula leaves out is enclosed by another room, which puts its function into `ENCLOSURES`
when it is imported; the public package always imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import Role, Signal, exact_number

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant

METHODS = ("euler", "rk4", "taylor")
"""The methods by name."""

HIGHEST_ORDER = 6
"""The highest order of a Taylor polynomial: its terms grow fast."""

PREFIX = "remainder_"
"""What the names of remainders begin with; the name of the state follows."""

Enclosure = Callable[..., tuple[int, Mapping[str, tuple[float, float]]]]
ENCLOSURES: list[Enclosure] = []
"""(plant, method, Ts, order) -> order and, per state, what the step leaves out; zeros left away."""

_KINKS = (sp.Abs, sp.Max, sp.Min, sp.sign, sp.Heaviside, sp.Piecewise, sp.floor, sp.ceiling)


@dataclass(frozen=True)
class Step:
    """The formula of a step.

    method: one of `METHODS`
    order: how many Taylor coefficients of the solution the formula has
    """

    method: str
    order: int

    def __str__(self) -> str:
        return f"taylor {self.order}" if self.method == "taylor" else self.method

    @property
    def is_polynomial(self) -> bool:
        """Whether the formula is the Taylor polynomial itself."""
        return self.method != "rk4"


def step_formula(method: str, order: int | None = None) -> Step:
    """Read a method and its order, or refuse them with what there is."""
    if method not in METHODS:
        raise PlantError(
            f"discretisation {method!r} is unknown; methods are {', '.join(METHODS)}",
            method=method,
        )
    if method != "taylor":
        if order is not None:
            raise PlantError(
                f"order={order!r} is an option of 'taylor'; {method} has an order of its own",
                method=method,
                order=order,
            )
        return Step(method, 1 if method == "euler" else 4)
    if isinstance(order, bool) or not isinstance(order, int) or not 1 <= order <= HIGHEST_ORDER:
        raise PlantError(
            f"order={order!r} is no whole number from 1 to {HIGHEST_ORDER}", order=order
        )
    # a polynomial of the first order is Euler's, by its more familiar name
    return Step("taylor", order) if order > 1 else Step("euler", 1)


def sampling_time(Ts: Any) -> sp.Expr:
    """Read a sampling time in seconds."""
    number = exact_number(Ts, "Ts")
    if not number.is_positive:
        raise PlantError(f"the sampling time Ts={Ts} is not positive", Ts=Ts)
    if isinstance(number, sp.Float):
        exact = sp.Rational(float(number))
        return exact if exact.q <= 2**20 else number
    return number


def discretised(
    plant: Plant,
    method: str,
    Ts: Any,
    order: int | None = None,
    remainder: bool | Mapping[str, tuple[float, float]] | None = None,
) -> tuple[Step, sp.Expr, list[Signal], tuple[Signal, ...] | None]:
    """Return formula, sampling time and signals of a discrete plant, and which carry a remainder.

    A remainder that is given (state -> range) is taken as it is: this is how files are read.
    """
    if plant.check().Ts is not None:
        raise PlantError(f"plant {plant.name!r} is discrete already (Ts = {plant.Ts:g} s)")
    if not (remainder is None or isinstance(remainder, bool | Mapping)):
        raise PlantError(f"remainder= is True or False, not {remainder!r}", remainder=remainder)
    wanted = method == "taylor" if remainder is None else remainder
    step = None if method == "taylor" and order is None else step_formula(method, order)
    exact = sampling_time(Ts)
    found: Mapping[str, tuple[float, float]] | None = None
    if isinstance(wanted, Mapping):
        found = wanted
    elif wanted:
        if not ENCLOSURES:
            raise PlantError(
                "nothing is loaded that encloses the remainder of a step: import obsynth, or "
                "leave it out with remainder=False"
            )
        chosen, found = ENCLOSURES[-1](plant, method, exact, None if step is None else step.order)
        step = step or step_formula(method, chosen)
    if step is None:
        raise PlantError(
            "the order of a Taylor polynomial is chosen by its remainder: give order= where "
            "remainder=False",
            order=order,
        )
    _check_smooth(plant, step)
    h = float(exact)
    signals = [replace(s, rate=None if s.rate is None else s.rate * h) for s in plant.signals]
    return step, exact, signals, None if found is None else _carriers(plant, found)


def is_smooth(plant: Plant) -> bool:
    """Whether the right-hand side has derivatives of every order wherever it is defined."""
    return not any(row.has(*_KINKS) for row in plant.equations[0])


def _check_smooth(plant: Plant, step: Step) -> None:
    if step.method != "taylor" or is_smooth(plant):
        return
    rows = zip(plant.names("x"), plant.equations[0], strict=True)
    name, row = next((name, row) for name, row in rows if row.has(*_KINKS))
    kink = sorted(map(str, row.atoms(*_KINKS)))[0]
    raise PlantError(
        f"the row of {name} has the kink of {kink}, and a Taylor polynomial of order {step.order} "
        'needs its derivatives: use discretise("euler", ..., remainder=True), whose remainder '
        "covers kinks",
        row=name,
    )


def _carriers(plant: Plant, found: Mapping[str, tuple[float, float]]) -> tuple[Signal, ...]:
    """Make one disturbance per state whose step leaves something out."""
    taken = {signal.name for signal in plant.signals} | set(plant.output_names)
    unknown = sorted(set(found) - set(plant.names("x")))
    if unknown:
        raise PlantError(
            f"a remainder of {', '.join(unknown)[:200]} is given, which is no state",
            symbols=unknown,
        )
    carriers = []
    for state in plant.x:
        if state.name not in found:
            continue
        name = PREFIX + state.name
        if name in taken:
            raise PlantError(
                f"the name {name} is needed for what the discretisation leaves out of "
                f"{state.name}; choose another name for the signal that has it",
                symbol=name,
            )
        symbol = sp.Symbol(name, real=True)
        low, high = found[state.name]
        carriers.append(Signal(name, symbol, Role.DISTURBANCE, low, high, state.unit))
    return tuple(carriers)


def next_values(
    step: Step, x: Sequence[sp.Symbol], rates: Sequence[sp.Expr], Ts: sp.Expr
) -> tuple[sp.Expr, ...]:
    """Return the next value of every state, everything else held over the step."""
    state, derivative = sp.Matrix(x), sp.Matrix(rates)
    if step.is_polynomial:
        total, term = state, derivative
        for k in range(1, step.order + 1):
            total = total + Ts**k / sp.factorial(k) * term
            term = term.jacobian(list(x)) * derivative if k < step.order else term
        return tuple(total)

    def at(point: sp.Matrix) -> sp.Matrix:
        return derivative.xreplace(dict(zip(x, point, strict=True)))

    return tuple(runge_kutta(at, state, Ts))


def runge_kutta(rates: Callable[[Any], Any], x: Any, step: Any) -> Any:
    """Return one step of the classical formula of order four."""
    k1 = rates(x)
    k2 = rates(x + step / 2 * k1)
    k3 = rates(x + step / 2 * k2)
    k4 = rates(x + step * k3)
    return x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def composed(step: Step, x: ca.SX, rates: ca.SX, Ts: Any) -> ca.SX:
    """Return one step in SX, Ts a number or a symbol; its graph stays small."""
    if not step.is_polynomial:
        others = [s for s in ca.symvar(rates) if not ca.depends_on(s, x)]
        function = ca.Function("rates", [x, ca.vertcat(*others)], [rates])
        end: ca.SX = runge_kutta(lambda point: function(point, ca.vertcat(*others)), x, Ts)
        return end
    total, term = x, rates
    for k in range(1, step.order + 1):
        total = total + Ts**k / sp.factorial(k).p * term
        term = ca.cse(ca.jtimes(term, x, rates)) if k < step.order else term
    return total
