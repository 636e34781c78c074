"""How many wrong steps the vectors tell from the right one: the mutant score.

    python tools/vector_score.py design.json

A mutant is one value of the tape's C computed otherwise: a constant by a unit in its last place,
by 1 % or with the other sign, another comparison or operator, the branches of a choice exchanged.
It is caught if a result or a memory of any recorded step differs. One that no step of three times
as many others tells from the right one counts as equivalent: it changes nothing that was found.
"""

import heapq
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.description import describe
from obsynth.codegen.kernel import Real
from obsynth.codegen.lanes import Lanes, differ
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
_FIRST = 64
"""Lanes on which a change is followed before it is followed on all."""

Operation = tuple[str, tuple[int | float, ...]]
"""What is computed in place of a value: its name, operands by their places (int) or numbers."""


class Changed(Lanes):
    """What becomes of a step where one of its values is computed otherwise."""

    def __init__(self, step: ca.Function, real: Real) -> None:
        super().__init__(step, real)
        self._readers: list[list[int]] = [[] for _ in self.values]
        for k, places in enumerate(self.places):
            for place in set(places):
                self._readers[place].append(k)

    def instead(self, found: Sequence[Any], change: Operation) -> Any:
        """Return (lanes,) what another operation makes of values that were found."""
        name, operands = change
        taken = (found[p] if isinstance(p, int) else np.full_like(found[0], p) for p in operands)
        with np.errstate(all="ignore"):
            return self._table[name](*taken)

    def seen(self, found: Sequence[Any], k: int, other: Any) -> bool:
        """Whether a result changes in any lane if value k is another one."""
        rows = np.flatnonzero(differ(found[k], other))
        few = rows[:: -(-len(rows) // _FIRST)] if len(rows) else rows
        return self._reaches(found, k, other, few) or (
            len(few) < len(rows) and self._reaches(found, k, other, rows)
        )

    def _reaches(self, found: Sequence[Any], k: int, other: Any, rows: Any) -> bool:
        if not len(rows):
            return False
        changed, waiting, entered = {k: other[rows]}, [k], {k}
        with np.errstate(all="ignore"):
            while waiting:
                place = heapq.heappop(waiting)
                if place != k:
                    taken = (changed.get(p) for p in self.places[place])
                    operands = [
                        found[p][rows] if new is None else new
                        for p, new in zip(self.places[place], taken, strict=True)
                    ]
                    new = self._table[self.values[place].name](*operands)
                    if not differ(found[place][rows], new).any():
                        continue
                    changed[place] = new
                if place in self._told:
                    return True
                for reader in self._readers[place]:
                    if reader not in entered:
                        entered.add(reader)
                        heapq.heappush(waiting, reader)
        return False


@dataclass(frozen=True)
class Mutant:
    """A value of the tape and what is computed in its place."""

    kind: str
    k: int
    change: Operation


def mutants(lanes: Changed) -> Iterator[Mutant]:
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


def _numbers(lanes: Changed, number: float) -> Iterator[tuple[str, float]]:
    real = lanes.real.type
    for end in (-np.inf, np.inf):
        with np.errstate(over="ignore"):
            yield "one ulp", float(np.nextafter(real(number), real(end)))
    if number:
        yield "one per cent", float(real(number * 1.01))
        yield "sign", -number


def sample(lanes: Changed, each: int, rng: np.random.Generator) -> list[Mutant]:
    """Return at most so many mutants of each kind."""
    kinds: dict[str, list[Mutant]] = {}
    for mutant in mutants(lanes):
        kinds.setdefault(mutant.kind, []).append(mutant)
    chosen = []
    for _, found in sorted(kinds.items()):
        places = rng.permutation(len(found))[:each]
        chosen += [found[i] for i in sorted(places.tolist())]
    return chosen


def caught(lanes: Changed, tried: list[Mutant], ports: list[Any]) -> list[bool]:
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
    lanes = Changed(observer.step, description.real)

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
