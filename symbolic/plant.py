"""The plant: signals, dynamics and outputs as the control engineer writes them."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.symbolic.declare import exact_number, expand_names, make_signals, per_symbol
from obsynth.symbolic.discretise import discrete_rows, sampling_time
from obsynth.symbolic.equations import read_rows
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import FAULT_ROLES, Role, Signal
from obsynth.symbolic.sxmodel import SxModel, build_sx

__all__ = ["Plant"]

_KINDS: dict[str, frozenset[Role]] = {
    "x": frozenset({Role.STATE}),
    "u": frozenset({Role.INPUT}),
    "d": frozenset({Role.UNKNOWN_INPUT}),
    "f": FAULT_ROLES,
    "w": frozenset({Role.DISTURBANCE}),
    "p": frozenset({Role.PARAM}),
    "rho": frozenset({Role.SCHEDULING}),
}


class Plant:
    """A nonlinear plant, declared signal by signal.

    Parameters
    ----------
    name : str
        What the plant is called in titles, reports and headers.

    Raises
    ------
    PlantError
        By every method, when what is given cannot be accepted.

    Notes
    -----
    Continuous time: ``dynamics`` are time derivatives. Discrete time (``Ts`` given):
    next values. Declarations return tuples of real SymPy symbols. The states are
    complete once the dynamics stand; other signals may be declared until the plant is
    first used (converted or discretised).

    Examples
    --------
    >>> plant = Plant("tank")
    >>> (h,) = plant.states("h", range=(1, 9), unit="cm")
    >>> (v,) = plant.inputs("v", range=(0, 5), nominal=2)
    >>> plant.dynamics([v - sp.sqrt(h)])
    >>> plant.outputs([h])
    ('y1',)
    >>> plant.discretise("euler", Ts=0.5).rhs
    Matrix([[-sqrt(h)/2 + h + v/2]])
    """

    def __init__(self, name: str) -> None:
        if not isinstance(name, str) or not name.strip():
            raise PlantError(f"a plant's name is a non-empty text, not {name!r}")
        self._name = name
        self._signals: dict[str, Signal] = {}
        self._dynamics: tuple[sp.Expr, ...] | None = None
        self._outputs: tuple[sp.Expr, ...] | None = None
        self._output_names: tuple[str, ...] = ()
        self._output_units: tuple[str, ...] = ()
        self._Ts: sp.Expr | None = None
        self._origin: tuple[Plant, str] | None = None
        self._in_use = False
        self._cache: dict[str, Any] = {}

    # -- declarations --------------------------------------------------------------

    def states(
        self, names: str | Sequence[str], *, range: Any = None, unit: Any = "", nominal: Any = None
    ) -> tuple[sp.Symbol, ...]:
        """Declare states; ``range`` is the box the analysis may assume."""
        if self._dynamics is not None:
            raise PlantError("the dynamics stand already: declare all states before them")
        return self._declare(Role.STATE, names, limits=range, unit=unit, nominal=nominal)

    def inputs(
        self, names: str | Sequence[str], *, range: Any = None, unit: Any = "", nominal: Any = None
    ) -> tuple[sp.Symbol, ...]:
        """Declare known inputs; ``nominal`` is their value at the operating point."""
        return self._declare(Role.INPUT, names, limits=range, unit=unit, nominal=nominal)

    def unknown_inputs(
        self, names: str | Sequence[str], *, range: Any = None, unit: Any = ""
    ) -> tuple[sp.Symbol, ...]:
        """Declare unknown inputs, to be decoupled; their bounds are optional."""
        return self._declare(Role.UNKNOWN_INPUT, names, limits=range, unit=unit)

    def params(
        self,
        names: str | Sequence[str],
        value: Any = None,
        *,
        tolerance: Any = None,
        range: Any = None,
        unit: Any = "",
        constant: Any = True,
    ) -> tuple[sp.Symbol, ...]:
        """Declare parameters: a value, a value with a relative tolerance, or an interval.

        ``tolerance=0.05`` means 5 % to either side. A parameter with a plain value is a
        constant of the plant; ``constant=False`` lets it change inside its interval.
        """
        return self._declare(
            Role.PARAM,
            names,
            value=value,
            tolerance=tolerance,
            limits=range,
            unit=unit,
            constant=constant,
        )

    def scheduling(
        self,
        names: str | Sequence[str],
        *,
        range: Any = None,
        unit: Any = "",
        measured: Any = True,
        nominal: Any = None,
    ) -> tuple[sp.Symbol, ...]:
        """Declare scheduling variables; ``measured=False``: bounded but not known on line."""
        return self._declare(
            Role.SCHEDULING, names, limits=range, unit=unit, measured=measured, nominal=nominal
        )

    def disturbances(
        self, names: str | Sequence[str], *, bound: Any = None, range: Any = None, unit: Any = ""
    ) -> tuple[sp.Symbol, ...]:
        """Declare disturbances and noise: ``bound=b`` is [-b, b]; no bound: finite energy."""
        return self._declare(Role.DISTURBANCE, names, bound=bound, limits=range, unit=unit)

    def actuator_faults(
        self,
        names: str | Sequence[str],
        *,
        of: Any,
        range: Any = None,
        rate: Any = None,
        constant: Any = False,
        unit: Any = None,
    ) -> tuple[sp.Symbol, ...]:
        """Declare additive actuator faults: each input in ``of`` becomes input + fault."""
        return self._faults(Role.ACTUATOR_FAULT, names, of, range, rate, constant, unit)

    def sensor_faults(
        self,
        names: str | Sequence[str],
        *,
        of: Any,
        range: Any = None,
        rate: Any = None,
        constant: Any = False,
        unit: Any = None,
    ) -> tuple[sp.Symbol, ...]:
        """Declare additive sensor faults: each output named in ``of`` becomes output + fault."""
        return self._faults(Role.SENSOR_FAULT, names, of, range, rate, constant, unit)

    def process_faults(
        self,
        names: str | Sequence[str],
        *,
        range: Any = None,
        rate: Any = None,
        constant: Any = False,
        unit: Any = "",
    ) -> tuple[sp.Symbol, ...]:
        """Declare faults whose symbols stand in the equations themselves."""
        return self._declare(
            Role.PROCESS_FAULT, names, limits=range, rate=rate, constant=constant, unit=unit
        )

    faults = process_faults

    def dynamics(self, rows: Any, Ts: Any = None) -> None:
        """State the dynamics: time derivatives, or next values when ``Ts`` is given.

        Parameters
        ----------
        rows : sequence of expressions or column matrix
            One per state, in the order of the states.
        Ts : float or sympy.Rational, optional
            Sampling time in seconds of a discrete plant.
        """
        self._open("dynamics")
        if self._dynamics is not None:
            raise PlantError("the dynamics are given twice; make a new Plant to change them")
        found = read_rows(rows, self._symbols, "dynamics")
        if len(found) != len(self.x):
            raise PlantError(
                f"dynamics has {len(found)} rows for {len(self.x)} states "
                f"({', '.join(self.names('x'))})",
                rows=len(found),
                states=self.names("x"),
            )
        if not found:
            raise PlantError("a plant needs at least one state; declare states first")
        self._Ts = None if Ts is None else sampling_time(Ts)
        self._dynamics = found

    def outputs(
        self, rows: Any, *, names: str | Sequence[str] | None = None, unit: Any = ""
    ) -> tuple[str, ...]:
        """State the measured outputs; return their names (``y1``, ``y2``, ... by default)."""
        self._open("outputs")
        if self._outputs is not None:
            raise PlantError("the outputs are given twice; make a new Plant to change them")
        found = read_rows(rows, self._symbols, "outputs")
        if not found:
            raise PlantError("outputs is empty: an observer needs at least one measurement")
        given = [f"y{k}" for k in range(1, len(found) + 1)] if names is None else names
        named = expand_names(given, "output")
        if len(named) != len(found):
            raise PlantError(f"outputs has {len(found)} rows and {len(named)} names")
        units = tuple(per_symbol(unit, named, "unit"))
        if not all(isinstance(item, str) for item in units):
            raise PlantError(f"outputs: unit= is text such as 'cm', not {unit!r}")
        self._check_sensor_faults(named)
        self._outputs, self._output_names, self._output_units = found, named, units
        self._cache.clear()
        return named

    # -- reading -------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The plant's name."""
        return self._name

    @property
    def Ts(self) -> float | None:
        """Sampling time in seconds; None for a continuous plant."""
        return None if self._Ts is None else float(self._Ts)

    @property
    def signals(self) -> tuple[Signal, ...]:
        """All signals in order of declaration."""
        return tuple(self._signals.values())

    @property
    def x(self) -> tuple[Signal, ...]:
        """States."""
        return self._kind("x")

    @property
    def u(self) -> tuple[Signal, ...]:
        """Known inputs."""
        return self._kind("u")

    @property
    def d(self) -> tuple[Signal, ...]:
        """Unknown inputs."""
        return self._kind("d")

    @property
    def f(self) -> tuple[Signal, ...]:
        """Faults of every role, in order of declaration."""
        return self._kind("f")

    @property
    def w(self) -> tuple[Signal, ...]:
        """Disturbances."""
        return self._kind("w")

    @property
    def p(self) -> tuple[Signal, ...]:
        """Parameters that are known up to an interval."""
        return self._kind("p")

    @property
    def rho(self) -> tuple[Signal, ...]:
        """Scheduling variables."""
        return self._kind("rho")

    @property
    def constants(self) -> tuple[Signal, ...]:
        """Parameters with a plain value."""
        return tuple(s for s in self.signals if s.role is Role.PARAM and s.lower == s.upper)

    @property
    def constant_values(self) -> dict[sp.Symbol, sp.Expr]:
        """Exact value of every constant."""
        return {s.symbol: _value(s) for s in self.constants}

    @property
    def rhs(self) -> sp.Matrix:
        """Right-hand side (n, 1) with the faults inserted, constants as symbols."""
        return self._rows()[0]

    @property
    def output(self) -> sp.Matrix:
        """Output map (m, 1) with the faults inserted, constants as symbols."""
        return self._rows()[1]

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return self._output_names

    @property
    def output_units(self) -> tuple[str, ...]:
        """Units of the outputs."""
        return self._output_units

    @property
    def continuous(self) -> "Plant | None":
        """The plant this one was discretised from."""
        return None if self._origin is None else self._origin[0]

    @property
    def discretisation(self) -> str | None:
        """The method this plant was discretised with."""
        return None if self._origin is None else self._origin[1]

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of one kind: x, u, d, f, w, p or rho."""
        return tuple(signal.name for signal in self._kind(kind))

    def box(self, kind: str) -> NDArray[np.float64]:
        """Return lower and upper bounds of one kind, shape (number, 2)."""
        rows = [(signal.lower, signal.upper) for signal in self._kind(kind)]
        return np.array(rows, dtype=np.float64).reshape(len(rows), 2)

    def check(self) -> Self:
        """Return the plant itself when it is complete and consistent, else refuse it."""
        if self._dynamics is None:
            raise PlantError(f"plant {self.name!r} has no dynamics yet: call plant.dynamics([...])")
        if self._outputs is None:
            raise PlantError(f"plant {self.name!r} has no outputs yet: call plant.outputs([...])")
        self._check_sensor_faults(self._output_names)
        return self

    def sx(self, constants: Literal["value", "symbol"] = "value") -> SxModel:
        """Return the plant as CasADi SX expressions (cached, checked against SymPy)."""
        if constants not in ("value", "symbol"):
            raise PlantError(f"constants= is 'value' or 'symbol', not {constants!r}")
        key = f"sx {constants}"
        if key not in self._cache:
            self._cache[key] = build_sx(self.check(), constants)
            self._in_use = True
        result: SxModel = self._cache[key]
        return result

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho) -> (rhs, y) as a CasADi function (cached)."""
        if "function" not in self._cache:
            self._cache["function"] = self.sx().function()
        function: ca.Function = self._cache["function"]
        return function

    def discretise(self, method: str, Ts: Any) -> "Plant":
        """Return the discrete plant for ``"euler"`` or ``"rk4"`` and a sampling time in s."""
        rows, step = discrete_rows(self.check(), method, Ts)
        self._in_use = True
        result = Plant(self.name)
        for signal in self.signals:
            rate = None if signal.rate is None else signal.rate * float(step)
            result._signals[signal.name] = replace(signal, rate=rate)
        result._dynamics, result._outputs = rows, self._outputs
        result._output_names, result._output_units = self.output_names, self.output_units
        result._Ts, result._origin = step, (self, method)
        return result

    def __repr__(self) -> str:
        time = "continuous" if self.Ts is None else f"Ts = {self.Ts:g} s"
        counts = ", ".join(f"{len(self._kind(k))} {k}" for k in _KINDS if self._kind(k))
        return f"Plant({self.name!r}, {time}: {counts}, {len(self._output_names)} y)"

    # -- inside --------------------------------------------------------------------

    @property
    def _symbols(self) -> dict[str, sp.Symbol]:
        return {name: signal.symbol for name, signal in self._signals.items()}

    def _kind(self, kind: str) -> tuple[Signal, ...]:
        if kind not in _KINDS:
            raise PlantError(f"{kind!r} is no kind of signal; kinds are {', '.join(_KINDS)}")
        roles = _KINDS[kind]
        found = tuple(signal for signal in self.signals if signal.role in roles)
        return tuple(s for s in found if s.lower < s.upper) if kind == "p" else found

    def _open(self, what: str) -> None:
        if self._in_use:
            raise PlantError(
                f"plant {self.name!r} is in use already: {what} cannot be added; make a new Plant"
            )

    def _declare(self, role: Role, names: Any, **options: Any) -> tuple[sp.Symbol, ...]:
        self._open("signals")
        signals = make_signals(role, names, **options)
        for signal in signals:
            known = self._signals.get(signal.name)
            if known is not None:
                raise PlantError(
                    f"{role} {signal.name}: the name is taken by the {known.role} {known.name}",
                    symbol=signal.name,
                )
        self._signals.update({signal.name: signal for signal in signals})
        self._cache.clear()
        return tuple(signal.symbol for signal in signals)

    def _faults(
        self, role: Role, names: Any, of: Any, limits: Any, rate: Any, constant: Any, unit: Any
    ) -> tuple[sp.Symbol, ...]:
        found = expand_names(names, str(role))
        targets = self._targets(role, found, of)
        if unit is None:
            unit = [self._signals[t].unit if t in self._signals else "" for t in targets]
        return self._declare(
            role, names, limits=limits, rate=rate, constant=constant, unit=unit, of=targets
        )

    def _targets(self, role: Role, names: tuple[str, ...], of: Any) -> list[str]:
        """Return what each fault adds to, one input or output name per fault."""
        items = [of] if isinstance(of, str | sp.Symbol) else of
        if not isinstance(items, Sequence):
            raise PlantError(f"{role} {names[0]}: of= names inputs or outputs, not {of!r}")
        targets = [t for item in items for t in expand_names(str(item), f"{role}: of=")]
        if len(targets) != len(names):
            raise PlantError(
                f"{role}: {len(names)} faults ({', '.join(names)}) for {len(targets)} signals "
                f"in of= ({', '.join(targets)})"
            )
        taken = {s.of: s.name for s in self.signals if s.role is role}
        for name, target in zip(names, targets, strict=True):
            if role is Role.ACTUATOR_FAULT and target not in self.names("u"):
                raise PlantError(
                    f"{role} {name}: of={target} is no input; inputs are "
                    f"{', '.join(self.names('u')) or 'none yet'}",
                    symbol=name,
                    of=target,
                )
            if target in taken:
                raise PlantError(
                    f"{role} {name}: {target} has the fault {taken[target]} already", symbol=name
                )
            taken[target] = name
        if role is Role.SENSOR_FAULT and self._outputs is not None:
            self._check_of(names, targets, self._output_names)
        return targets

    def _check_sensor_faults(self, outputs: tuple[str, ...]) -> None:
        found = [s for s in self.signals if s.role is Role.SENSOR_FAULT]
        self._check_of([s.name for s in found], [str(s.of) for s in found], outputs)

    def _check_of(
        self, names: Sequence[str], targets: Sequence[str], outputs: tuple[str, ...]
    ) -> None:
        for name, target in zip(names, targets, strict=True):
            if target not in outputs:
                raise PlantError(
                    f"sensor fault {name}: of={target} is no output; outputs are "
                    f"{', '.join(outputs)}",
                    symbol=name,
                    of=target,
                )

    def _rows(self) -> tuple[sp.Matrix, sp.Matrix]:
        if "rows" not in self._cache:
            self.check()
            self._cache["rows"] = insert_faults(self)
        rows: tuple[sp.Matrix, sp.Matrix] = self._cache["rows"]
        return rows


def insert_faults(plant: Plant) -> tuple[sp.Matrix, sp.Matrix]:
    """Return dynamics and outputs with v -> v + f and y -> y + f applied."""
    inputs = {s.name: s.symbol for s in plant.u}
    shift = {
        inputs[str(s.of)]: inputs[str(s.of)] + s.symbol
        for s in plant.f
        if s.role is Role.ACTUATOR_FAULT
    }
    sensor = {s.of: s.symbol for s in plant.f if s.role is Role.SENSOR_FAULT}
    rhs = [row.xreplace(shift) for row in plant._dynamics or ()]
    y = [
        row.xreplace(shift) + sensor.get(name, 0)
        for name, row in zip(plant.output_names, plant._outputs or (), strict=True)
    ]
    return sp.ImmutableMatrix(len(rhs), 1, rhs), sp.ImmutableMatrix(len(y), 1, y)


def _value(signal: Signal) -> sp.Expr:
    """Return the exact value of a constant, given as a value or as an interval of one point."""
    return exact_number(signal.lower, signal.name) if signal.value is None else signal.value
