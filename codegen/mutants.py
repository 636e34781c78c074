"""How many wrong steps the vectors tell from the right one: the mutant score.

    python -m obsynth.codegen.mutants design.json

A mutant is one value of the tape's C computed otherwise: a constant by a unit in its last place,
by 1 % or with the other sign, another comparison or operator, the branches of a choice exchanged.
It is caught if a result or a memory of any recorded step differs. One that no step of three times
as many others tells from the right one counts as equivalent: it changes nothing that was found.
"""

import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.codegen.description import describe
from obsynth.codegen.lanes import Lanes, Operation
from obsynth.codegen.vectors import COUNT, as_ports, record
from obsynth.designs.core.loading import load
from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector

_EXCHANGED = (
    ("lt", "le", "eq", "ne"),
    ("add", "sub", "mul", "div"),
    ("fmax", "fmin"),
    ("and", "or"),
    ("sq", "twice"),
)
_COMPARED = _EXCHANGED[0]
_LANES = 2000
_MORE = 3


@dataclass(frozen=True)
class Mutant:
    """A value of the tape and what is computed in its place."""

    kind: str
    k: int
    change: Operation


def mutants(lanes: Lanes) -> Iterator[Mutant]:
    """Return all mutants of a step, value by value."""
    for k, (value, places) in enumerate(zip(lanes.values, lanes.places, strict=True)):
        name = value.name
        for i, place in enumerate(places):
            operand = lanes.values[place]
            if operand.name == "const" and np.isfinite(operand.number):
                for kind, number in _numbers(lanes, operand.number):
                    new: list[int | float] = [*places]
                    new[i] = number
                    yield Mutant(kind, k, (name, tuple(new)))
        for group in _EXCHANGED:
            kind = "comparison" if group is _COMPARED else "operator"
            for other in group if name in group else ():
                if other != name:
                    yield Mutant(kind, k, (other, places))
            if group is _COMPARED and name in group[:2]:
                for other in group[:2]:
                    yield Mutant(kind, k, (other, places[::-1]))
        if name == "choose":
            yield Mutant("choice", k, (name, (places[0], places[2], places[1])))
        if name == "if_else_zero":
            yield Mutant("choice", k, ("choose", (places[0], 0.0, places[1])))


def _numbers(lanes: Lanes, number: float) -> Iterator[tuple[str, float]]:
    real = lanes.real.type
    for end in (-np.inf, np.inf):
        with np.errstate(over="ignore"):
            yield "one ulp", float(np.nextafter(real(number), real(end)))
    if number:
        yield "one per cent", float(real(number * 1.01))
        yield "sign", -number


def sample(lanes: Lanes, each: int, rng: np.random.Generator) -> list[Mutant]:
    """Return at most so many mutants of each kind."""
    kinds: dict[str, list[Mutant]] = {}
    for mutant in mutants(lanes):
        kinds.setdefault(mutant.kind, []).append(mutant)
    chosen = []
    for _, found in sorted(kinds.items()):
        places = rng.permutation(len(found))[:each]
        chosen += [found[i] for i in sorted(places.tolist())]
    return chosen


def caught(lanes: Lanes, tried: list[Mutant], ports: list[Any]) -> list[bool]:
    """Return which mutants steps with these inputs (n, steps) tell from the right one."""
    told = [False] * len(tried)
    for start in range(0, ports[0].shape[1], _LANES):
        found = lanes.run([port[:, start : start + _LANES] for port in ports])
        for j, mutant in enumerate(tried):
            if not told[j]:
                told[j] = lanes.seen(found, mutant.k, lanes.instead(found, mutant.change))
    return told


@dataclass(frozen=True)
class Score:
    """What became of mutants.

    caught: by the vectors
    missed: by the vectors, and told from the right step by others
    equivalent: told from the right step by none
    """

    name: str
    caught: tuple[Mutant, ...]
    missed: tuple[Mutant, ...]
    equivalent: tuple[Mutant, ...]

    @property
    def share(self) -> float:
        """Share of those caught among those that are not equivalent."""
        return len(self.caught) / max(len(self.caught) + len(self.missed), 1)

    def __str__(self) -> str:
        missed = Counter(mutant.kind for mutant in self.missed)
        kinds = ", ".join(f"{times} of {kind}" for kind, times in sorted(missed.items()))
        apart = len(self.caught) + len(self.missed)
        return (
            f"{self.name}: {len(self.caught)} of {apart} mutants caught"
            f" ({100 * self.share:.1f} %){f', missed {kinds}' if kinds else ''};"
            f" {len(self.equivalent)} more change nothing that was found"
        )


def score(
    observer: Observer | FaultDetector, count: int = COUNT, each: int = 60, seed: int = 0
) -> Score:
    """Plant mutants, at most so many of each kind, and compare them on the vectors of a step."""
    description = describe(observer)
    lanes = Lanes(observer.step, description.real)

    def seen(tried: list[Mutant], count: int, seed: int) -> list[bool]:
        steps = record(description, count, seed)[0].steps
        return caught(lanes, tried, as_ports(description, [(s.before, s.inputs) for s in steps]))

    tried = sample(lanes, each, np.random.default_rng(seed))
    told = seen(tried, count, seed)
    left = [mutant for mutant, found in zip(tried, told, strict=True) if not found]
    apart = seen(left, _MORE * count, seed + 1) if left else []
    return Score(
        f"{observer.method} of {observer.model.name}",
        tuple(mutant for mutant, found in zip(tried, told, strict=True) if found),
        tuple(mutant for mutant, found in zip(left, apart, strict=True) if found),
        tuple(mutant for mutant, found in zip(left, apart, strict=True) if not found),
    )


if __name__ == "__main__":
    for path in sys.argv[1:]:
        print(score(load(Path(path))))
