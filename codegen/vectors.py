"""Test vectors: what CasADi's virtual machine, or one in single precision, returns, bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.codegen.description import Description
from obsynth.codegen.drive import Drive, spread
from obsynth.codegen.errors import CodegenError
from obsynth.codegen.kernel import DOUBLE, SINGLE
from obsynth.codegen.lanes import Lanes
from obsynth.codegen.limits import Limit, Limits
from obsynth.codegen.recording import Recorder, Step, Vectors
from obsynth.codegen.single import machine_of
from obsynth.symbolic.arrays import FloatArray

MINIMUM = 100
"""Fewest vectors that still hold some of every kind."""

COUNT = 3000
"""How many there are by default: files stay below a megabyte."""

SHARES: Mapping[str, float] = {
    "closed loop": 0.31,
    "closed loop with failing signals": 0.08,
    "limits": 0.38,
    "random": 0.13,
    "extreme": 0.08,
    "not initialised": 0.02,
}
"""Share of every kind of vectors; what limits do not need goes to the closed loop."""

_SEQUENCE = 120
_STRETCH = 10
_BASES = 8
_EACH = 6
_TRIED = 6
_VALUES = 2_000_000
_EXTREMES: Mapping[str, FloatArray] = {
    real.precision: np.array(
        [
            *(0.0, -0.0, float(info.smallest_subnormal), -float(info.tiny), *small, *large),
            *(float(info.max), -float(info.max), np.inf, -np.inf, np.nan),
        ]
    )
    for real, small, large in (
        (DOUBLE, (1e-160, 1e160), (-1e300, 1.0000000000000002e300)),
        (SINGLE, (1e-20, 1e20), (-1e35, 1e35)),
    )
    for info in [np.finfo(real.type)]
}


def make_vectors(description: Description, count: int = COUNT, seed: int = 0) -> Vectors:
    """Run the step and record every input and result, see `record`."""
    recorder, kinds = record(description, count, seed)
    return recorder.vectors(kinds)


def record(
    description: Description, count: int = COUNT, seed: int = 0
) -> tuple[Recorder, dict[str, int]]:
    """Run the step on its machine; return what was recorded, and how many steps of which kind.

    From memories along trajectories start steps on both sides of every limit that the step compares
    something with, and steps with numbers that are random, extreme or not finite; the last ones
    follow `NAME_init`.
    """
    if count < MINIMUM:
        raise CodegenError(
            f"vectors={count}; at least {MINIMUM} are needed for some of every kind",
            vectors=count,
        )
    for kept in (1.0, 0.9, 0.8, 0.7):
        recorder, kinds = _record(description, count, seed, kept)
        if sum(step.status == 0 for step in recorder.steps) >= count / 2:
            break
    return recorder, kinds


def _record(
    description: Description, count: int, seed: int, kept: float
) -> tuple[Recorder, dict[str, int]]:
    """Record with a share of what is off the trajectories; the closed loop takes the rest."""
    rng = np.random.default_rng(seed)
    machine = machine_of(description.observer.step, description.real)
    drive = Drive(description, rng)
    kinds = {kind: int(share * count) for kind, share in SHARES.items()}
    for kind in ("limits", "random", "extreme"):
        kinds[kind] = int(kept * kinds[kind])
    sound, failing = (_driven(description, machine, drive, kinds, kind) for kind in list(kinds)[:2])
    healthy = [step for step in sound if step.status == 0] or sound
    bases = [steps[i] for steps in (healthy, failing) for i in rng.permutation(len(steps))[:_BASES]]
    bases += [sound[0]] * (_BASES // 4)  # where everything begins
    limits = Limits(Lanes(description.observer.step, description.real))
    alone = limits.alone()
    rng.shuffle(alone)
    alone = alone[: kinds["limits"]]
    ports = as_ports(description, [(base.before, base.inputs) for base in bases])
    pairs = min(2 * (kinds["limits"] - len(alone)) // 3, _VALUES // len(limits.lanes.values))
    around = limits.around([port[:, :_BASES] for port in ports], pairs, rng)
    left = max(kinds["limits"] - len(alone) - len(around), 0)
    kinds["limits"] -= left
    # where nearly all is healthy, what limits do not need goes to random steps, too
    kinds["random"] += int(left * max(len(healthy) / len(sound) - 0.4, 0.0))
    tried = _beside(description, bases, [*alone, *around])
    tried += _changed(description, drive, bases, _scale([step.before for step in sound]), kinds)
    met = limits.met(as_ports(description, [(c.memory, np.concatenate(c.inputs)) for c in tried]))
    most = sum(kinds[kind] for kind in ("limits", "random", "extreme"))
    # both sides of one limit of every comparison, where there is room for them
    first = len(alone) + min(len(around), (kinds["limits"] - len(alone)) // 4 * 2)
    chosen = [tried[i] for i in _rare(met, range(first), most, rng)]
    kinds |= {kind: sum(c.kind == kind for c in chosen) for kind in ("limits", "random", "extreme")}
    kinds["closed loop"] += count - sum(kinds.values())

    recorder = Recorder(description, machine)
    recorder.default()
    for steps, kind in ((sound, "closed loop"), (failing, "closed loop with failing signals")):
        met = limits.met(as_ports(description, [(step.before, step.inputs) for step in steps]))
        rare = _rare(met, [0], kinds[kind] // _STRETCH // 3, rng)
        for step in _stretches(steps, kinds[kind], rare, rng):
            _repeat(recorder, step.before, description.split(step.inputs))
    # memories that have much in common behind one another: what they have is stored once
    for case in sorted(chosen, key=lambda case: case.base):
        _repeat(recorder, case.memory, case.inputs)
    for i in range(kinds["not initialised"]):
        if i % 4 == 0:
            recorder.forget()
        recorder.step(drive.wide())
    return recorder, kinds


@dataclass(frozen=True, eq=False)
class _Case:
    """A step that starts from another one's memory and inputs, with some numbers changed."""

    kind: str
    base: int
    memory: FloatArray
    inputs: list[FloatArray]


