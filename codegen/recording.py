"""Recorded steps as a C program runs through them: bit patterns, what follows from what, text."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from obsynth.codegen.description import Description
from obsynth.codegen.errors import CodegenError
from obsynth.codegen.kernel import Real
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS
from obsynth.symbolic.arrays import FloatArray

ALL_BITS = sum(STATUS.values())
"""The status of which every bit is set."""

SMALL = 48
"""Most steps of the self-test on the target."""

_STATUS = STEP_OUTPUTS.index("status")


@dataclass(frozen=True)
class Word:
    """Bit patterns of a real type, as NumPy and C name them."""

    real: Real

    @property
    def bits(self) -> int:
        """Bits of a pattern."""
        return self.real.bits

    @property
    def pattern(self) -> type[np.unsignedinteger[Any]]:
        """NumPy's type of a pattern."""
        return np.uint64 if self.bits == 64 else np.uint32

    @property
    def digits(self) -> int:
        """Hexadecimal digits of a pattern."""
        return self.bits // 4

    @property
    def factor(self) -> int:
        """What patterns are mixed with into one: odd, the golden section of the type."""
        return 0x9E3779B97F4A7C15 >> (64 - self.bits) | 1

    @property
    def infinity(self) -> int:
        """The pattern of infinity; what is above, without its sign, is no number."""
        return int(self.patterns(np.inf))

    @property
    def nan(self) -> int:
        """The pattern that stands for every NaN."""
        return int(self.patterns(np.nan))

    def patterns(self, values: Any) -> Any:
        """Return bit patterns of any shape, one for all NaNs, as IEEE 754 defines no more."""
        with np.errstate(over="ignore"):
            numbers: Any = np.array(values).astype(self.real.type)
        numbers[np.isnan(numbers)] = np.nan
        return numbers.view(self.pattern)

    def mixed(self, patterns: Any) -> Any:
        """Return one pattern (...) for the patterns (..., n) of a memory, other for another."""
        found = np.zeros(patterns.shape[:-1], dtype=self.pattern)
        factor, half = self.pattern(self.factor), self.pattern(self.bits // 2)
        with np.errstate(over="ignore"):
            for column in np.moveaxis(patterns, -1, 0):
                found = (found ^ column) * factor
                found = found ^ (found >> half)
        return found


@dataclass(frozen=True)
class Vectors:
    """Vectors as the C programs read them: one record a line, see the README of a project.

    small, few: words of the self-test, see `small_words`, and how many steps it has
    values: how many numbers the runner has to compare: results, statuses and memories
    kinds, statuses: how many steps of which kind, and of which status
    """

    word: Word
    text: str
    small: tuple[int, ...]
    few: int
    count: int
    values: int
    kinds: Mapping[str, int]
    statuses: Mapping[int, int]


@dataclass(frozen=True, eq=False)
class Step:
    """One recorded step: memory before, inputs, status, results, memory afterwards."""

    before: FloatArray
    inputs: FloatArray
    status: int
    results: FloatArray
    after: FloatArray


@dataclass(eq=False)
class Recorder:
    """The state of a C program that runs through the vectors, kept by a machine.

    calls: N, D or M with the memory that they left, or S with a step
    """

    description: Description
    machine: Callable[..., list[FloatArray]]
    calls: list[tuple[str, FloatArray | Step]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.word = Word(self.description.real)
        self._type = self.word.real.type
        self.memory = np.zeros(self.description.start.size, self._type)

    def forget(self) -> None:
        """Record a call of NAME_init."""
        self._set("N", np.zeros_like(self.memory))

    def default(self) -> None:
        """Record a call of NAME_init_default."""
        self._set("D", self.description.start)

    def load(self, memory: FloatArray) -> None:
        """Record a call of NAME_set_memory."""
        self._set("M", memory)

    def _set(self, letter: str, memory: FloatArray) -> None:
        with np.errstate(over="ignore"):
            self.memory = memory.astype(self._type)
        self.calls.append((letter, self.memory))

    def step(self, inputs: list[FloatArray]) -> int:
        """Record one step with u, y and theta where there is one; return its status."""
        with np.errstate(over="ignore"):
            inputs = [values.astype(self._type) for values in inputs]
        arrays = self.machine(self.memory, *inputs)
        status = float(arrays.pop(_STATUS)[0])
        if not (status.is_integer() and 0 <= status <= ALL_BITS):
            raise CodegenError(
                f"the step returns status {status!r}, which is no mask of the bits"
                f" {', '.join(map(str, STATUS.values()))}",
                status=status,
                memory=self.memory,
                u=inputs[0],
                y=inputs[1],
            )
        before, self.memory = self.memory, arrays.pop(0)
        told = np.concatenate(inputs), int(status), np.concatenate(arrays)
        self.calls.append(("S", Step(before, *told, self.memory)))
        return int(status)

    @property
    def steps(self) -> list[Step]:
        """The steps in their order."""
        return [done for _, done in self.calls if isinstance(done, Step)]

    def vectors(self, kinds: Mapping[str, int]) -> Vectors:
        """Return what was recorded."""
        steps, word = self.steps, self.word
        few = _few(steps)
        n_memory, results = self.memory.size, steps[0].results.size
        # statuses of the steps, and what the self-test returns
        compared = len(self.calls) * n_memory + len(steps) * (results + 1) + 1
        return Vectors(
            word=word,
            text=self._text(),
            small=tuple(small_words(few, word)),
            few=len(few),
            count=len(steps),
            values=compared,
            kinds=kinds,
            statuses=dict(sorted(Counter(step.status for step in steps).items())),
        )

    def _text(self) -> str:
        word = self.word
        sizes = map(str, self.description.sizes.values())
        head = ("obsynth-vectors", "2", self.description.name, *sizes, str(len(self.steps)))
        lines = [" ".join(head)]
        left = [done.after if isinstance(done, Step) else done for _, done in self.calls]
        mixed = word.mixed(word.patterns(left)).tolist()
        loaded, told = [0] * self.memory.size, list[int]()
        for (letter, done), mix in zip(self.calls, mixed, strict=True):
            parts = [letter]
            if isinstance(done, Step):
                numbers = word.patterns(np.concatenate([done.inputs, done.results])).tolist()
                parts += [str(done.status), *tokens(numbers, told or [0] * len(numbers), word)]
                told = numbers
            elif letter == "M":
                numbers = word.patterns(done).tolist()
                parts += tokens(numbers, loaded, word)
                loaded = numbers
            lines.append(" ".join([*parts, _hex(mix, word)]))
        return "\n".join(lines) + "\n"


def _hex(pattern: int, word: Word) -> str:
    """Return a pattern in hexadecimal without trailing zeros."""
    return f"{pattern:0{word.digits}x}".rstrip("0") or "0"


def tokens(numbers: Sequence[int], before: Sequence[int], word: Word) -> list[str]:
    """Return patterns; ``.n`` for the next n that are the same as before."""
    tokens, same = list[str](), 0
    for new, old in zip(numbers, before, strict=True):
        if new == old:
            same += 1
            continue
        tokens += [f".{same}"] * (same > 0) + [_hex(new, word)]
        same = 0
    return tokens + [f".{same}"] * (same > 0)


def _few(steps: Sequence[Step]) -> list[Step]:
    """Return few steps: the first ones, one for every status and others, evenly."""
    kinds: dict[int, int] = {}
    for k, step in enumerate(steps):
        kinds.setdefault(step.status, k)
    chosen = [*range(SMALL // 4), *kinds.values(), *range(0, len(steps), len(steps) // SMALL)]
    return [steps[k] for k in sorted(dict.fromkeys(chosen[:SMALL]))]


def small_words(steps: Iterable[Step], word: Word) -> Iterable[int]:
    """Return the words of the self-test: 1 and the memory before, or 0; then a mix of the rest."""
    left: FloatArray | None = None
    for step in steps:
        carried = left is step.before
        yield 0 if carried else 1
        if not carried:
            yield from word.patterns(step.before).tolist()
        yield from word.patterns(step.inputs).tolist()
        yield step.status
        yield from word.patterns(step.results).tolist()
        yield int(word.mixed(word.patterns(step.after)))
        left = step.after
