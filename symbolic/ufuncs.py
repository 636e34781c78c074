"""What Python and NumPy make of expressions: ``np.sqrt(h)`` is ``sp.sqrt(h)``, or what to write."""

import operator
from collections.abc import Callable
from functools import cache, partialmethod, wraps
from typing import Any

import numpy as np
import sympy as sp
from sympy.core.relational import Relational

from obsynth.symbolic.functions import ALIASES, BY_NAME

_OTHERS = {"maximum": "Max", "minimum": "Min", "fmax": "Max", "fmin": "Min", "absolute": "Abs"}
_METHODS = ("sqrt", "exp", "log", "sin", "cos", "tan", "arcsin", "arccos", "arctan", "tanh")
_RELATIONS: dict[str, Callable[[Any, Any], Any]] = {
    "less": operator.lt,
    "less_equal": operator.le,
    "greater": operator.gt,
    "greater_equal": operator.ge,
}


def _apply(_: sp.Expr, ufunc: np.ufunc, method: str, *inputs: Any, **keywords: Any) -> Any:
    """Return what a function of NumPy is of expressions; of arrays of them, what NumPy makes."""
    name = ufunc.__name__.replace("arc", "a")
    known = BY_NAME.get(ALIASES.get(name, _OTHERS.get(name, name)))
    if method == "__call__" and not keywords and all(np.ndim(value) == 0 for value in inputs):
        plain = [v.item() if isinstance(v, np.generic | np.ndarray) else v for v in inputs]
        if known is not None:
            return known.sympy(*plain)
        if name in _RELATIONS:
            return _RELATIONS[name](*plain)
    objects = [np.asarray(v, dtype=object) if isinstance(v, sp.Expr) else v for v in inputs]
    try:
        return getattr(ufunc, method)(*objects, **keywords)
    except (TypeError, AttributeError) as error:
        shown = next(value for value in inputs if isinstance(value, sp.Expr))
        raise TypeError(
            f"numpy.{ufunc.__name__} has no form for the expression {shown}: write it in SymPy's "
            f"functions; plants take {', '.join(sorted(BY_NAME))}, Piecewise ({error})"
        ) from error


class Refused(TypeError):
    """What SymPy refuses, with its mend; SymPy itself catches many, so the words come when read."""

    def __str__(self) -> str:
        error, expression, mend = self.args
        return mend.format(expression) if expression.free_symbols else str(error)


_NUMBER = (
    "{0} is an expression and no number, which math.sqrt, float and their like take: write NumPy's "
    "function (np.sqrt) or SymPy's (sp.sqrt); obsynth.lookup in place of np.interp"
)
_CHOICE = (
    "{0} is neither true nor false while equations are written, so that if, and, min and np.where "
    "cannot choose: write both cases, sp.Piecewise((a, {0}), (b, True)), or sp.Min, sp.Max, "
    "obsynth.sat"
)


def _told(method: Callable[[Any], Any], mend: str) -> Callable[[Any], Any]:
    """Return a method of SymPy that says what to write where it refuses."""

    @wraps(method)
    def call(self: Any) -> Any:
        try:
            return method(self)
        except TypeError as error:
            raise Refused(error, self, mend) from None

    return call


@cache
def allow() -> None:
    """Let expressions answer NumPy, and tell the mend where they are no numbers or conditions."""
    sp.Expr.__array_ufunc__ = _apply
    for name in _METHODS:
        # what NumPy calls on every entry of a list; `exp` of a power is SymPy's exponent and stays
        setattr(sp.Expr, name, partialmethod(getattr(np, name)))
    for kind, method, mend in (
        (sp.Expr, "__float__", _NUMBER),
        (sp.Expr, "__int__", _NUMBER),
        (Relational, "__bool__", _CHOICE),
    ):
        setattr(kind, method, _told(getattr(kind, method), mend))