def as_ports(
    description: Description, steps: list[tuple[FloatArray, FloatArray]]
) -> list[FloatArray]:
    """Return memories and inputs (n_i, steps), as `Lanes` takes them."""
    inputs = np.array([given for _, given in steps]).T
    sizes = [port.size for port in description.split(inputs[:, 0])]
    return [np.array([m for m, _ in steps]).T, *np.split(inputs, np.cumsum(sizes)[:-1])]


def _repeat(recorder: Recorder, memory: FloatArray, inputs: list[FloatArray]) -> None:
    """Record a step from a memory, which is loaded where it is not there already."""
    there, wanted = (recorder.word.patterns(values) for values in (recorder.memory, memory))
    if (there != wanted).any():
        recorder.load(memory)
    recorder.step(inputs)


def _driven(
    description: Description,
    machine: Callable[..., list[FloatArray]],
    drive: Drive,
    kinds: Mapping[str, int],
    kind: str,
) -> list[Step]:
    """Return the steps of trajectories, one behind the other."""
    failing, scout = kind != "closed loop", Recorder(description, machine)
    # what limits do not need goes to the closed loop
    total = 2 * kinds[kind] if failing else kinds[kind] + kinds["limits"] + len(kinds)
    steps, healthy = 0, 0
    while steps < total or (healthy < 0.75 * total and steps < 3 * total):
        steps += _SEQUENCE
        guess = drive.begin(_SEQUENCE)
        if guess is None:
            scout.default()
        else:
            scout.load(guess)
        for k in range(_SEQUENCE):
            inputs = drive.sample(k)
            # Whole stretches fail, so that what follows a failure is tested too.
            if failing and k % 25 in (7, 8, 9, 20):
                _spoil(drive, inputs)
            healthy += scout.step(inputs) == 0
    return scout.steps


