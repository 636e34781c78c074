"""The instructions of a step in IEEE single precision: what generated C of type float computes."""

import math
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.errors import CodegenError
from obsynth.codegen.functions import ULPS, own_function
from obsynth.codegen.kernel import (
    DOUBLE,
    EXACT,
    LIBRARY,
    OPERATIONS,
    SINGLE,
    Machine,
    Real,
    scalar_function,
)

# Python's text of operations; a test chooses between two, `choose` stands for how
_PLAIN: Mapping[str, str] = {
    "assign": "{0}",
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "fabs": "abs({0})",
    "sq": "{0} * {0}",
    "twice": "{0} + {0}",
    "inv": "one / {0}",
    **{name: f"{name}({{0}})" for name in ("sqrt", "floor", "ceil")},
    **{name: f"{name}({{0}}, {{1}})" for name in ("fmod", "copysign", "remainder")},
}
_CHOSEN: Mapping[str, tuple[str, str, str]] = {
    "lt": ("{0} < {1}", "one", "zero"),
    "le": ("{0} <= {1}", "one", "zero"),
    "eq": ("{0} == {1}", "one", "zero"),
    "ne": ("{0} != {1}", "one", "zero"),
    "and": ("({0} != zero) & ({1} != zero)", "one", "zero"),
    "or": ("({0} != zero) | ({1} != zero)", "one", "zero"),
    "not": ("{0} == zero", "one", "zero"),
    "if_else_zero": ("{0} != zero", "{1}", "zero"),
    "fmax": ("({0} < {1}) | ({0} != {0})", "{1}", "{0}"),
    "fmin": ("({1} < {0}) | ({0} != {0})", "{1}", "{0}"),
    "sign": ("({0} < zero) | ({0} > zero)", "copysign(one, {0})", "{0}"),
}


@np.vectorize
def _remainder(a: float, b: float) -> float:
    return math.remainder(a, b) if math.isfinite(a) and b and b == b else math.nan


_NAMES: Mapping[str, Any] = {
    "one": np.float32(1.0),
    "zero": np.float32(0.0),
    "remainder": lambda a, b: np.float32(_remainder(a, b)),
    **{name: getattr(np, name) for name in ("sqrt", "floor", "ceil", "fmod", "copysign", "where")},
}


class SingleMachine:
    """A CasADi function of vectors (n,) or (n, lanes) in IEEE single precision, as float32."""

    def __init__(self, function: ca.Function) -> None:
        tape = scalar_function(function)
        self._lengths = [tape.numel_out(i) for i in range(tape.n_out())]
        self._names = dict(_NAMES)
        # Python evaluates a text of its own several times as fast as it walks through a list
        self._texts = [self._text(tape, how) for how in ("({1} if {0} else {2})", "where({})")]
        self._runs: dict[int, Callable[..., None]] = {}

    def _text(self, tape: ca.Function, how: str) -> str:
        lines = ["def run(given, results):"]
        for k in range(tape.n_instructions()):
            name = OPERATIONS[tape.instruction_id(k)]
            out, args = tape.instruction_output(k), tape.instruction_input(k)
            if name == "const":
                self._names[f"c{k}"] = np.float32(SINGLE.rounded(tape.instruction_constant(k)))
                text = f"c{k}"
            elif name == "input":
                text = f"given[{args[0]}][{args[1]}]"
            elif name == "output":
                lines.append(f" results[{out[0]}][{out[1]}] = w{args[0]}")
                continue
            else:
                text = self._operation(name, [f"w{a}" for a in args], how)
            lines.append(f" w{out[0]} = {text}")
        return "\n".join([*lines, " return None"])

    def _operation(self, name: str, args: list[str], how: str) -> str:
        if name in _PLAIN:
            return _PLAIN[name].format(*args)
        if name in _CHOSEN:
            test, *values = (part.format(*args) for part in _CHOSEN[name])
            if "{1}" in how:
                return how.format(test.replace("|", "or").replace("&", "and"), *values)
            return how.format(", ".join((test, *values)))
        name = "pow" if name == "constpow" else name
        if name not in ULPS:
            raise CodegenError(f"no form of {name!r} in single precision", symbol=name)
        self._names.setdefault(name, _called(SingleMachine(own_function(name))))
        return f"{name}({', '.join(args)})"

    def __call__(self, *arguments: Any) -> list[Any]:
        """Return the results as new vectors."""
        given = [np.asarray(argument).astype(np.float32) for argument in arguments]
        lanes = max((argument.shape[1:] for argument in given), default=())
        kind = len(lanes)
        if kind not in self._runs:
            found = dict(self._names)
            exec(self._texts[kind], found)
            self._runs[kind] = found["run"]
        results = [np.zeros((length, *lanes), np.float32) for length in self._lengths]
        with np.errstate(all="ignore"):
            self._runs[kind]([list(argument) for argument in given], results)
        return results


def _called(machine: SingleMachine) -> Callable[..., Any]:
    def run(*arguments: Any) -> Any:
        return machine(*(np.asarray(a)[None] for a in np.broadcast_arrays(*arguments)))[0][0]

    return run


def machine_of(function: ca.Function, real: Real) -> Callable[..., list[Any]]:
    """Return what evaluates a function of vectors in a type."""
    return Machine(function) if real is DOUBLE else SingleMachine(function)


def lane_operations(real: Real) -> dict[str, Callable[..., Any]]:
    """Return operations on arrays by CasADi's names, those of the library or our own among them."""
    names: dict[str, Any] = dict(_NAMES)
    if real is DOUBLE:
        beyond = {name: _each(getattr(math, name)) for name in LIBRARY - EXACT}
        beyond["constpow"] = beyond["pow"]
        names["remainder"] = _remainder
    else:
        beyond = {name: _called(SingleMachine(own_function(name))) for name in ULPS}
    texts = {**_PLAIN, **{name: f"where({', '.join(parts)})" for name, parts in _CHOSEN.items()}}
    for name, text in texts.items():
        beyond[name] = eval(f"lambda a, b=None: {text.format('a', 'b')}", names)
    return beyond


def _each(function: Callable[..., Any]) -> Callable[..., Any]:
    def run(*arguments: float) -> float:
        try:
            return float(function(*arguments))
        except OverflowError:
            return math.inf
        except ValueError:
            return math.nan

    return np.vectorize(run, otypes=[float])
