"""The plant: signals, dynamics and outputs as the control engineer writes them."""

from collections.abc import Sequence
from typing import Any, Literal, Self

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.symbolic import altered, declarations
from obsynth.symbolic.declarations import Names, Symbols
from obsynth.symbolic.discretise import PREFIX, Step, discretised, next_values, sampling_time
from obsynth.symbolic.display import plant_html, plant_latex
from obsynth.symbolic.equations import insert_faults, read_dynamics, read_outputs
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.from_casadi import plant_from_casadi
from obsynth.symbolic.serialize import plant_from_dict, plant_to_dict
from obsynth.symbolic.signal_table import SignalTable, check_targets
from obsynth.symbolic.signals import KINDS, LONGEST_NAME, Role, Signal, one_line
from obsynth.symbolic.sxmodel import SxModel, build_sx

Rows = tuple[sp.Expr, ...]


class Plant:
    """A nonlinear plant, declared signal by signal.

    Parameters
    ----------
    name : str
        What the plant is called in titles, reports and headers.

    Raises
    ------
    PlantError
        By every method, for what cannot be accepted; the plant is then as before.

    Notes
    -----
    Every declaration takes names as ``sympy.symbols`` does and returns a tuple of real
    SymPy symbols, for use in ordinary SymPy expressions.

    The states are complete once the dynamics stand. Everything else may be added until
    the plant is used (converted to CasADi or discretised).

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
            raise PlantError(f"a plant's name is a non-empty text, not {name!r}", name=name)
        self._name = one_line(name, "a plant's name", LONGEST_NAME, name=name)
        self._table = SignalTable()
        self._dynamics: Rows | None = None
        self._outputs: dict[str, sp.Expr] | None = None
        self._output_units: tuple[str, ...] = ()
        self._output_ranges: tuple[tuple[float, float], ...] = ()
        self._Ts: sp.Expr | None = None
        self._origin: tuple[Plant, Step] | None = None
        self._remainder: tuple[Signal, ...] | None = None
        self._in_use = False
        self._cache: dict[str, Any] = {}

    # -- declarations --------------------------------------------------------------

    states = declarations.states
    inputs = declarations.inputs
    unknown_inputs = declarations.unknown_inputs
    params = declarations.params
    scheduling = declarations.scheduling
    disturbances = declarations.disturbances
    actuator_faults = declarations.actuator_faults
    sensor_faults = declarations.sensor_faults
    process_faults = declarations.process_faults
    faults = declarations.process_faults
    with_ranges = altered.with_ranges
    with_params = altered.with_params

    def declare(self, role: Role, names: Names, **keywords: Any) -> Symbols:
        """Declare signals of a role; the methods above say which keywords it takes."""
        self._refuse_in_use("signals")
        self._cache.clear()
        if "of" in keywords:
            outputs = dict(zip(self.output_names, self.output_units, strict=True))
            return self._table.declare_faults(role, names, outputs=outputs, **keywords)
        return self._table.declare(role, names, self.output_names, **keywords)

    def add_signals(self, signals: Sequence[Signal]) -> None:
        """Add signals made elsewhere."""
        self._refuse_in_use("signals")
        self._cache.clear()
        self._table.add(signals, self.output_names)

    def dynamics(self, rows: Any, Ts: Any = None) -> None:
        """State the dynamics: time derivatives, or next values where ``Ts`` is given.

        Parameters
        ----------
        rows : sequence of expressions, a column matrix, or mapping of state to expression
            One per state, without a mapping in their order: SymPy, numbers, or text.
        Ts : float or sympy.Rational, optional
            Sampling time in s of a discrete plant.
        """
        self._refuse_in_use("dynamics")
        if self._dynamics is not None:
            raise PlantError("the dynamics are given twice; make a new Plant to change them")
        found = read_dynamics(rows, self._table.symbols, self.names("x"))
        self._Ts = None if Ts is None else sampling_time(Ts)
        self._dynamics = found

    def outputs(
        self, rows: Any, *, names: Names | None = None, unit: Any = "", range: Any = None
    ) -> tuple[str, ...]:
        """State the measured outputs.

        Parameters
        ----------
        rows : sequence of expressions, a column matrix, or mapping of name to expression
            Functions of states, inputs, disturbances, parameters.
        names : str or sequence of str, optional
            One per row; those of a mapping, or ``y1``, ``y2``, ... by default.
        unit : str or sequence of str
        range : pair of float or sequence of pairs, optional
            What a healthy sensor shows: (lower, upper), or one pair per row, None where
            nothing is known. Either end may be infinite. A reading outside is no measurement.

        Returns
        -------
        tuple of str
            The names, which ``sensor_faults(of=)`` takes.
        """
        self._refuse_in_use("outputs")
        if self._outputs is not None:
            raise PlantError("the outputs are given twice; make a new Plant to change them")
        found, units, ranges = read_outputs(rows, self._table.symbols, names, unit, range)
        check_targets(self.signals, tuple(found))
        self._outputs, self._output_units, self._output_ranges = found, units, ranges
        return tuple(found)

    # -- reading -------------------------------------------------------------------

    @property
    def name(self) -> str:
        """The plant's name."""
        return self._name

    @property
    def Ts(self) -> float | None:
        """Sampling time in s; None for a continuous plant."""
        return None if self._Ts is None else float(self._Ts)

    @property
    def exact_Ts(self) -> sp.Expr | None:
        """Sampling time in s as it stands in the equations."""
        return self._Ts

    @property
    def signals(self) -> tuple[Signal, ...]:
        """All signals in order of declaration."""
        return self._table.all

    @property
    def x(self) -> tuple[Signal, ...]:
        """States."""
        return self._table.kind("x")

    @property
    def u(self) -> tuple[Signal, ...]:
        """Known inputs."""
        return self._table.kind("u")

    @property
    def d(self) -> tuple[Signal, ...]:
        """Unknown inputs."""
        return self._table.kind("d")

    @property
    def f(self) -> tuple[Signal, ...]:
        """Faults of every role, in order of declaration."""
        return self._table.kind("f")

    @property
    def w(self) -> tuple[Signal, ...]:
        """Disturbances."""
        return self._table.kind("w")

    @property
    def p(self) -> tuple[Signal, ...]:
        """Parameters known up to a range of positive width."""
        return self._table.kind("p")

    @property
    def rho(self) -> tuple[Signal, ...]:
        """Scheduling variables."""
        return self._table.kind("rho")

    @property
    def constants(self) -> tuple[Signal, ...]:
        """Parameters with a plain value."""
        return self._table.constants

    @property
    def constant_values(self) -> dict[sp.Symbol, sp.Expr]:
        """Exact value of every constant."""
        return self._table.constant_values

    @property
    def has_dynamics(self) -> bool:
        """True once the dynamics are given."""
        return self._dynamics is not None or self._origin is not None

    @property
    def has_outputs(self) -> bool:
        """True once the outputs are given."""
        return self._outputs is not None

    @property
    def equations(self) -> tuple[Rows, Rows]:
        """Dynamics and outputs as they were given, before faults are inserted."""
        if self._dynamics is None and self._origin is not None:
            origin, step = self._origin
            symbols = [signal.symbol for signal in self.x]
            rows = next_values(step, symbols, origin.equations[0], self._Ts)
            rest = {signal.name: signal.symbol for signal in self._remainder or ()}
            self._dynamics = tuple(
                row + rest.get(f"{PREFIX}{symbol}", 0)
                for row, symbol in zip(rows, symbols, strict=True)
            )
        return self._dynamics or (), tuple((self._outputs or {}).values())

    @property
    def rhs(self) -> sp.Matrix:
        """Right-hand side (n, 1), faults inserted, constants as symbols."""
        return self._rows()[0]

    @property
    def output(self) -> sp.Matrix:
        """Output map (m, 1), faults inserted, constants as symbols."""
        return self._rows()[1]

    @property
    def output_names(self) -> tuple[str, ...]:
        """Names of the outputs."""
        return tuple(self._outputs or ())

    @property
    def output_units(self) -> tuple[str, ...]:
        """Units of the outputs."""
        return self._output_units

    @property
    def output_ranges(self) -> NDArray[np.float64]:
        """What healthy sensors show, shape (m, 2), infinite where nothing is declared."""
        return np.array(self._output_ranges, dtype=np.float64).reshape(-1, 2)

    @property
    def continuous(self) -> "Plant | None":
        """The continuous plant this one was made from."""
        return None if self._origin is None else self._origin[0]

    @property
    def discretisation(self) -> str | None:
        """Name of the method this plant was discretised with; of ``taylor`` also the order."""
        return None if self._origin is None else str(self._origin[1])

    @property
    def step(self) -> Step | None:
        """The formula of the step this plant was discretised with."""
        return None if self._origin is None else self._origin[1]

    @property
    def remainder(self) -> tuple[Signal, ...] | None:
        """Disturbances that carry what the discretisation leaves out; None where nothing does.

        Where it is not None, what holds for this plant holds for the continuous one at the
        sampling instants: inputs, unknown inputs, disturbances and faults without a rate held over
        each step, faults with a rate moving within it, states within their ranges.
        """
        return self._remainder

    def names(self, kind: str) -> tuple[str, ...]:
        """Return the names of a kind of signals: x, u, d, f, w, p or rho."""
        return self._table.names(kind)

    def box(self, kind: str) -> NDArray[np.float64]:
        """Return lower and upper bounds of a kind of signals, shape (number, 2)."""
        return self._table.box(kind)

    # -- using ---------------------------------------------------------------------

    def check(self) -> Self:
        """Return the plant itself when it is complete and consistent; refuse it otherwise."""
        if not self.has_dynamics:
            raise PlantError(f"plant {self.name!r} has no dynamics yet: call plant.dynamics([...])")
        if not self.has_outputs:
            raise PlantError(f"plant {self.name!r} has no outputs yet: call plant.outputs([...])")
        check_targets(self.signals, self.output_names)
        return self

    def sx(self, constants: Literal["value", "symbol"] = "value") -> SxModel:
        """Return the plant in CasADi's SX, compared with SymPy at random points of the box.

        Parameters
        ----------
        constants : {"value", "symbol"}
            Whether constants are numbers in the expressions or symbols in ``SxModel.c``.

        Returns
        -------
        SxModel
            The same object at every call.

        Raises
        ------
        PlantError
            The plant is not complete.
        ParityError
            The two forms differ (a defect of the conversion; the row and point are named).
        """
        key = f"sx {constants}"
        if key not in self._cache:
            self._cache[key] = build_sx(self.check(), constants)
            self._in_use = True
        model: SxModel = self._cache[key]
        return model

    def function(self) -> ca.Function:
        """Return (x, u, d, f, w, p, rho) -> (rhs, y) as a CasADi function."""
        if "function" not in self._cache:
            self._cache["function"] = self.sx().function()
        function: ca.Function = self._cache["function"]
        return function

    def discretise(
        self,
        method: str,
        Ts: Any,
        order: int | None = None,
        remainder: Any = None,
    ) -> "Plant":
        """Return the discrete plant of a continuous one.

        Parameters
        ----------
        method : {"euler", "rk4", "taylor"}
            ``"taylor"``: the Taylor polynomial of the solution.
        Ts : float or sympy.Rational
            Sampling time in s.
        order : int, optional
            Of ``"taylor"``, 1 to 6 (1 is Euler's method); by default the lowest after which the
            remainder no longer matters.
        remainder : bool, optional
            Whether what the step leaves out becomes a disturbance ``remainder_x`` of every state
            x, with a proved range (see ``discretisation_remainder``), so that what holds for the
            discrete plant holds for the continuous one at the sampling instants. Faults with a
            rate may move within a step, everything else is held over it. By default for
            ``"taylor"`` only.

        Returns
        -------
        Plant
            D, W1 and rates are multiplied by Ts; the outputs are the same. ``.remainder`` lists
            the disturbances that carry a remainder.

        Raises
        ------
        PlantError
            A plant that is discrete already; a kink, which has no Taylor polynomial of order 2.
        UnboundedError, FlowError
            A signal without a range, or solutions that cannot be enclosed over a step.

        Examples
        --------
        >>> from obsynth import Plant
        >>> plant = Plant("decay")
        >>> (x,) = plant.states("x", range=(1, 2))
        >>> plant.dynamics([-x]); plant.outputs([x])
        ('y1',)
        >>> step = plant.discretise("taylor", Ts=0.1, order=2)
        >>> step.names("w"), step.remainder[0].lower > -0.1**3 / 3 * 1.1
        (('remainder_x',), True)
        """
        result = Plant(self.name)
        step, result._Ts, signals, result._remainder = discretised(
            self, method, Ts, order, remainder
        )
        result._origin = self, step
        result._table = SignalTable([*signals, *(result._remainder or ())])
        result._outputs, result._output_units = self._outputs, self._output_units
        result._output_ranges = self._output_ranges
        self._in_use = result._in_use = True
        return result

    from_casadi = classmethod(plant_from_casadi)
    from_dict = classmethod(plant_from_dict)
    to_dict = plant_to_dict

    def __repr__(self) -> str:
        time = "continuous" if self.Ts is None else f"Ts = {self.Ts:g} s"
        counts = [f"{len(self.names(kind))} {kind}" for kind in KINDS if self.names(kind)]
        counts.append(f"{len(self.output_names)} y")
        return f"Plant({self.name!r}, {time}: {', '.join(counts)})"

    def _repr_latex_(self) -> str:
        return plant_latex(self)

    def _repr_html_(self) -> str:
        return plant_html(self)

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_cache": {}}

    # -- inside --------------------------------------------------------------------

    def _refuse_in_use(self, what: str) -> None:
        if self._in_use:
            raise PlantError(
                f"plant {self.name!r} is in use already: {what} cannot be added any more; "
                "make a new Plant"
            )

    def _rows(self) -> tuple[sp.Matrix, sp.Matrix]:
        dynamics, outputs = self.equations
        key = f"rows {len(dynamics)} {len(outputs)}"
        if key not in self._cache:
            named = dict(zip(self.output_names, outputs, strict=True))
            self._cache[key] = insert_faults(dynamics, named, self.signals)
        rows: tuple[sp.Matrix, sp.Matrix] = self._cache[key]
        return rows
