"""The arithmetic of one step: its type, what both writers share, and CasADi's virtual machine.

Long kernels are several functions: compilers take more than linear time for one.
"""

import math
import re
import typing
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.errors import CodegenError
from obsynth.designs.core.observer import FURTHER_OUTPUTS, STEP_OUTPUTS
from obsynth.symbolic.arrays import FloatArray

STEP_INPUTS = ("memory", "u", "y", "theta")
"""Inputs of a step, in their order; the last one of scheduled observers only."""

RESULTS = ("next", *STEP_OUTPUTS[1:], *FURTHER_OUTPUTS[-1])
"""Results of a step, in their order; the last ones of detectors only."""

_C99_TEXT = """
    acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh erf exp expm1 fabs floor fmax fmin
    fmod hypot log log1p pow remainder sin sinh sqrt tan tanh
"""
LIBRARY = frozenset(_C99_TEXT.split())
"""What C99 has of CasADi's functions, under the same names."""

EXACT = frozenset({"ceil", "copysign", "fabs", "floor", "fmax", "fmin", "fmod", "remainder"}) | {
    "sqrt"
}
"""What of it IEEE 754 defines to the last bit."""

OPERATIONS = {
    getattr(ca, name): name.removeprefix("OP_").lower()
    for name in sorted(dir(ca))
    if name.startswith("OP_")
}
"""CasADi's names of operations by their numbers."""

_MOVES = frozenset({"input", "output", "const", "assign"})
_LONG = 1500
_PART = 500
_NAME = re.compile(r"\bt\d+\b")
_DEFINED = re.compile(r"const (?P<kind>\w+) (?P<name>t\d+) = ")


@dataclass(frozen=True)
class Kernel:
    """C text of the arithmetic of one step; the last of the functions is ``NAME_kernel``.

    arguments: some of ``memory, u, y, theta, next, xhat, ...``, or ``state, in, out``
    library: what it calls from ``math.h``, sorted
    own: functions beyond those of IEEE 754 that are written out, with their units in the last place
    operations, counts: instructions of the CasADi function, and how often it does what
    """

    backend: str
    functions: str
    arguments: tuple[str, ...]
    library: tuple[str, ...]
    operations: int
    counts: Mapping[str, int]
    own: Mapping[str, float] = field(default_factory=dict)

    @property
    def inexact(self) -> tuple[str, ...]:
        """What of the library IEEE 754 does not define to the last bit: libraries differ there."""
        exact = EXACT | {f"{name}f" for name in EXACT}
        return tuple(name for name in self.library if name not in exact)


def instructions(function: ca.Function) -> dict[str, int]:
    """Return how often CasADi's machine does what in a scalar function."""
    codes = (function.instruction_id(k) for k in range(function.n_instructions()))
    return counted(OPERATIONS[code] for code in codes)


def counted(operations: Iterable[str]) -> dict[str, int]:
    """Return how often each operation occurs, without loads, stores and constants."""
    return dict(sorted(Counter(name for name in operations if name not in _MOVES).items()))


def _not_scalar(step: ca.Function, why: str) -> CodegenError:
    return CodegenError(
        f"the step {step.name()!r} cannot be written as scalar operations, so it holds something (a"
        f" solver, an external function, a look-up) that this backend cannot ship: {why}",
        symbol=step.name(),
    )


def scalar_function(step: ca.Function) -> ca.Function:
    """Return the step as a function of scalar operations with dense inputs and outputs."""
    if not step.is_a("SXFunction"):
        try:
            step = step.expand()
        except RuntimeError as error:
            raise _not_scalar(step, str(error)) from error
    # Solvers and external functions stay calls, even in an expanded function.
    if any(step.instruction_id(i) == ca.OP_CALL for i in range(step.n_instructions())):
        raise _not_scalar(step, "it calls another function")
    ports = [step.sparsity_in(i) for i in range(step.n_in())]
    ports += [step.sparsity_out(i) for i in range(step.n_out())]
    if all(port.is_dense() for port in ports):
        return step
    inputs = [
        ca.SX.sym(name, *step.size_in(i)) for i, name in enumerate(step.name_in()[: step.n_in()])
    ]
    outputs = [ca.densify(out) for out in step.call(inputs, True, False)]
    return ca.Function(step.name(), inputs, outputs)


@dataclass(frozen=True)
class Real:
    """The type that a step computes in: its name in C, its length, what its literals end with."""

    precision: str
    c: str
    bits: int
    suffix: str
    type: type[np.floating[Any]]

    def rounded(self, value: float) -> float:
        """Return the nearest number of the type, which a design counts; refuse infinities."""
        with np.errstate(over="ignore"):
            near = float(self.type(value))
        if math.isinf(near) and not math.isinf(value):
            raise CodegenError(
                f"the step holds the number {value!r}, which {self.precision} precision takes for"
                f" {near!r}: design and generate the observer with precision='double'",
                number=value,
            )
        return near

    def number(self, value: float) -> str:
        """Return the shortest literal of the type that is read back as the same number."""
        if math.isnan(value):
            return "NAN"
        if math.isinf(value):
            return "INFINITY" if value > 0 else "-INFINITY"
        return f"{self.type(value)!s}{self.suffix}"

    def literal(self, value: float, name: str) -> str:
        """Return a constant as an operand of a C type; infinity and NaN of C are float."""
        text = self.number(value)
        if math.isfinite(value):
            return text
        return f"-({name}){text[1:]}" if text[0] == "-" else f"({name}){text}"


