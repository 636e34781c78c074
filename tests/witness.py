"""Records of trajectories in 400 bits: noise is what makes their readings doubles."""

from dataclasses import dataclass
from functools import cache

import mpmath as mp
import numpy as np
import sympy as sp
from exactly import BITS, Exactly
from gallery import TIMES

import obsynth as ob

FREE = {"leaking_tanks": {"a1": (0.02, 0.03), "b1": (0.03, 0.04)}}
"""Parameters with a value that are looked for."""
PLANTS = (
    "leaking_tanks",
    "flexible_joint",  # two states are not measured
    "battery",  # one is not, the output is a cubic with the fault in it
    "remainder cruise_control",  # the gain of the fault varies
    "dc_motor",  # exponential, tangens hyperbolicus, an unknown input without a range
    "kinematic_bicycle",
)


@cache
def plant_of(name):
    """A plant in discrete time, without ranges for its parameters."""
    way, _, name = name.rpartition(" ")
    given = getattr(ob.plants, name)(*([3] if name == "tanks_in_a_row" else []))
    if given.Ts is not None:
        return given
    return given.discretise("euler", Ts=TIMES[name], remainder=way == "remainder")


@cache
def exact_of(name):
    """The plant with ranges of what is looked for; its equations in 400 bits, of x u d f w p."""
    plant = plant_of(name)
    exactly = Exactly(plant.with_ranges(FREE[name]) if name in FREE else plant)
    groups = [s.symbol for kind in "xudfwp" for s in getattr(exactly.plant, kind)]
    values = {s.symbol: s.value for s in exactly.plant.constants}
    rows = [sp.sympify(r).subs(values) for r in (*exactly.plant.rhs, *exactly.plant.output)]
    noise = [s.symbol for s in exactly.plant.w]
    shown = [
        next(j for j, w in enumerate(noise) if sp.diff(y, w) == 1) for y in exactly.plant.output
    ]
    return exactly, sp.lambdify(groups, rows, "mpmath"), shown


def record_of(plant, u, y):
    """The Record of inputs and readings."""
    names = {"u": plant.names("u"), "y": tuple(plant.output_names)}
    units = {kind: ("",) * len(found) for kind, found in names.items()}
    time = np.arange(len(y)) * float(plant.Ts)
    u = np.asarray(u, float).reshape(len(y), -1)
    return ob.Record(time, u, np.array(y, float), np.empty((len(y), 0)), names, units, "made")


@dataclass
class Truth:
    """A record and what happened: v at every instant, in 400 bits; what may be free."""

    plant: ob.Plant
    record: ob.Record
    v: list
    free: dict | None


def happened(name, seed, steps=24, gaps=0.1):
    """A trajectory inside of all ranges, noise at vertices or uniform, some readings missing."""
    rng = np.random.default_rng(seed)
    plant = plant_of(name)
    edges, held = bool(rng.integers(2)), bool(rng.integers(2))
    with mp.workprec(BITS):
        path, u, y = max(
            (_run(name, rng, steps, edges, held) for _ in range(6)), key=lambda run: len(run[0])
        )
    seen = np.where(rng.random((len(y), len(plant.output_names))) < gaps, np.nan, y)
    free = None
    if held or name in FREE:
        free = dict.fromkeys(() if held else plant.names("f")) | FREE.get(name, {})
        free |= dict.fromkeys(plant.names("d"))
    return Truth(plant, record_of(plant, u, seen), path, free)


def _run(name, rng, steps, edges, held):
    (exactly, call, shown), n = exact_of(name), len(plant_of(name).x)
    plant = exactly.plant
    shares = rng.uniform(0.3, 0.7, n + len(plant.u))
    x = [
        mp.mpf(s.lower) + (mp.mpf(s.upper) - s.lower) * mp.mpf(a)
        for s, a in zip(plant.x, shares[:n].tolist(), strict=True)
    ]
    f = [mp.mpf(0)] * len(plant.f) if held else exactly.drawn(rng, plant.f, False)
    p = exactly.drawn(rng, plant.p, False)
    path, us, ys = [], [], []
    while len(path) < steps:
        if not all(s.lower <= a <= s.upper for s, a in zip(plant.x, x, strict=True)):
            break
        u = [
            float(np.clip(s.lower + (s.upper - s.lower) * (a + 0.1 * z), s.lower, s.upper))
            for s, a, z in zip(plant.u, shares[n:], rng.normal(size=len(plant.u)), strict=True)
        ]
        w = exactly.drawn(rng, plant.w, edges)
        d = [mp.mpf(float(rng.uniform(-0.01, 0.01))) for _ in plant.d]
        y = []
        for value, j in zip(call(*x, *u, *d, *f, *w, *p)[n:], shown, strict=True):
            told, wished = float(value), w[j]
            while (
                not plant.w[j].lower <= (noise := wished + mp.mpf(told) - value) <= plant.w[j].upper
            ):
                told = float(np.nextafter(told, told - np.sign(float(noise))))
            w[j] = noise
            y.append(told)
        path.append([*x, *f, *d, *w, *p])
        us.append(u)
        ys.append(y)
        x = call(*x, *u, *d, *f, *w, *p)[:n]
        f = f if held else exactly.moved(rng, f, edges)
    return path, us, ys
