"""Inputs within one unit in the last place on both sides of what a step compares.

Every comparison of the tape is asked for what makes it turn: the one input that it depends on,
over all numbers, or any input around steps in service. What lies between two numbers with other
answers is halved, number by number, until they are neighbours.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from obsynth.codegen.lanes import Lanes

_COMPARED = ("lt", "le", "eq", "ne", "fmax", "fmin")
_LANES = 1000
_AROUND = (-30.0, -1.0, -0.03, -1e-3, 1e-3, 0.03, 1.0, 30.0)


@dataclass(frozen=True)
class Limit:
    """An entry of the inputs of a step, and a number there at which a comparison turns.

    base: which step the others are taken from; None where only this one matters
    """

    base: int | None
    port: int
    entry: int
    number: float


def _ordered(numbers: Any) -> Any:
    """Return whole numbers in the order of floating-point numbers, neighbours for neighbours."""
    whole = numbers.view(f"i{numbers.itemsize}")
    return np.where(whole < 0, np.iinfo(whole.dtype).min - whole, whole)


def _number(whole: Any, real: Any) -> Any:
    back = np.where(whole < 0, np.iinfo(whole.dtype).min - whole, whole)
    return back.astype(whole.dtype).view(real)


class Limits:
    """The comparisons of a step, and what they depend on."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self._real: Any = lanes.real.type
        self._inputs = [k for k, value in enumerate(lanes.values) if value.name == "input"]
        depends: list[int] = []
        for k, (value, places) in enumerate(zip(lanes.values, lanes.places, strict=True)):
            mask = 1 << k if value.name == "input" else 0
            for place in places:
                mask |= depends[place]
            depends.append(mask)
        compared = [k for k, v in enumerate(lanes.values) if v.name in _COMPARED]
        self.single = {
            k: depends[k].bit_length() - 1 for k in compared if depends[k].bit_count() == 1
        }
        self.several = {k: depends[k] for k in compared if depends[k].bit_count() > 1}

    def met(self, ports: Sequence[Any]) -> Any:
        """Return (lanes, features) which answers and values of steps (n_i, lanes) matter."""
        told = []
        for start in range(0, ports[0].shape[1], _LANES):
            found = self.lanes.run([port[:, start : start + _LANES] for port in ports])
            matter = self.lanes.matter(found)
            rows = list(matter)
            for k in (*self.single, *self.several):
                answer = self._answers(found, k) != 0
                rows += [matter[k] & answer, matter[k] & ~answer]
            told.append(rows)
        return np.concatenate(told, axis=1).T

    def _answers(self, found: Sequence[Any], k: int) -> Any:
        """Return (lanes,) what a comparison says."""
        a, b = (found[p] for p in self.lanes.places[k])
        return found[k] if self.lanes.values[k].name not in {"fmax", "fmin"} else a < b

    def _halved(self, ks: Sequence[int], low: Any, high: Any, ports: Any) -> tuple[Any, Any]:
        """Return neighbours (n,) between which comparison ks[i] turns in lane i.

        ports: numbers (n,) -> inputs (n_i, n)
        """
        low, high = _ordered(low), _ordered(high)
        needed = self.lanes.needed([*ks, *(p for k in ks for p in self.lanes.places[k])])

        def answer(whole: Any) -> Any:
            found = self.lanes.run(ports(_number(whole, self._real)), needed)
            return np.array([self._answers(found, k)[i] for i, k in enumerate(ks)])

        first = answer(low)
        while (np.abs(high - low) > 1).any():
            middle = (low & high) + ((low ^ high) >> 1)
            same = answer(middle) == first
            low, high = np.where(same, middle, low), np.where(same, high, middle)
        return _number(low, self._real), _number(high, self._real)

    def alone(self) -> list[Limit]:
        """Return limits of comparisons that depend on one input."""
        if not self.single:
            return []
        ks = list(self.single)
        numbers = [v.number for v in self.lanes.values if v.name == "const"]
        near = [c + d for c in {*numbers, 0.0} for d in (-1.0, -0.5, 0.0, 0.5, 1.0)]
        info = np.finfo(self._real)
        far = [info.max, float(info.tiny), *np.geomspace(1e-6, 1e6, 13)]
        with np.errstate(over="ignore"):
            ladder = np.unique(
                np.array([s * v for v in (*near, *far) for s in (1, -1)], self._real)
            )
        ladder = ladder[np.isfinite(ladder)]

        sizes = [1] * 4
        for port, entry in (self.lanes.values[k].place for k in self._inputs):
            sizes[port] = max(sizes[port], entry + 1)

        def ports(values: Any) -> list[Any]:
            return [np.tile(values, (size, 1)) for size in sizes]

        needed = self.lanes.needed([*ks, *(p for k in ks for p in self.lanes.places[k])])
        found = self.lanes.run(ports(ladder), needed)
        turned = [(k, i) for k in ks for i in np.flatnonzero(np.diff(self._answers(found, k)))]
        if not turned:
            return []
        at = np.array([i for _, i in turned])
        low, high = self._halved([k for k, _ in turned], ladder[at], ladder[at + 1], ports)
        told: dict[Limit, None] = {}
        for (k, _), one, other in zip(turned, low.tolist(), high.tolist(), strict=True):
            port, entry = self.lanes.values[self.single[k]].place
            # counters and flags hold whole numbers: those below and above as well
            whole = [np.floor(one), np.ceil(other)] if port == 0 and abs(one) < 1e6 else []
            for number in (one, other, *map(float, whole)):
                told[Limit(None, port, entry, number)] = None
        return list(told)

    def around(self, bases: Sequence[Any], most: int, rng: np.random.Generator) -> list[Limit]:
        """Return at most so many pairs for other comparisons, around the steps (n_i, steps)."""
        turned: dict[int, list[tuple[int, int, int, float]]] = {}
        for b in range(bases[0].shape[1] if most > 0 else 0):
            for found in self._turned(bases, b):
                turned.setdefault(found[0], []).append(found)
        # every comparison once, then once more
        rounds: list[tuple[int, tuple[int, int, int, float]]] = []
        for mine in turned.values():
            rounds += [(i, mine[j]) for i, j in enumerate(rng.permutation(len(mine))[:4].tolist())]
        order = rng.permutation(len(rounds)).tolist()
        order.sort(key=lambda i: rounds[i][0])
        kept = [rounds[i][1] for i in order[: max(most, 0)]]
        if not kept:
            return []
        steps = [np.array(port)[:, [b for _, b, _, _ in kept]] for port in bases]
        places = [self.lanes.values[c].place for _, _, c, _ in kept]
        low = np.array([steps[p][e, i] for i, (p, e) in enumerate(places)], self._real)
        high = np.array([number for *_, number in kept], self._real)

        def ports(values: Any) -> list[Any]:
            filled = [port.copy() for port in steps]
            for i, (port, entry) in enumerate(places):
                filled[port][entry, i] = values[i]
            return filled

        ends = self._halved([k for k, *_ in kept], low, high, ports)
        return [
            Limit(b, port, entry, float(end[i]))
            for i, ((_, b, _, _), (port, entry)) in enumerate(zip(kept, places, strict=True))
            for end in ends
        ]

    def _turned(self, bases: Sequence[Any], b: int) -> list[tuple[int, int, int, float]]:
        """Return comparisons that turn as one input moves away from a step, with the number."""
        tried: list[tuple[int, float]] = []
        for c in self._inputs:
            port, entry = self.lanes.values[c].place
            at = float(bases[port][entry, b])
            size = max(abs(at), 1e-3) if np.isfinite(at) else 1.0
            few = _AROUND if port else _AROUND[1::2]
            tried += [(c, at + size * d) for d in few]
        turned: list[tuple[int, int, int, float]] = []
        for start in range(0, len(tried), _LANES):
            part = tried[start : start + _LANES]
            ports = [np.repeat(port[:, b : b + 1], len(part) + 1, axis=1) for port in bases]
            for i, (c, number) in enumerate(part):
                port, entry = self.lanes.values[c].place
                ports[port][entry, i + 1] = number
            found = self.lanes.run(ports)
            for k in self.several:
                answers = self._answers(found, k)
                lanes = np.flatnonzero(answers != answers[0]) - 1
                turned += [(k, b, *part[i]) for i in lanes.tolist()]
        return turned
