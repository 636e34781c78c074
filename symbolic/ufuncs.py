"""NumPy's functions of expressions: ``np.sqrt(h)`` is ``sp.sqrt(h)``, or says what to write."""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import sympy as sp

from obsynth.symbolic.functions import ALIASES, BY_NAME

_OTHERS = {"maximum": "Max", "minimum": "Min", "fmax": "Max", "fmin": "Min", "absolute": "Abs"}
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


def allow() -> None:
    """Let expressions answer NumPy, which else looks for methods that they do not have."""
    sp.Expr.__array_ufunc__ = _apply
