"""Front doors say what they take: arguments of another kind are refused by name."""

from collections.abc import Callable, Iterable, Sequence
from functools import wraps
from inspect import signature
from typing import Any, ParamSpec, TypeVar

import sympy as sp
from sympy.core.sympify import converter

from obsynth.symbolic.errors import ObsynthError

P = ParamSpec("P")
T = TypeVar("T")

_MADE = {
    "Plant": "made by ob.Plant(name) or ob.read_plant(path)",
    "Split": "what ob.split returns",
    "Observer": "what a method's design(plant) returns",
    "FaultDetector": "made by ob.FaultDetector(observer)",
    "Scenario": "made by ob.Scenario(...), or one of ob.scenarios",
    "Record": "what ob.read_record returns",
    "Run": "what ob.simulate returns",
    "Estimate": "what ob.estimate returns",
    "Path": "the name of a file",
    "dict": "by label",
}
_BUILTIN = {"list", "tuple", "str", "int", "float", "ndarray", "Series", "DataFrame", "Dataset"}
_OTHERS = {*_MADE, "Method", "Shown", "NoneType", *_BUILTIN}
_SHOWN = {"dict": "mapping"}


def takes(**kinds: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Refuse arguments of another kind than the classes named, separated by spaces.

    Classes are told by their names, so that nothing has to be loaded for it. What quacks like one
    of them passes: a plant in place of a run is meant, or a list in place of a mapping.
    """

    def decorated(function: Callable[P, T]) -> Callable[P, T]:
        parameters = signature(function).parameters

        @wraps(function)
        def call(*args: P.args, **keywords: P.kwargs) -> T:
            given: dict[str, Any] = {**dict(zip(parameters, args, strict=False)), **keywords}
            for name, known in kinds.items():
                if given.get(name, parameters[name].default) is not parameters[name].default:
                    check_kind(function.__name__, name, known, given[name])
            return function(*args, **keywords)

        return call

    return decorated


def check_kind(where: str, name: str, known: str, value: Any) -> None:
    """Refuse an argument of another kind than the classes named; a stranger's class passes."""
    own = {kind.__name__ for kind in type(value).__mro__}
    if own & set(known.split()) or not own & _OTHERS:
        return
    shown = [kind for kind in known.split() if kind in _MADE]
    wanted = " or ".join(f"{_an(_SHOWN.get(kind, kind))} ({_MADE[kind]})" for kind in shown)
    kind = "None" if value is None else _an(type(value).__name__)
    if isinstance(value, list | tuple) and value:
        kind += f" of {type(value[0]).__name__}"
    raise ObsynthError(f"{where} takes {name} as {wanted}; it was given {kind}", argument=name)


def labelled(name: str, value: Any, wanted: Sequence[str] = ("...",)) -> str | None:
    """Return what to give in place of a frame or series whose labels name signals, in any order."""
    if not hasattr(value, "iloc"):
        return None
    for labels, pick in ((getattr(value, "columns", ()), ""), (value.index, ".loc")):
        if any(isinstance(label, str) for label in labels):
            pick = pick * hasattr(value, "columns")
            return (
                f"{name} is a {type(value).__name__} with the labels {list(labels)}, which are not "
                f"read: give {name}{pick}[{list(wanted)}].to_numpy(), in the order of the plant"
            )
    return None


def _an(kind: str) -> str:
    return f"{'an' if kind[0] in 'AEIOUaeiou' else 'a'} {kind}"


class Together(ObsynthError, AttributeError):
    """A tuple of symbols where an expression is needed; SymPy asks it for what expressions have."""

    def __init__(self, symbols: Iterable[Any], where: str = "") -> None:
        names = ", ".join(map(str, symbols))
        left = names if "," in names else f"({names},)"
        super().__init__(
            f"{where and where + ': '}a tuple of symbols ({names}) stands in an expression: take it"
            f" apart where it is declared, {left} = plant...(...), or name its entries by index"
        )


class SymbolTuple(sp.Tuple):  # type: ignore[misc]
    """What SymPy makes of `Symbols`: a tuple that says so where it should be an expression."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        raise Together(self)


class Symbols(tuple[Any, ...]):
    """The symbols of a declaration, to be taken apart: ``(h,) = plant.states("h")``."""

    __slots__ = ()

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise Together(self)

    __neg__ = __pos__ = __abs__ = __sub__ = __rsub__ = __truediv__ = __rtruediv__ = _refuse
    __pow__ = __rpow__ = __mul__ = __rmul__ = __array_ufunc__ = _refuse

    def __add__(self, other: Any) -> Any:
        """Return both together; a sum is none."""
        return tuple(self) + tuple(other) if isinstance(other, tuple) else self._refuse()

    def __radd__(self, other: Any) -> Any:
        """Return a sum, which is none; a list may be extended."""
        return NotImplemented if isinstance(other, list) else self._refuse()


converter[Symbols] = lambda symbols: SymbolTuple(*symbols)
