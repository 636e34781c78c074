"""How many wrong steps the vectors tell from the right one: the mutant score.

A mutant is one value of the tape's C computed otherwise: a constant by a unit in its last place,
by 1 % or with the other sign, another comparison or operator, the branches of a choice exchanged.
It is caught if a result or a memory of any recorded step differs. One that no step of many times
as many others tells from the right one changes nothing that matters and does not count.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.codegen.lanes import Lanes, Operation

_EXCHANGED = (
    ("lt", "le", "eq", "ne"),
    ("add", "sub", "mul", "div"),
    ("fmax", "fmin"),
    ("and", "or"),
    ("sq", "twice"),
)
_COMPARED = _EXCHANGED[0]
LANES = 2000
"""Steps that are evaluated at a time."""


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
    for start in range(0, ports[0].shape[1], LANES):
        found = lanes.run([port[:, start : start + LANES] for port in ports])
        for j, mutant in enumerate(tried):
            if not told[j]:
                told[j] = lanes.seen(found, mutant.k, lanes.instead(found, mutant.change))
    return told
