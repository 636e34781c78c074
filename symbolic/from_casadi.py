"""Plants from CasADi expressions."""

from collections.abc import Mapping
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import sympy as sp
from numpy.typing import NDArray

from obsynth.symbolic.declarations import Names
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.signals import expand_names
from obsynth.symbolic.sxmodel import check_parity, sample_box
from obsynth.symbolic.tape import expand_function, from_tape

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


_METHODS = {
    "x": ("states", ("range", "unit", "nominal")),
    "u": ("inputs", ("range", "unit", "nominal")),
    "d": ("unknown_inputs", ("range", "unit", "nominal")),
    "f": ("process_faults", ("range", "rate", "constant", "unit")),
    "w": ("disturbances", ("bound", "range", "unit")),
    "p": ("params", ("value", "tolerance", "range", "unit", "constant")),
    "rho": ("scheduling", ("range", "unit", "measured", "nominal")),
}


class CasadiSystem:
    """Right-hand side and outputs as one SX function of named scalars.

    columns: the symbols of each kind (x, u, d, f, w, p, rho)
    rhs, y: the expressions, both of the same type as the symbols
    names: names of the signals of a kind where CasADi's own will not do
    names: the names of the signals of every kind given
    function: the expanded function, blocks of symbols to scalar rows
    """

    def __init__(
        self, columns: Mapping[str, Any], rhs: Any, y: Any, names: Mapping[str, Any]
    ) -> None:
        columns = {kind: column for kind, column in columns.items() if column is not None}
        unknown = set(names) - set(columns)
        if unknown:
            raise PlantError(f"from_casadi: names= has {min(unknown)!r}, which is not given")
        self.names: dict[str, tuple[str, ...]] = {}
        self._blocks: list[Any] = []
        self._sizes: list[int] = []
        for kind, column in columns.items():
            self.names[kind] = self._add(kind, column, names.get(kind))
        rows = [_rows("xdot or xnext", rhs), _rows("y", y)]
        self.rows = rows[0].numel()
        if len({type(item) for item in (*self._blocks, *rows)}) > 1:
            raise PlantError("from_casadi: SX and MX expressions are mixed; use one of them")
        function = ca.Function("plant", self._blocks, rows, {"allow_free": True})
        if function.has_free():
            free = sorted(str(item) for item in function.get_free())
            raise PlantError(
                f"from_casadi: the expressions depend on {', '.join(free)}, which none of "
                "x=, u=, d=, f=, w=, p=, rho= lists",
                free=tuple(free),
            )
        self.function = _scalar_rows(expand_function(function))

    def _add(self, kind: str, column: Any, given: Any) -> tuple[str, ...]:
        found: list[str] = []
        for block in column if isinstance(column, list | tuple) else [column]:
            if not isinstance(block, ca.SX | ca.MX) or not block.is_column():
                raise PlantError(f"from_casadi: {kind}= needs columns of CasADi symbols")
            if not block.is_valid_input():
                raise PlantError(f"from_casadi: {kind}={block} is an expression, not symbols")
            self._blocks.append(block)
            self._sizes.append(block.numel())
            found += _names_of(block)
        named = expand_names(found if given is None else given, f"from_casadi: {kind}")
        if len(named) != len(found):
            raise PlantError(f"from_casadi: {len(named)} names for {len(found)} entries of {kind}=")
        return named

    def expressions(self, symbols: Mapping[str, sp.Symbol]) -> list[sp.Expr]:
        """Return the rows of rhs, then those of y, in SymPy."""
        flat = [symbols[name] for names in self.names.values() for name in names]
        arguments = [list(part) for part in self._cut(flat)]
        return from_tape(self.function, arguments, self.labels)

    @property
    def labels(self) -> list[str]:
        """What the rows are called in messages."""
        dynamics = [f"dynamics row {k}" for k in range(1, self.rows + 1)]
        count = self.function.n_out() - self.rows
        return dynamics + [f"outputs row {k}" for k in range(1, count + 1)]

    def values(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return all rows at one point, entries in the order of ``names``."""
        found = self.function.call([ca.DM(list(part)) for part in self._cut(list(point))])
        return np.array([float(value) for value in found])

    def _cut(self, flat: list[Any]) -> list[list[Any]]:
        return [flat[a:b] for a, b in pairwise(np.cumsum([0, *self._sizes]))]


def plant_from_casadi(
    cls: type["Plant"],
    /,
    name: str,
    *,
    x: Any,
    y: Any,
    u: Any = None,
    d: Any = None,
    f: Any = None,
    w: Any = None,
    p: Any = None,
    rho: Any = None,
    xdot: Any = None,
    xnext: Any = None,
    Ts: Any = None,
    range: Any = None,
    names: Mapping[str, Any] | None = None,
    output_names: Names | None = None,
    output_unit: Any = "",
    output_range: Any = None,
    **options: Any,
) -> "Plant":
    """Make a plant from CasADi expressions, SX or MX.

    The equations are kept in SymPy from then on, compared with the CasADi function
    at random points of the box. Faults stand in the expressions themselves.
    """
    if (xdot is None) == (xnext is None):
        raise PlantError("from_casadi: give xdot= (continuous) or xnext= (discrete)")
    if xnext is None and Ts is not None:
        raise PlantError("from_casadi: Ts= goes with xnext=; discretise a continuous plant")
    step = None if xnext is None else 1 if Ts is None else Ts
    columns = {"x": x, "u": u, "d": d, "f": f, "w": w, "p": p, "rho": rho}
    rhs = xdot if xnext is None else xnext
    plant = cls(name)
    options["range"] = range
    system = CasadiSystem(columns, rhs, y, names or {})
    _declare(plant, system, options)
    signals = {signal.name: signal for signal in plant.signals}
    ordered = [signals[name] for named in system.names.values() for name in named]
    rows = system.expressions({signal.name: signal.symbol for signal in ordered})
    plant.dynamics(rows[: system.rows], Ts=step)
    keywords = {"names": output_names, "unit": output_unit, "range": output_range}
    plant.outputs(rows[system.rows :], **keywords)
    box = np.array([(s.lower, s.upper) for s in ordered])
    centre = np.array([0.0 if s.nominal is None else s.nominal for s in ordered])
    points = sample_box(box, around=centre)
    symbols = [s.symbol for s in ordered]
    check_parity(rows, symbols, system.values, points, system.labels)
    return plant


def _declare(plant: "Plant", system: CasadiSystem, options: Mapping[str, Any]) -> None:
    """Declare the signals with the keywords that are theirs."""
    by_word = {word: _by_kind(word, option, system) for word, option in options.items()}
    known = {word for _, allowed in _METHODS.values() for word in allowed}
    unknown = sorted(set(options) - known)
    if unknown:
        raise PlantError(
            f"from_casadi: {unknown[0]}= is no keyword; signals take {', '.join(sorted(known))}",
            keyword=unknown[0],
        )
    for kind, named in system.names.items():
        method, allowed = _METHODS[kind]
        keywords = {word: by_kind[kind] for word, by_kind in by_word.items() if kind in by_kind}
        wrong = sorted(set(keywords) - set(allowed))
        if wrong:
            raise PlantError(
                f"from_casadi: {wrong[0]}= means nothing for {kind}; {method} take "
                f"{', '.join(allowed)}",
                kind=kind,
                keyword=wrong[0],
            )
        getattr(plant, method)(named, **keywords)


def _by_kind(word: str, option: Any, system: CasadiSystem) -> dict[str, Any]:
    """Return the value of a keyword for every kind that has one."""
    if option is None:
        return {}
    if not isinstance(option, Mapping):
        option = {"x": option}
    known = {name for names in system.names.values() for name in names}
    unknown = [key for key in option if key not in known and key not in system.names]
    if unknown:
        raise PlantError(
            f"from_casadi: {word}= has {unknown[0]!r}, which is neither a kind given "
            f"({', '.join(system.names)}) nor a signal ({', '.join(sorted(known))})",
            keyword=word,
        )
    absent = "" if word == "unit" else None
    picked: dict[str, Any] = {}
    for kind, names in system.names.items():
        if kind in option:
            picked[kind] = option[kind]
        elif any(name in option for name in names):
            picked[kind] = [option.get(name, absent) for name in names]
    return picked


def _rows(what: str, value: Any) -> Any:
    if isinstance(value, list | tuple):
        value = ca.vertcat(*value)
    if not isinstance(value, ca.SX | ca.MX) or not value.is_column():
        raise PlantError(f"from_casadi: {what}= needs a column of CasADi expressions, not {value}")
    return ca.densify(value)


def _names_of(block: Any) -> list[str]:
    if isinstance(block, ca.SX):
        return [block[k].name() for k in range(block.numel())]
    count = block.numel()
    return [block.name()] if count == 1 else [f"{block.name()}_{k}" for k in range(count)]


def _scalar_rows(function: ca.Function) -> ca.Function:
    inputs = function.sx_in()
    rows = [entry for column in function.call(inputs) for entry in ca.vertsplit(column)]
    return ca.Function("plant", inputs, rows)
