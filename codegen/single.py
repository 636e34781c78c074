"""The instructions of a step in IEEE single precision: what generated C of type float computes."""

import math
import operator
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.errors import CodegenError
from obsynth.codegen.functions import ULPS, own_function
from obsynth.codegen.kernel import DOUBLE, OPERATIONS, SINGLE, Machine, Real, scalar_function

_F = np.float32
_ONE, _ZERO = _F(1.0), _F(0.0)
_Run = Callable[..., Any]


@np.vectorize
def _remainder(a: float, b: float) -> float:
    return math.remainder(a, b) if math.isfinite(a) and b and b == b else math.nan


_PLAIN: Mapping[str, _Run] = {
    "assign": lambda a: a,
    "add": operator.add,
    "sub": operator.sub,
    "mul": operator.mul,
    "div": operator.truediv,
    "neg": operator.neg,
    "fabs": abs,
    "sq": lambda a: a * a,
    "twice": lambda a: a + a,
    "inv": lambda a: _ONE / a,
    "sqrt": np.sqrt,
    "floor": np.floor,
    "ceil": np.ceil,
    "fmod": np.fmod,
    "copysign": np.copysign,
    "remainder": lambda a, b: _F(_remainder(a, b)),
}
_TESTS: Mapping[str, _Run] = {
    "lt": operator.lt,
    "le": operator.le,
    "eq": operator.eq,
    "ne": operator.ne,
    "and": lambda a, b: (a != 0) & (b != 0),
    "or": lambda a, b: (a != 0) | (b != 0),
    "not": lambda a: a == 0,
}


def _one(test: Any, a: Any, b: Any) -> Any:
    return a if test else b


def _told(choose: _Run, test: _Run) -> _Run:
    return lambda *arguments: choose(test(*arguments), _ONE, _ZERO)


def _operations(choose: _Run) -> dict[str, _Run]:
    """Return operations by CasADi's names, of what ``choose`` chooses from."""
    return {
        **_PLAIN,
        **{name: _told(choose, test) for name, test in _TESTS.items()},
        "if_else_zero": lambda c, a: choose(c != 0, a, _ZERO),
        "fmax": lambda a, b: choose((a < b) | (a != a), b, a),
        "fmin": lambda a, b: choose((b < a) | (a != a), b, a),
        "sign": lambda a: choose(a < 0, -_ONE, choose(a > 0, _ONE, a)),
    }


class SingleMachine:
    """A CasADi function of vectors in IEEE single precision, an operation a time.

    Every constant is rounded to the nearest number, every operation is one of NumPy's float32, and
    functions beyond those of IEEE 754 are our own. Arguments of shape (n,), or (n, lanes) to
    evaluate many at once; results are float32.
    """

    def __init__(self, function: ca.Function) -> None:
        tape = scalar_function(function)
        self._lengths = [tape.numel_out(i) for i in range(tape.n_out())]
        self._size = max(tape.sz_w(), 1)
        self._program: list[tuple[str, int, Any, Any]] = []
        for k in range(tape.n_instructions()):
            name = OPERATIONS[tape.instruction_id(k)]
            out, args = tape.instruction_output(k), tape.instruction_input(k)
            if name == "const":
                number = _F(SINGLE.rounded(tape.instruction_constant(k)))
                self._program.append((name, out[0], number, None))
            elif name == "output":
                self._program.append((name, out[0], out[1], args[0]))
            else:
                name = "pow" if name == "constpow" else name
                self._program.append((name, out[0], args[0], args[1] if len(args) > 1 else None))
        self._own = {
            name: SingleMachine(own_function(name))
            for name in {line[0] for line in self._program} & set(ULPS)
        }
        self._tables = [self._table(_one), self._table(np.where)]

    def _table(self, choose: _Run) -> dict[str, _Run]:
        own = {name: _called(machine) for name, machine in self._own.items()}
        table = {**_operations(choose), **own}
        for name, *_ in self._program:
            if name not in {*table, "const", "input", "output"}:
                raise CodegenError(f"no form of {name!r} in single precision", symbol=name)
        return table

    def __call__(self, *arguments: Any) -> list[Any]:
        """Return the results as new vectors."""
        given = [np.asarray(argument).astype(_F) for argument in arguments]
        lanes = max((argument.shape[1:] for argument in given), default=())
        table = self._tables[len(lanes)]
        results = [np.zeros((length, *lanes), _F) for length in self._lengths]
        w: list[Any] = [_ZERO] * self._size
        with np.errstate(all="ignore"):
            for name, out, a, b in self._program:
                if name == "const":
                    w[out] = a
                elif name == "input":
                    w[out] = given[a][b]
                elif name == "output":
                    results[out][a] = w[b]
                elif b is None:
                    w[out] = table[name](w[a])
                else:
                    w[out] = table[name](w[a], w[b])
        return results


def _called(machine: SingleMachine) -> _Run:
    def run(*arguments: Any) -> Any:
        return machine(*(np.asarray(a)[None] for a in np.broadcast_arrays(*arguments)))[0][0]

    return run


def machine_of(function: ca.Function, real: Real) -> Callable[..., list[Any]]:
    """Return what evaluates a function of vectors in a type."""
    return Machine(function) if real is DOUBLE else SingleMachine(function)
