"""Plants from CasADi expressions: functions as SymPy expressions, by walking the instructions."""

from collections.abc import Callable, Mapping, Sequence
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

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant

_NAMED = (
    "exp log sqrt sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh sign floor erf"
)
_METHODS = {
    "x": ("states", ("range", "unit", "nominal")),
    "u": ("inputs", ("range", "unit", "nominal")),
    "d": ("unknown_inputs", ("range", "unit", "nominal")),
    "f": ("process_faults", ("range", "rate", "constant", "unit")),
    "w": ("disturbances", ("bound", "range", "unit")),
    "p": ("params", ("value", "tolerance", "range", "unit", "constant")),
    "rho": ("scheduling", ("range", "unit", "measured", "nominal")),
}


def _lift(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let a function of numbers take conditions, which CasADi counts as 0 and 1."""
    return lambda *values: function(*map(_number, values))


def _number(value: sp.Basic) -> sp.Expr:
    if _is_condition(value):
        return sp.Piecewise((1, value), (0, True))
    return value


def _condition(value: sp.Basic) -> sp.Basic:
    return value if _is_condition(value) else sp.Ne(value, 0)


def _is_condition(value: sp.Basic) -> bool:
    # A Symbol is a Boolean for SymPy; only what is no expression is a condition here.
    return not isinstance(value, sp.Expr)


def _add(left: sp.Basic, right: sp.Basic) -> sp.Expr:
    """Add; the two halves CasADi makes of an if_else become one Piecewise again."""
    left, right = _number(left), _number(right)
    one, two = _guarded(left), _guarded(right)
    if one and two and one[1] == sp.Not(two[1]):
        return sp.Piecewise((one[0], one[1]), (two[0], True))
    return left + right


def _guarded(value: sp.Expr) -> tuple[sp.Expr, sp.Basic] | None:
    """Return (expression, condition) of what is zero unless a condition holds."""
    if isinstance(value, sp.Piecewise) and len(value.args) == 2 and value.args[1] == (0, True):
        expression, condition = value.args[0]
        return expression, condition
    return None


_OPERATIONS: dict[int, Callable[..., Any]] = {
    **{getattr(ca, f"OP_{n.upper()}"): _lift(getattr(sp, n)) for n in _NAMED.split()},
    ca.OP_ASSIGN: lambda a: a,
    ca.OP_ADD: _add,
    ca.OP_SUB: _lift(lambda a, b: a - b),
    ca.OP_MUL: _lift(lambda a, b: a * b),
    ca.OP_DIV: _lift(lambda a, b: a / b),
    ca.OP_NEG: _lift(lambda a: -a),
    ca.OP_POW: _lift(lambda a, b: a**b),
    ca.OP_CONSTPOW: _lift(lambda a, b: a**b),
    ca.OP_SQ: _lift(lambda a: a**2),
    ca.OP_TWICE: _lift(lambda a: 2 * a),
    ca.OP_INV: _lift(lambda a: 1 / a),
    ca.OP_FABS: _lift(sp.Abs),
    ca.OP_CEIL: _lift(sp.ceiling),
    ca.OP_FMIN: _lift(sp.Min),
    ca.OP_FMAX: _lift(sp.Max),
    ca.OP_LOG1P: _lift(lambda a: sp.log(1 + a)),
    ca.OP_EXPM1: _lift(lambda a: sp.exp(a) - 1),
    ca.OP_HYPOT: _lift(lambda a, b: sp.sqrt(a**2 + b**2)),
    ca.OP_LT: _lift(sp.Lt),
    ca.OP_LE: _lift(sp.Le),
    ca.OP_EQ: _lift(sp.Eq),
    ca.OP_NE: _lift(sp.Ne),
    ca.OP_NOT: lambda a: sp.Not(_condition(a)),
    ca.OP_AND: lambda a, b: sp.And(_condition(a), _condition(b)),
    ca.OP_OR: lambda a, b: sp.Or(_condition(a), _condition(b)),
    ca.OP_IF_ELSE_ZERO: lambda c, a: sp.Piecewise((_number(a), _condition(c)), (0, True)),
}


class _Unsupported(str):
    """The name of an operation without a SymPy form, standing for its result."""

    __slots__ = ()


def from_tape(
    function: ca.Function, arguments: Sequence[Sequence[sp.Symbol]], labels: Sequence[str]
) -> list[sp.Expr]:
    """Convert the scalar outputs of an SX function of dense columns to SymPy.

    arguments: the symbols of every input, entry by entry; labels: what outputs are called in errors
    """
    work: dict[int, Any] = {}
    results: list[sp.Expr] = [sp.Integer(0)] * function.n_out()
    for index in range(function.n_instructions()):
        code = function.instruction_id(index)
        sources, targets = function.instruction_input(index), function.instruction_output(index)
        if code == ca.OP_CONST:
            work[targets[0]] = _constant(function.instruction_constant(index))
        elif code == ca.OP_INPUT:
            work[targets[0]] = arguments[sources[0]][sources[1]]
        elif code == ca.OP_OUTPUT:
            results[targets[0]] = _result(work[sources[0]], labels[targets[0]])
        else:
            work[targets[0]] = _apply(code, [work[source] for source in sources])
    return results


def _apply(code: int, values: list[Any]) -> Any:
    missing = next((value for value in values if isinstance(value, _Unsupported)), None)
    if missing is not None:
        return missing
    if code not in _OPERATIONS:
        return _Unsupported(_operation_name(code))
    return _OPERATIONS[code](*values)


def _result(value: Any, label: str) -> sp.Expr:
    if isinstance(value, _Unsupported):
        raise PlantError(
            f"{label}: the CasADi operation {value} has no SymPy form; write the equation "
            "without it",
            operation=str(value),
            where=label,
        )
    return _number(value)


def _constant(value: float) -> sp.Expr:
    return sp.Integer(int(value)) if float(value).is_integer() else sp.Float(value)


def _operation_name(code: int) -> str:
    names = (name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == code)
    return next(names, f"OP {code}").removeprefix("OP_").lower()


def expand_function(function: ca.Function) -> ca.Function:
    """Expand an MX function to SX, or say what in it cannot be expanded."""
    if function.is_a("SXFunction"):
        return function
    expanded, reason = _expand(function)
    if expanded is not None:
        return expanded
    culprit = _culprit(function)
    raise PlantError(
        f"the MX expression cannot be expanded to SX because of {culprit or 'a part of it'} "
        f"({reason}); write the equation without it",
        function=culprit,
    )


def _expand(function: ca.Function) -> tuple[ca.Function | None, str]:
    """Return the expanded function, or None and the reason."""
    try:
        expanded = function.expand()
    except RuntimeError as error:
        # CasADi's last line says which class refuses.
        return None, str(error).strip().splitlines()[-1].split(": ", 1)[-1]
    # Calls may survive as opaque nodes of the SX graph.
    codes = (expanded.instruction_id(k) for k in range(expanded.n_instructions()))
    return (None, "it stays a call") if ca.OP_CALL in codes else (expanded, "")


def _culprit(function: ca.Function) -> str | None:
    """Return the innermost called function that does not expand."""
    for index in range(function.n_instructions()):
        node = function.instruction_MX(index)
        if not node.is_call():
            continue
        called = node.which_function()
        if _expand(called)[0] is None:
            inner = _culprit(called) if called.is_a("MXFunction") else None
            return inner or f"{called.name()} ({called.class_name()})"
    return None


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