DOUBLE = Real("double", "double", 64, "", np.float64)
SINGLE = Real("single", "float", 32, "f", np.float32)
REALS: Mapping[str, Real] = {real.precision: real for real in (DOUBLE, SINGLE)}
"""Types that a step can compute in, by precision."""


def dense(function: ca.Function) -> ca.Function:
    """Return the same function with dense inputs and outputs, as buffers write only nonzeros."""
    sparse = any(function.nnz_in(i) != function.numel_in(i) for i in range(function.n_in()))
    sparse |= any(function.nnz_out(i) != function.numel_out(i) for i in range(function.n_out()))
    if not sparse:
        return function
    args = [ca.MX.sym(f"a{i}", function.size_in(i)) for i in range(function.n_in())]
    results = [ca.densify(r) for r in function.call(args)]
    return ca.Function(function.name(), args, results, function.name_in(), function.name_out())


class Call:
    """A CasADi function behind fixed NumPy buffers: about a microsecond a call.

    Buffers that are given may serve several functions, but not as argument and result of one.
    """

    def __init__(
        self,
        function: ca.Function,
        args: list[FloatArray] | None = None,
        results: list[FloatArray] | None = None,
    ) -> None:
        if args is None:
            args = [np.zeros(function.numel_in(i)) for i in range(function.n_in())]
        if results is None:
            results = [np.zeros(function.numel_out(i)) for i in range(function.n_out())]
        self.args, self.results = args, results
        # CasADi's own stubs describe neither call as its Python layer takes it.
        buffer, self.evaluate = typing.cast(Any, function).buffer()
        for i, argument in enumerate(self.args):
            buffer.set_arg(i, memoryview(typing.cast(Any, argument)))
        for i, result in enumerate(self.results):
            buffer.set_res(i, memoryview(typing.cast(Any, result)))
        # The buffer owns the pointers, so it has to live as long as the arrays.
        self._buffer = buffer


def row_of(sizes: Sequence[int]) -> tuple[FloatArray, list[FloatArray]]:
    """Return one row of numbers for buffers of these sizes, and its parts."""
    row = np.zeros(sum(sizes))
    return row, np.split(row, np.cumsum(sizes)[:-1])


class Machine(Call):
    """A CasADi function of vectors as one of NumPy vectors, ten times as fast."""

    def __init__(self, function: ca.Function) -> None:
        super().__init__(dense(function))

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Return the results as new vectors."""
        for array, value in zip(self.args, arguments, strict=True):
            array[:] = value
        self.evaluate()
        return [result.copy() for result in self.results]


def in_parts(
    loads: Sequence[str], lines: Sequence[str], stores: Sequence[str], prefix: str
) -> tuple[list[str], list[str]]:
    """Return static functions, and the body that calls them, for statements of a kernel.

    Of ``t0, t1, ...`` those of use beyond their part go by way of two arrays, whose places are
    taken again.
    """
    if len(lines) <= _LONG:
        return [], [*loads, *lines, "", *stores]
    real = f"{prefix}_real_t"
    parts = [loads, *(lines[i : i + _PART] for i in range(0, len(lines), _PART)), stores]
    born: dict[str, int] = {}
    kind: dict[str, str] = {}
    read: list[dict[str, None]] = []
    for k, part in enumerate(parts):
        for found in filter(None, map(_DEFINED.match, part)):
            born[found["name"]], kind[found["name"]] = k, found["kind"]
        read.append(dict.fromkeys(name for line in part for name in _NAME.findall(line)))
    last = {name: k for k, names in enumerate(read) for name in names}
    free: dict[str, list[int]] = {real: [], "_Bool": []}
    size = {real: 0, "_Bool": 0}
    place: dict[str, str] = {}
    texts: list[list[str]] = []
    for k, part in enumerate(parts):
        before = [name for name in read[k] if born[name] < k]
        # loads and stores stand in one function
        needed = [name for name in before if born[name] or k < len(parts) - 1]
        taken = [f"const {kind[name]} {name} = {place[name]};" for name in needed]
        for name in before:
            if last[name] == k:
                free[kind[name]].append(int(place[name].split("[")[1][:-1]))
        kept = []
        for name in read[k]:
            if born[name] == k < last[name]:
                of = kind[name]
                if not free[of]:
                    free[of].append(size[of])
                    size[of] += 1
                place[name] = f"{'w' if of == real else 'b'}[{free[of].pop()}]"
                kept.append(f"{place[name]} = {name};")
        texts.append([*taken, *part, *kept])
    arrays = f"{real} w[{max(size[real], 1)}]", f"_Bool b[{max(size['_Bool'], 1)}]"
    functions, calls = [], []
    for k, text in enumerate(texts[1:-1]):
        unused = [f"(void){a};" for a in "wb" if not any(f"{a}[" in line for line in text)]
        body = "\n".join(f"    {line}" for line in [*unused, *text])
        head = f"static void {prefix}_part_{k}({', '.join(arrays)})"
        functions.append(f"{head}\n{{\n{body}\n}}")
        calls.append(f"{prefix}_part_{k}(w, b);")
    return functions, [*(f"{array};" for array in arrays), "", *texts[0], *calls, *texts[-1]]
