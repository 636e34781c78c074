"""The arithmetic of one step: as C without CasADi's interface, and on CasADi's virtual machine."""

import math
import re
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.errors import CodegenError
from obsynth.designs.core.observer import FURTHER_OUTPUTS, STEP_OUTPUTS
from obsynth.symbolic.arrays import FloatArray

STEP_INPUTS = ("memory", "u", "y", "theta")
"""Inputs of a step, in their order; the last one of scheduled observers only."""

_RESULTS = ("next", *STEP_OUTPUTS[1:], *FURTHER_OUTPUTS[-1])

# CasADi wraps these to serve C89 as well; the wrapped C99 function is what its VM calls.
_WRAPPED = frozenset({"expm1", "fabs", "fmax", "fmin", "hypot", "log1p"})

_C99_TEXT = """
    acos acosh asin asinh atan atan2 atanh ceil copysign cos cosh erf exp floor fmod log pow
    remainder sin sinh sqrt tan tanh
"""
_C99 = _WRAPPED | frozenset(_C99_TEXT.split())

_EXACT = frozenset({"ceil", "copysign", "fabs", "floor", "fmax", "fmin", "fmod", "remainder"}) | {
    "sqrt"
}

_FUNCTION = re.compile(
    r"^static int casadi_f0\([^)]*\) \{\n(?P<body>.*?)^\}\n", re.MULTILINE | re.DOTALL
)
_HELPER = re.compile(r"^casadi_real casadi_(\w+)\(([^)]*)\) (\{[^\n]*\})$", re.MULTILINE)
_READ = re.compile(r"arg\[(\d+)\]\? arg\[\1\]\[(\d+)\] : 0")
_WRITE = re.compile(r"if \(res\[(\d+)\]!=0\) res\[\1\]\[(\d+)\]=")
_LITERAL = re.compile(r"(?<![\w.])\d+\.\d*e[+-]\d+")
_WORD = re.compile(r"(?<![\d.])[A-Za-z_]\w*")  # "e+300" of a literal is no word


@dataclass(frozen=True)
class Kernel:
    """C text of the arithmetic of one step.

    functions: static functions; the last one is ``NAME_kernel``
    arguments: its arguments: those of ``memory, u, y, theta, next, xhat, ...`` that it reads or
        writes
    library: what it calls from ``math.h``, sorted
    inexact: those of them that IEEE 754 does not define to the last bit, so that another machine's
        mathematics library may return another last bit
    operations: instructions of the CasADi function, a measure of its length
    """

    functions: str
    arguments: tuple[str, ...]
    library: tuple[str, ...]
    inexact: tuple[str, ...]
    operations: int


def _not_scalar(step: ca.Function, why: str) -> CodegenError:
    return CodegenError(
        f"the step {step.name()!r} cannot be written as scalar operations, so it holds something (a"
        f" solver, an external function, a look-up) that this backend cannot ship: {why}",
        symbol=step.name(),
    )


def _scalar_function(step: ca.Function) -> ca.Function:
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


def _casadi_text(function: ca.Function) -> str:
    generator = ca.CodeGenerator("kernel", {"with_header": False})
    generator.add(function, False)
    return str(generator.dump())


def _surprise(what: str) -> CodegenError:
    version = ca.CasadiMeta.version()
    return CodegenError(
        f"{what}; this obsynth cannot use the C that CasADi {version} writes for this step",
        casadi=version,
    )


def _shortest(literal: re.Match[str]) -> str:
    return c_number(float(literal[0]))


