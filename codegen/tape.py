"""The arithmetic of one step as C of our own: the instruction tape, one assignment a value.

What runs is what CasADi's virtual machine runs, to the last bit but for which NaN a NaN is; what is
written otherwise, and why no bit changes, stands in docs/c.md. Beyond some thousand statements
there are several functions, see `kernel`; functions that IEEE 754 does not define are in single
precision our own, see `functions`.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca

from obsynth.codegen.errors import CodegenError
from obsynth.codegen.functions import ULPS, own_function
from obsynth.codegen.kernel import (
    DOUBLE,
    EXACT,
    LIBRARY,
    OPERATIONS,
    RESULTS,
    STEP_INPUTS,
    Kernel,
    Real,
    counted,
    in_parts,
    scalar_function,
)

_COMPARED = {"lt": "<", "le": "<=", "eq": "==", "ne": "!="}
_TRUTH = {*_COMPARED, "and", "or", "not"}
_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/", **_COMPARED, "and": "&&", "or": "||"}
# operands are written more than once
_TWICE = {"fmax", "fmin", "sq", "twice", "sign"}
_CALLED = {name: name for name in LIBRARY - _TWICE} | {"constpow": "pow"}
# -0 in, -0 out, and nothing else depends on the sign of a zero
_ODD = {"neg", "twice", "sqrt", "sign", "floor", "ceil", "fmax", "fmin", "if_else_zero", "mul"}
_BLIND = {*_TRUTH, "fabs", "sq"}
_LONGEST = 60


@dataclass(eq=False)
class _Value:
    """One value of the tape, read by so many others.

    nan, minus: whether it may be none, and whether what is written may be -0
    signed: whether the sign of a zero is seen by anything
    product: whether its expression holds a product
    """

    name: str
    args: tuple["_Value", ...]
    number: float = 0.0
    place: tuple[int, int] = (0, 0)
    nan: bool = True
    minus: bool = True
    uses: int = 0
    signed: bool = False
    text: str = ""
    simple: bool = True
    product: bool = False

    @property
    def truth(self) -> bool:
        return self.name in _TRUTH


class _Reader:
    """The values of a function, equal ones once."""

    def __init__(self, function: ca.Function, real: Real) -> None:
        self.real = real
        self.values: dict[tuple[object, ...], _Value] = {}
        self.results: list[tuple[int, int, _Value]] = []
        work: dict[int, _Value] = {}
        for k in range(function.n_instructions()):
            code = function.instruction_id(k)
            out, args = function.instruction_output(k), function.instruction_input(k)
            name = OPERATIONS.get(code, str(code))
            if name == "output":
                self.results.append((out[0], out[1], work[args[0]]))
            elif name == "input":
                work[out[0]] = self._value(name, (), place=(args[0], args[1]))
            elif name == "const":
                work[out[0]] = self.constant(function.instruction_constant(k))
            elif name == "assign":
                work[out[0]] = work[args[0]]
            else:
                work[out[0]] = self._operation(name, tuple(work[a] for a in args))

    def constant(self, number: float) -> _Value:
        """Return a constant."""
        return self._value("const", (), number=self.real.rounded(number))

    def _operation(self, name: str, args: tuple[_Value, ...]) -> _Value:
        if name == "add":
            for one, other in (args, args[::-1]):
                if one.name == other.name == "if_else_zero":
                    (test, then), (against, otherwise) = one.args, other.args
                    if against.name == "not" and against.args[0] is test:
                        return self._value("choose", (test, then, otherwise))
        if name == "mul":
            for factor, truth in (args, args[::-1]):
                if truth.truth and factor.name == "const" and 0 < factor.number < float("inf"):
                    return self._value("if_else_zero", (truth, factor))
        if name not in {*_INFIX, *_TWICE, *_CALLED, "not", "neg", "inv", "if_else_zero"}:
            raise CodegenError(
                f"the step uses the operation {name!r} of CasADi, which C99 does not have: write"
                " the equations without it",
                symbol=name,
            )
        return self._value(name, args)

    def _value(
        self,
        name: str,
        args: tuple[_Value, ...],
        number: float = 0.0,
        place: tuple[int, int] = (0, 0),
    ) -> _Value:
        key = (name, *map(id, args), repr(number), place)
        if key not in self.values:
            value = _Value(name, args, number, place)
            value.nan, value.minus = _may_be(value)
            self.values[key] = value
        return self.values[key]

    def used(self) -> list[_Value]:
        """Return the values that results need, in their order; count uses and see signs."""
        for *_, value in self.results:
            value.uses += 1
            value.signed = True
        for value in reversed(self.values.values()):
            if value.uses:
                seen = _seen(value)
                for argument, sign in zip(value.args, seen, strict=True):
                    argument.uses += 1
                    argument.signed |= sign
        return [value for value in self.values.values() if value.uses]


def _may_be(value: _Value) -> tuple[bool, bool]:
    """Return whether a value may be a NaN, and whether what is written may be -0."""
    name, args = value.name, value.args
    if name == "const":
        return value.number != value.number, repr(value.number) == "-0.0"
    if name in _TRUTH:
        return False, False
    if name in {"fabs", "sq"}:
        return args[0].nan, False
    if name in {"neg", "sign", "floor", "ceil"}:
        return args[0].nan, True
    if name in {"fmax", "fmin"}:
        return args[0].nan and args[1].nan, args[0].minus or args[1].minus
    if name == "if_else_zero":
        return args[1].nan, args[1].minus
    if name == "choose":
        return args[1].nan or args[2].nan, args[1].minus or args[2].minus
    if name == "add":
        return True, args[0].minus and args[1].minus
    if name in {"sub", "twice", "sqrt"}:
        return True, args[0].minus
    return True, True


def _seen(value: _Value) -> list[bool]:
    """Return of which operands the sign of a zero is seen."""
    name, args = value.name, value.args
    if name == "choose" or name in _BLIND:
        return [False] * len(args)
    if name in {"add", "sub"}:
        # a sum is -0 only if both terms are; if one never is, the other's sign changes nothing
        hidden = not value.minus
        return [value.signed and not hidden] * 2
    if name in _ODD:
        return [value.signed] * len(args)
    if name == "div":
        return [value.signed, True]
    return [True] * len(args)


class _Writer:
    """C text of values."""

    def __init__(self, prefix: str, real: Real) -> None:
        self.prefix, self.type, self.real = prefix, real, f"{prefix}_real_t"
        self.lines: list[str] = []
        self.library: set[str] = set()
        self.own: set[str] = set()
        self.count = 0

    def write(self, values: Sequence[_Value], places: Mapping[tuple[int, int], str]) -> None:
        """Write values in their order, those that one other reads into its expression."""
        readers = {id(a): value for value in values for a in value.args}
        for value in values:
            if value.name == "const":
                value.text = self.literal(value.number)
                value.simple = not value.text.startswith("-")
            elif value.name == "input":
                self._name(value, places[value.place])
        for value in values:
            if value.name in {"const", "input"}:
                continue
            text = self._expression(value)
            reader = readers.get(id(value))
            value.product = value.name in {"mul", "sq"} or any(a.product for a in value.args)
            if value.uses > 1 or reader is None or not _joins(value, reader, text):
                self._name(value, text)
            else:
                value.text, value.simple = text, value.name in _CALLED

    def literal(self, number: float) -> str:
        """Return a constant of the type."""
        return self.type.literal(number, self.real)

    def result(self, value: _Value) -> str:
        """Return a value as a number that is assigned."""
        return self._chosen(value) if value.truth else value.text

    def atom(self, value: _Value) -> str:
        """Return a value as an operand."""
        return value.text if value.simple else f"({value.text})"

    def _name(self, value: _Value, text: str) -> None:
        kind = "_Bool" if value.truth else self.real
        value.text, value.simple, value.product = f"t{self.count}", True, False
        self.count += 1
        self.lines.append(f"const {kind} {value.text} = {text};")

    def _number(self, value: _Value) -> str:
        return f"({self._chosen(value)})" if value.truth else self.atom(value)

    def _chosen(self, value: _Value) -> str:
        return f"{self.atom(value)} ? {self.literal(1.0)} : {self.literal(0.0)}"

    def _condition(self, value: _Value) -> str:
        if value.truth:
            return self.atom(value)
        return f"({self.atom(value)} != {self.literal(0.0)})"

    def _expression(self, value: _Value) -> str:
        name, args = value.name, value.args
        if name in {"and", "or"}:
            return f"{self._condition(args[0])} {_INFIX[name]} {self._condition(args[1])}"
        if name == "not":
            return f"!{self._condition(args[0])}"
        if name == "if_else_zero":
            zero = self.literal(0.0)
            return f"{self._condition(args[0])} ? {self._number(args[1])} : {zero}"
        if name == "choose":
            then, other = self._number(args[1]), self._number(args[2])
            text = f"{self._condition(args[0])} ? {then} : {other}"
            return f"({text}) + {self.literal(0.0)}" if value.signed and value.minus else text
        if name in _CALLED:
            return f"{self._called(_CALLED[name])}({', '.join(map(self.result, args))})"
        numbers = [self._number(argument) for argument in args]
        if name in {"fmax", "fmin"}:
            return self._extreme(value, *numbers)
        written: dict[str, Callable[[], str]] = {
            "sq": lambda: f"{numbers[0]} * {numbers[0]}",
            "twice": lambda: f"{numbers[0]} + {numbers[0]}",
            "neg": lambda: f"-{numbers[0]}",
            "inv": lambda: f"{self.literal(1.0)} / {numbers[0]}",
            "sign": lambda: self._sign(numbers[0]),
        }
        return written[name]() if name in written else f" {_INFIX[name]} ".join(numbers)

    def _called(self, name: str) -> str:
        if self.type is DOUBLE or name in EXACT:
            self.library.add(name + self.type.suffix)
            return name + self.type.suffix
        self.own.add(name)
        return f"{self.prefix}_{name}"

    def _extreme(self, value: _Value, x: str, y: str) -> str:
        """Return the larger or smaller of two: the first where they are equal, no NaN if one is."""
        first, second = value.args
        low, high = (x, y) if value.name == "fmax" else (y, x)
        if not first.nan:
            return f"({low} < {high}) ? {y} : {x}"
        if not second.nan:
            return f"({high} <= {low}) ? {x} : {y}"
        return f"(({low} < {high}) || ({x} != {x})) ? {y} : {x}"

    def _sign(self, x: str) -> str:
        zero, one = self.literal(0.0), self.literal(1.0)
        return f"({x} < {zero}) ? -{one} : (({x} > {zero}) ? {one} : {x})"


def _joins(value: _Value, reader: _Value, text: str) -> bool:
    """Whether an expression may stand inside of that of its reader."""
    fused = value.product and reader.name in {"add", "sub", "choose"}
    return not fused and reader.name not in _TWICE and len(text) <= _LONGEST


def read_tape(step: ca.Function, real: Real) -> tuple[list[Any], list[tuple[int, int, Any]]]:
    """Return the values that are written in their order, and results: port, place, value."""
    reader = _Reader(scalar_function(step), real)
    return reader.used(), reader.results


def write_tape(
    step: ca.Function,
    prefix: str,
    places: Callable[[str, int], str] = lambda port, i: f"{port}[{i}]",
    real: Real = DOUBLE,
) -> Kernel:
    """Write the arithmetic of a step as one static C function of its structs.

    places: how entry i of ``memory, u, y, theta, next, xhat, ...`` is called in C
    """
    function = scalar_function(step)
    reader = _Reader(function, real)
    values = reader.used()
    inputs = [value.place for value in values if value.name == "input"]
    writer = _Writer(prefix, real)
    writer.write(values, {(k, i): places(STEP_INPUTS[k], i) for k, i in inputs})
    status = RESULTS.index("status")
    told = [(k, i, value) for k, i, value in reader.results if k != status]
    stores = [f"{places(RESULTS[k], i)} = {writer.result(value)};" for k, i, value in told]
    returned = [writer.result(value) for k, _, value in reader.results if k == status]
    loads = writer.lines[: len(inputs)]
    functions, lines = in_parts(
        loads, writer.lines[len(inputs) :], [*stores, f"return {returned[0]};"], prefix
    )
    if not any(STEP_INPUTS[k] != "memory" for k, _ in inputs):
        lines = [*lines[:-1], "(void)in;", lines[-1]]
    head = f"{prefix}_state_t *state, const {prefix}_in_t *in, {prefix}_out_t *out"
    kernel = _function(f"{writer.real} {prefix}_kernel(\n    {head})", lines)
    called = [write_function(name, prefix, real) for name in sorted(writer.own)]
    return Kernel(
        backend="tape",
        functions="\n\n".join([*(text for text, _ in called), *functions, kernel]),
        arguments=("state", "in", "out"),
        library=tuple(sorted(writer.library.union(*(names for _, names in called)))),
        operations=int(function.n_instructions()),
        counts=counted(value.name for value in values),
        own={name: ULPS[name] for name in sorted(writer.own)},
    )


def _function(head: str, lines: Sequence[str]) -> str:
    body = "\n".join(f"    {line}".rstrip() for line in lines)
    return f"static {head}\n{{\n{body}\n}}"


def write_function(name: str, prefix: str, real: Real) -> tuple[str, set[str]]:
    """Write a function of our own; return it and what it calls of the library."""
    function = own_function(name)
    reader, writer = _Reader(function, real), _Writer(prefix, real)
    values = reader.used()
    writer.write(values, {(k, 0): "xy"[k] for k in range(2)})
    arguments = ", ".join(f"{writer.real} {'xy'[k]}" for k in range(function.n_in()))
    lines = [*writer.lines, f"return {writer.result(reader.results[0][-1])};"]
    return _function(f"{writer.real} {prefix}_{name}({arguments})", lines), writer.library
