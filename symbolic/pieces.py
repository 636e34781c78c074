"""Tables of values and saturations, written in functions whose bounds and slopes are known."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import sympy as sp

from obsynth.symbolic.errors import PlantError


def sat(x: Any, lower: Any, upper: Any) -> sp.Expr:
    """Return x held between two limits.

    Parameters
    ----------
    x, lower, upper : expression or number
        ``lower`` is no more than ``upper``.

    Returns
    -------
    sympy.Expr
        In the unit of x.

    Raises
    ------
    PlantError
        Limits that are numbers in the wrong order.

    Examples
    --------
    >>> sat(sp.Symbol("v", real=True), 0, 10)
    Min(10, Max(0, v))
    """
    ends = [sp.sympify(end) for end in (lower, upper)]
    if all(end.is_number for end in ends) and not ends[0] <= ends[1]:
        raise PlantError(f"sat({x}, {lower}, {upper}): give the lower limit first")
    return sp.Min(sp.Max(sp.sympify(x), ends[0]), ends[1])


def lookup(x: Any, knots: Sequence[Any], values: Sequence[Any]) -> sp.Expr:
    """Return a table of values as a piecewise linear function, constant beyond its ends.

    Parameters
    ----------
    x : expression
    knots : sequence of float, shape (N,)
        Where the table has values, increasing, in the unit of x.
    values : sequence of float, shape (N,)
        Text and rationals are exact; the slopes are exact quotients of what is given.

    Returns
    -------
    sympy.Expr
        A ``Piecewise``; bounds of its values and slopes are those of its pieces.

    Raises
    ------
    PlantError
        Fewer than two knots, other numbers of values, knots that do not increase.

    Examples
    --------
    >>> lookup(sp.Symbol("v", real=True), [0, 1, 3], [0, 2, 3])
    Piecewise((0, v <= 0), (2*v, v <= 1), (v/2 + 3/2, v <= 3), (3, True))
    """
    if len(knots) != len(values) or len(knots) < 2:
        raise PlantError(
            f"lookup of {x}: {len(knots)} knots and {len(values)} values; give as many of both, "
            "two at least"
        )
    x = sp.sympify(x)
    at, of = ([_exact(item, f"lookup of {x}") for item in items] for items in (knots, values))
    for before, after in pairwise(at):
        if not before < after:
            raise PlantError(f"lookup of {x}: the knots {before}, {after} do not increase")
    pieces: list[Any] = [(of[0], sp.Le(x, at[0]))]
    for (a, low), (b, high) in pairwise(zip(at, of, strict=True)):
        slope = (high - low) / (b - a)
        pieces.append((sp.expand(low - slope * a) + slope * x, sp.Le(x, b)))
    return sp.Piecewise(*pieces, (of[-1], True))


def _exact(item: Any, what: str) -> sp.Rational:
    """Return a number without rounding: a double is the decimal that it prints as."""
    try:
        return sp.Rational(str(float(item) if isinstance(item, sp.Float) else item))
    except (TypeError, ValueError) as error:
        raise PlantError(f"{what}: {item!r} is no finite number") from error


def _lookup_of_text(x: Any, *table: Any) -> sp.Expr:
    """Return the table of ``lookup(x, [knots], [values])`` or ``lookup(x, knot, value, ...)``."""
    lists = [isinstance(part, tuple) for part in table]
    if any(lists) and lists != [True, True]:
        raise PlantError(f"lookup of {x}: write lookup(x, [knot, knot, ...], [value, value, ...])")
    return lookup(x, *(table if any(lists) else (table[::2], table[1::2])))


Made = tuple[Callable[..., sp.Expr], int, int | None]
"""What makes an expression of a function's arguments, and how many it takes; None: any number."""
COMPOSED: dict[str, Made] = {"sat": (sat, 3, 3), "lookup": (_lookup_of_text, 3, None)}
"""By the name in text."""