def generate_kernel(step: ca.Function, prefix: str) -> Kernel:
    """Write the arithmetic of a step as static C functions.

    CasADi's C passes arrays of pointers, work vectors and a memory index, exports some
    fifteen symbols and brings its own types. What is kept of it is the sequence of
    operations, statement by statement, with the arguments as plain arrays.
    """
    function = _scalar_function(step)
    text = _casadi_text(function)
    found = _FUNCTION.findall(text)
    if len(found) != 1:
        raise _surprise(f"{len(found)} functions found in CasADi's C where one was expected")
    body = found[0]

    body = _READ.sub(lambda m: f"{STEP_INPUTS[int(m[1])]}[{m[2]}]", body)
    body = _WRITE.sub(lambda m: f"{_RESULTS[int(m[1])]}[{m[2]}]=", body)
    body = _LITERAL.sub(_shortest, body)
    lines = body.rstrip().splitlines()
    if lines[-1].strip() != "return 0;":
        raise _surprise(f"CasADi's function ends on {lines[-1].strip()!r}")
    body = "\n".join(f"  {line}" for line in lines[:-1])

    helpers = {name: (arguments, code) for name, arguments, code in _HELPER.findall(text)}
    used: list[str] = []

    def rename(match: re.Match[str]) -> str:
        word = match[1]
        if word == "real":
            return f"{prefix}_real_t"
        if word in {"inf", "nan"}:
            return {"inf": "INFINITY", "nan": "NAN"}[word]
        if word in _WRAPPED:
            return word
        if word not in helpers:
            raise _surprise(f"CasADi's C uses casadi_{word}, which is not known")
        if word not in used:
            used.append(word)
        return f"{prefix}_{word}"

    body = re.sub(r"\bcasadi_(\w+)", rename, body)
    library = _check_words(body, prefix, used)
    parts = [
        re.sub(r"\bcasadi_(\w+)", rename, f"static casadi_real casadi_{name}({arguments}) {code}")
        for name in used
        for arguments, code in [helpers[name]]
    ]
    enclosed, arguments = _enclose(function, prefix, body)
    parts.append(enclosed)
    return Kernel(
        functions="\n\n".join(parts),
        arguments=arguments,
        library=library,
        inexact=tuple(name for name in library if name not in _EXACT),
        operations=int(function.n_instructions()),
    )


def _check_words(body: str, prefix: str, helpers: list[str]) -> tuple[str, ...]:
    """Return the library functions of the body; refuse every word whose meaning is not known."""
    known = {*STEP_INPUTS, *_RESULTS, "INFINITY", "NAN", f"{prefix}_real_t"}
    known |= {f"{prefix}_{helper}" for helper in helpers}
    library = set()
    for word in set(_WORD.findall(body)):
        if word in _C99:
            library.add(word)
        elif word == "erfinv":
            raise CodegenError(
                "the step calls erfinv, which the mathematics library of C99 does not have",
                symbol="erfinv",
            )
        elif word not in known and not re.fullmatch(r"a\d+", word):
            raise _surprise(f"CasADi's C holds {word!r}, which is not known")
    return tuple(sorted(library))


def _enclose(function: ca.Function, prefix: str, body: str) -> tuple[str, tuple[str, ...]]:
    """Put the body into a function of plain arrays, without unused parameters."""
    real = f"{prefix}_real_t"
    words = set(_WORD.findall(body))
    arguments, parameters = [], []
    for i, name in enumerate(STEP_INPUTS[: function.n_in()]):
        if name in words:
            arguments.append(name)
            parameters.append(f"const {real} {name}[{function.numel_in(i)}]")
    for i, name in enumerate(_RESULTS[: function.n_out()]):
        if name in words:
            arguments.append(name)
            parameters.append(f"{real} {name}[{function.numel_out(i)}]")
    head = ",\n    ".join(parameters)
    return f"static void {prefix}_kernel(\n    {head})\n{{\n{body}\n}}", tuple(arguments)


def c_number(value: float) -> str:
    """Return the shortest C literal of type double that is read back as the same number."""
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "-INFINITY"
    return repr(float(value))


class Machine:
    """A CasADi function of vectors as one of NumPy vectors, through buffers: ten times as fast.

    function: inputs and outputs are vectors; structural zeros become zeros
    """

    def __init__(self, function: ca.Function) -> None:
        # The function itself is kept as one call, so that nothing is simplified anew.
        ports = [ca.MX.sym(f"i{i}", function.numel_in(i)) for i in range(function.n_in())]
        outputs = [ca.densify(out) for out in function.call(ports, False, True)]
        dense = ca.Function("dense", ports, outputs)
        buffer: Any
        buffer, self._run = dense.buffer()
        self._arguments = [np.zeros(dense.numel_in(i)) for i in range(dense.n_in())]
        self._results = [np.zeros(dense.numel_out(i)) for i in range(dense.n_out())]
        for i, array in enumerate(self._arguments):
            buffer.set_arg(i, array.data)
        for i, array in enumerate(self._results):
            buffer.set_res(i, array.data)
        # The buffer holds the addresses of the arrays for as long as it is called.
        self._buffer = buffer

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Return the results as new vectors."""
        for array, value in zip(self._arguments, arguments, strict=True):
            array[:] = value
        self._run()
        return [result.copy() for result in self._results]
