"""CasADi functions as SymPy expressions, by walking the instruction tape."""

from collections.abc import Callable, Sequence
from typing import Any

import casadi as ca
import sympy as sp

from obsynth.symbolic.errors import PlantError


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


_NAMED = (
    "exp log sqrt sin cos tan asin acos atan atan2 sinh cosh tanh asinh acosh atanh sign floor erf"
)
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