def _stretches(
    steps: list[Step], count: int, rare: list[int], rng: np.random.Generator
) -> list[Step]:
    """Return so many steps, in stretches: those around rare ones, and the healthiest."""
    order = rng.permutation(len(steps) // _STRETCH).tolist()
    sound = np.array([step.status == 0 for step in steps])
    order.sort(key=lambda i: -sound[i * _STRETCH : (i + 1) * _STRETCH].sum())
    places = dict.fromkeys([*(i // _STRETCH for i in rare), *order])
    kept = sorted([*places][: -(-count // _STRETCH)])
    return [step for i in kept for step in steps[i * _STRETCH : (i + 1) * _STRETCH]][:count]


def _rare(
    met: NDArray[np.bool_], start: Iterable[int], most: int, rng: np.random.Generator
) -> list[int]:
    """Return the first steps and others: of every feature some, rare ones first.

    Shapes: met (steps, features).
    """
    chosen = dict.fromkeys(start)
    times = met[list(chosen)].sum(axis=0)
    for c in np.argsort(met.sum(axis=0), kind="stable").tolist():
        for i in rng.permutation(np.flatnonzero(met[:, c])).tolist() if times[c] < _EACH else ():
            if i not in chosen and times[c] < _EACH and len(chosen) < most:
                chosen[i] = None
                times += met[i]
    others = [i for i in rng.permutation(len(met)).tolist() if i not in chosen]
    return sorted([*chosen, *others[: max(most - len(chosen), 0)]])


def _beside(description: Description, bases: list[Step], limits: list[Limit]) -> list[_Case]:
    """Return steps beside limits."""
    found = []
    for i, limit in enumerate(limits):
        of = i % _BASES % len(bases) if limit.base is None else limit.base
        arrays = [bases[of].before.astype(float), *description.split(bases[of].inputs)]
        arrays[limit.port][limit.entry] = limit.number
        found.append(_Case("limits", of, arrays[0], arrays[1:]))
    return found


def _changed(
    description: Description,
    drive: Drive,
    bases: list[Step],
    scale: FloatArray,
    kinds: Mapping[str, int],
) -> list[_Case]:
    """Return more steps than are needed with random, extreme or no finite numbers."""
    found, rng = [], drive.rng
    for kind in ("random", "extreme"):
        for i in range(_TRIED * kinds[kind]):
            # the last ones are first calls, whose numbers meet what begins anew
            of = len(bases) - 1 - i % 2 if kind == "extreme" and i % 6 == 0 else i % len(bases)
            memory, inputs = bases[of].before.astype(float), description.split(bases[of].inputs)
            if i % 4 < 2:
                inputs = [spread(rng, values) for values in inputs]
            if i % 4 > 0:
                few = np.full(memory.size, i % 24 == 1)
                for field in rng.choice(np.array(description.fields), 2):
                    few[field.start + rng.integers(field.size)] = True
                memory = np.where(few, random_memory(rng, memory, scale), memory)
            if kind == "extreme":
                # Extremes in the memory would hide those in inputs: a step must cope with either.
                _spoil(drive, [memory] if i % 3 == 0 else inputs)
            found.append(_Case(kind, of, memory, inputs))
    return found


def _spoil(drive: Drive, arrays: list[FloatArray]) -> None:
    """Replace one to three entries by extreme or non-finite numbers, in place."""
    places = [(array, i) for array in arrays for i in range(array.size)]
    rng = drive.rng
    for _ in range(rng.integers(1, 4)):
        array, i = places[rng.integers(len(places))]
        array[i] = rng.choice(_EXTREMES[drive.precision])


def _scale(visited: list[FloatArray]) -> FloatArray:
    stacked = np.abs(np.array(visited))
    stacked[~np.isfinite(stacked)] = 0.0
    largest: FloatArray = stacked.max(axis=0)
    return np.where(largest > 0, largest, 1.0)


def random_memory(rng: np.random.Generator, near: FloatArray, scale: FloatArray) -> FloatArray:
    """Return a memory around one that was visited; some entries far from it.

    Shapes: near (n_memory,), scale (n_memory,).
    """
    size = near.size
    base = np.where(np.isfinite(near), near, scale)
    close: FloatArray = base * (1.0 + 0.2 * rng.standard_normal(size))
    far: FloatArray = scale * rng.standard_normal(size) * 10.0 ** rng.uniform(-3, 3, size)
    choice = rng.random(size)
    kept: FloatArray = np.where(choice < 0.6, close, far)
    # Flags and counters hold whole numbers, and select branches.
    counted = rng.integers(0, 2 * np.minimum(np.abs(base), 1e6).astype(int) + 3)
    whole = (base == np.rint(base)) & (choice < 0.8)
    return np.where(rng.random(size) < 0.3, base, np.where(whole, counted, kept))
