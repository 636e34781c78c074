"""Plants followed in 400 bits beside an observer: noise is what makes their readings doubles."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import mpmath as mp
import numpy as np
import sympy as sp

import obsynth as ob

BITS = 400
VOID, FAULT_OPEN, LEFT_OUT, RECOVERING = 8, 16, 32, 64


@dataclass(frozen=True, eq=False)
class Exactly:
    """A discrete plant whose last disturbances are noise, one for every output, added to it.

    inputs: rng -> u; unknown: rng -> d
    """

    plant: ob.Plant
    inputs: Callable = lambda rng: []
    unknown: Callable = lambda rng: []

    @cached_property
    def call(self):
        """All signals -> rows and outputs."""
        groups = [
            [s.symbol for s in getattr(self.plant, kind)]
            for kind in ("x", "u", "d", "f", "w", "p", "rho")
        ]
        rows = [*self.plant.rhs, *self.plant.output]
        return sp.lambdify([s for group in groups for s in group], rows, "mpmath")

    @cached_property
    def rates(self):
        """Of the faults; None where they jump."""
        return [0 if s.constant else s.rate for s in self.plant.f]

    def drawn(self, rng, signals, edges):
        """Numbers in ranges: at an end, or multiples of a 1024th between them."""
        found = []
        for s in signals:
            low, high = mp.mpf(s.lower), mp.mpf(s.upper)
            share = rng.integers(0, 2) if edges else mp.mpf(int(rng.integers(0, 1025))) / 1024
            found.append(low + (high - low) * int(share) if edges else low + (high - low) * share)
        return found

    def moved(self, rng, f, edges):
        """Faults one instant later."""
        found = []
        for s, rate, value in zip(self.plant.f, self.rates, f, strict=True):
            if rate is None:
                found += self.drawn(rng, [s], edges)
                continue
            share = rng.choice([-1, 1]) if edges else mp.mpf(int(rng.integers(-64, 65))) / 64
            there = value + mp.mpf(rate) * int(share) if edges else value + mp.mpf(rate) * share
            found.append(there if s.lower <= there <= s.upper else value)
        return found

    def reading(self, clean, bounds, noise):
        """Double readings, and the noise that makes them so."""
        y, found = [], []
        for value, bound, wished in zip(clean, bounds, noise, strict=True):
            told = float(value + wished)
            while abs(mp.mpf(told) - value) > bound:
                told = float(np.nextafter(told, float(value)))
            y.append(told)
            found.append(mp.mpf(told) - value)
        return np.array(y), found


@dataclass(eq=False)
class Told:
    """What a run said: whether sets held the truth, how far it was from their middle, the states.

    misses: (call, which) of what was outside
    """

    misses: list = field(default_factory=list)
    status: list = field(default_factory=list)
    widths: list = field(default_factory=list)
    checked: int = 0


def follow(exactly, observer, rng, calls, start, edges=False, gaps=0.0, broken=()):
    """Run one trajectory; sets of the start are boxes (n, 2); readings are lies when broken."""
    plant, told = exactly.plant, Told()
    n, n_f, m = len(plant.x), len(plant.f), len(plant.output_names)
    bounds = [mp.mpf(s.upper) for s in plant.w[-m:]]
    with mp.workprec(BITS):
        ends = [[mp.mpf(end) for end in pair] for pair in np.asarray(start, float)]
        shares = [mp.mpf(int(rng.integers(0, 9))) / 8 for _ in ends]
        if edges:
            shares = [mp.mpf(int(s > 0.5)) for s in shares]
        x = [low + (high - low) * s for s, (low, high) in zip(shares, ends, strict=True)]
        f = exactly.drawn(rng, plant.f, edges) if n_f else []
        # a rate that is not zero begins at zero, known; others anywhere in their range
        f = [mp.mpf(0) if rate else v for v, rate in zip(f, exactly.rates, strict=True)]
        p = exactly.drawn(rng, plant.p, edges)
        f_range = [
            (0.0, 0.0) if rate else (s.lower, s.upper)
            for s, rate in zip(plant.f, exactly.rates, strict=True)
        ]
        memory = observer.memory0(
            [float(sum(e) / 2) for e in ends], x_range=start, f_range=f_range or None
        )
        before = None
        for k in range(calls):
            u, d = exactly.inputs(rng), exactly.unknown(rng)
            w = exactly.drawn(rng, plant.w, edges and rng.random() < 0.7)
            fixed = *p, *exactly.drawn(rng, plant.rho, edges)
            rows = exactly.call(*x, *u, *d, *f, *w[:-m], *[mp.mpf(0)] * m, *fixed)
            y, w[-m:] = exactly.reading(rows[n:], bounds, w[-m:])
            seen = np.where(rng.random(m) < gaps, np.nan, y)
            seen = seen + 1e3 if k in broken else seen
            memory, *found = observer.step(memory, u, seen)
            low, high, below, above = (np.array(v).ravel() for v in found[2:6])
            status = int(found[6])
            told.status.append(status)
            told.widths.append(np.concatenate([high - low, above - below]))
            if k not in broken:
                shown = f if not observer.fault_delay else before
                truth = [*x, *([] if shown is None else shown)]
                sets = zip([*low, *below], [*high, *above], truth, strict=False)
                for i, (a, b, value) in enumerate(sets):
                    told.checked += 1
                    if not mp.mpf(float(a)) <= value <= mp.mpf(float(b)):
                        told.misses.append((k, i))
            x = exactly.call(*x, *u, *d, *f, *w, *fixed)[:n]
            before, f = f, exactly.moved(rng, f, edges)
    return told
