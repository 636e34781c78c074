"""How long expressions are, asked before anything is done that takes as long as they are.

SymPy expands and simplifies for hours where nobody stops it. Lengths do, and no clock does: what is
derived is the same on every machine. A length is found without walking through a part twice, since
a Runge-Kutta step has few different parts and many millions of them when it is written out.
"""

from math import comb
from typing import Any

import sympy as sp

from obsynth.derive.rigour.walks import once, replaced
from obsynth.symbolic.display import short

LARGEST_SIMPLIFY = 300
"""Parts of an expression up to which `sympy.simplify` is asked; its longest proof had 280."""
LARGEST_ROW = 10_000
"""Parts of an expression up to which it is differentiated and rewritten as a whole."""
LARGEST_SUM = 20_000
"""Terms up to which products are multiplied out."""
_ENDLESS = 10**12
_LONGEST = 300


def size(expression: Any) -> int:
    """Count the parts of an expression written out."""
    known: dict[sp.Basic, int] = {}
    for node in once(expression):
        known[node] = min(_ENDLESS, 1 + sum(known[part] for part in node.args))
    return known[expression]


def symbols(expression: sp.Expr) -> set[sp.Basic]:
    """Collect the symbols of an expression, however long it is."""
    return {node for node in once(expression) if isinstance(node, sp.Symbol)}


def is_short(expression: sp.Expr) -> bool:
    """Tell whether an expression may be expanded and differentiated."""
    return size(expression) <= LARGEST_ROW and expanded_terms(expression) <= LARGEST_SUM


def expanded_terms(expression: sp.Expr) -> int:
    """Estimate, rather too high, into how many terms an expression expands, or a part of it."""
    count: dict[sp.Basic, int] = {}
    degree: dict[sp.Basic, int] = {}
    factors: dict[sp.Basic, frozenset[sp.Basic]] = {}
    largest = 1
    for node in once(expression):
        parts = node.args
        count[node], degree[node] = 1, 0 if node.is_number else 1
        factors[node] = frozenset() if node.is_number else frozenset([node])
        power = node.exp if isinstance(node, sp.Pow) else None
        if isinstance(node, sp.Add | sp.Mul):
            factors[node] = frozenset().union(*(factors[part] for part in parts))
            degrees = [degree[part] for part in parts]
            degree[node] = max(degrees) if isinstance(node, sp.Add) else sum(degrees)
            total = 0 if isinstance(node, sp.Add) else 1
            for part in parts:
                both = total + count[part] if isinstance(node, sp.Add) else total * count[part]
                total = min(_ENDLESS, both)
            count[node] = total
        elif power is not None and power.is_Integer and 1 < power < _ENDLESS:
            base, n = parts[0], int(power)
            factors[node], degree[node] = factors[base], min(_ENDLESS, n * degree[base])
            count[node] = _monomials(n, count[base] - 1)
        # like terms are collected: no more than there are monomials in what is not multiplied out
        count[node] = min(count[node], _monomials(degree[node], len(factors[node])))
        largest = max(largest, count[node])
    return largest


def _monomials(degree: int, variables: int) -> int:
    """Count the monomials up to a degree."""
    small, large = sorted((degree, variables))
    if small > 20 or (small > 1 and large > _ENDLESS):
        return _ENDLESS if small else 1
    return min(_ENDLESS, comb(degree + variables, small))


def expanded(expression: sp.Expr) -> sp.Expr:
    """Expand what does not become too long; leave the rest as it is."""
    return sp.expand(expression) if is_short(expression) else expression


def simplified(expression: sp.Expr) -> sp.Expr:
    """Simplify what is short; leave the rest as it is.

    SymPy tries for seconds to make something of a jump; nothing is to be made of it.
    """
    if size(expression) > LARGEST_SIMPLIFY:
        return expression
    jumps = (sp.sign, sp.Heaviside, sp.floor, sp.ceiling)
    names = {node: sp.Dummy(real=True) for node in once(expression) if isinstance(node, jumps)}
    short = sp.simplify(replaced(expression, names))
    return replaced(short, {name: node for node, name in names.items()})


def text(expression: sp.Expr) -> str:
    """Write what is short, fractions of many digits with six; tell of the rest how long it is."""
    parts = size(expression)
    if parts > _LONGEST:
        return f"(an expression of {parts:,} parts)"
    return str(sp.sstr(short(expression), full_prec=False))
