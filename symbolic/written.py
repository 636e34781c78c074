"""Expressions written in the language that `text` reads."""

import sympy as sp
from sympy.core.relational import Relational
from sympy.logic.boolalg import And, BooleanFalse, BooleanTrue, Not, Or

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.functions import BY_CLASS
from obsynth.symbolic.text import COMPARE, CONDITIONS

_SIGNS = {relation: sign for sign, relation in COMPARE.items()}
# How strongly the outermost operator of a text binds.
_OR, _AND, _NOT, _COMPARISON, _SUM, _PRODUCT, _POWER, _ATOM = range(8)


def write_text(expression: sp.Basic) -> str:
    """Write an expression so that `read_text` gives it back."""
    return _write(expression, _OR)


def _write(node: sp.Basic, level: int) -> str:
    """Write a node, in parentheses when it binds more weakly than ``level``."""
    text, own = _text(node)
    return text if own >= level else f"({text})"


def _text(node: sp.Basic) -> tuple[str, int]:
    """Return the text of a node and the level of its outermost operator."""
    if isinstance(node, sp.Symbol):
        return str(node), _ATOM
    if isinstance(node, sp.Number):
        return _number_text(node)
    if node in (sp.pi, sp.E):
        return ("pi" if node == sp.pi else "exp(1)"), _ATOM
    if isinstance(node, sp.Add):
        return _add_text(node), _SUM
    if isinstance(node, sp.Mul):
        return _mul_text(node)
    if isinstance(node, sp.Pow):
        return _pow_text(node)
    if isinstance(node, sp.Piecewise):
        cases = [f"({_write(e, _OR)}, {_write(c, _OR)})" for e, c in node.args]
        return f"piecewise({', '.join(cases)})", _ATOM
    if isinstance(node, CONDITIONS):
        return _condition_text(node)
    function = BY_CLASS.get(node.func)
    if function is None:
        raise PlantError(
            f"the function {node.func.__name__} in {node} has no text form",
            function=node.func.__name__,
        )
    arguments = list(node.args)
    if isinstance(node, sp.Max | sp.Min):
        arguments.sort(key=sp.default_sort_key)
    if isinstance(node, sp.Heaviside) and arguments[1] == sp.Rational(1, 2):
        arguments.pop()
    return f"{function.name}({', '.join(_write(a, _OR) for a in arguments)})", _ATOM


def _number_text(node: sp.Number) -> tuple[str, int]:
    if isinstance(node, sp.Float):
        text = repr(float(node))
        if sp.Float(float(node)) != node or not text.lstrip("-")[0].isdigit():
            raise PlantError(f"the number {node} is not a double", number=node)
        return text, _SUM if text.startswith("-") else _ATOM
    if not isinstance(node, sp.Rational) or not node.is_finite:
        raise PlantError(f"{node} is not a finite real number", number=node)
    if node < 0:
        return str(node), _SUM
    return str(node), _ATOM if isinstance(node, sp.Integer) else _PRODUCT


def _add_text(node: sp.Add) -> str:
    text = ""
    for term in node.as_ordered_terms():
        part = _text(term)[0]
        if not text:
            text = part
        elif part.startswith("-"):
            text += f" - {part[1:]}"
        else:
            text += f" + {part}"
    return text


def _mul_text(node: sp.Mul) -> tuple[str, int]:
    top, bottom = [], []
    negative = False
    for factor in sorted(node.args, key=sp.default_sort_key):
        if isinstance(factor, sp.Number):
            negative = bool(factor < 0)
            size = abs(factor)
            if not isinstance(size, sp.Rational):
                top.append(_write(size, _POWER))
                continue
            if size.p != 1:
                top.append(str(size.p))
            if size.q != 1:
                bottom.append(str(size.q))
        elif isinstance(factor, sp.Pow) and factor.exp.is_Rational and factor.exp < 0:
            bottom.append(_write(1 / factor, _POWER))
        else:
            top.append(_write(factor, _POWER))
    text = "*".join(top or ["1"]) + "".join(f"/{divisor}" for divisor in bottom)
    return (f"-{text}", _SUM) if negative else (text, _PRODUCT)


def _pow_text(node: sp.Pow) -> tuple[str, int]:
    if node.exp == sp.Rational(1, 2):
        return f"sqrt({_write(node.base, _OR)})", _ATOM
    if node.exp.is_Rational and node.exp < 0:
        return f"1/{_write(1 / node, _POWER)}", _PRODUCT
    return f"{_write(node.base, _ATOM)}**{_write(node.exp, _ATOM)}", _POWER


def _condition_text(node: sp.Basic) -> tuple[str, int]:
    if isinstance(node, BooleanTrue | BooleanFalse):
        return str(node), _ATOM
    if isinstance(node, Relational):
        left, right = _write(node.lhs, _SUM), _write(node.rhs, _SUM)
        return f"{left} {_SIGNS[node.func]} {right}", _COMPARISON
    arguments = sorted(node.args, key=sp.default_sort_key)
    if isinstance(node, Not):
        return f"not {_write(arguments[0], _COMPARISON)}", _NOT
    if isinstance(node, And):
        return " and ".join(_write(a, _NOT) for a in arguments), _AND
    if isinstance(node, Or):
        return " or ".join(_write(a, _AND) for a in arguments), _OR
    raise PlantError(f"the condition {node} has no text form")
