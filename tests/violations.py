"""Runs in which an assumption is broken for a while, and what an observer said about them.

A case is an observer with its plant at rest near a point of operation. Many trials run side by
side: all start from the truth, one assumption is broken after `SETTLED` samples, then all hold
again. `broken` says at which instants something was, from the truth alone.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import sympy as sp

import obsynth as ob
from methods import METHODS, observer_of
from obsynth.codegen.kernel import Call, dense
from obsynth.designs.core.guard import HORIZON
from obsynth.evaluate.truth import Truth

KINDS = ("glitch", "drop-out", "excursion", "fault jump", "burst")
CALM = "calm"
"""Two trials in which nothing is broken: what the sets are like then."""
SETTLED, LATEST, SPARE = 150, 40, 150
"""Samples before anything is broken, further ones within which it begins, and may last."""
LENGTHS = (1, 1, 1, 2, 5, 10)
FLAGS = 2 | 4 | 8
"""Bits that say that something is wrong now. 16: there is no interval of the fault yet; 32: a
measurement was missing, which breaks nothing; 64: something was wrong before, and what breaks
meanwhile may go unnoticed."""


@dataclass(frozen=True, eq=False)
class Case:
    """What is simulated, every signal as a function of k (inputs of k and the healthy y).

    faults: (n_f,) half of the range in which faults jump
    constant: the guarantee speaks of constant faults
    means: forgetting rates where the fault's interval holds one of its discounted means
    """

    observer: ob.Observer
    truth: ob.Plant
    x0: Any
    inputs: Callable[[int, Any], Any]
    unknown: Callable[[int], Any] = lambda k: []
    scheduling: Callable[[int], Any] = lambda k: []
    faults: Any = ()
    constant: bool = False
    means: tuple[float, ...] = ()
    substeps: int | None = None
    memory: Mapping[str, Any] = field(default_factory=dict)

    @property
    def window(self) -> int:
        """The finite memory N: sets are right 2 N samples after the last violation."""
        return int(self.observer.record["options"].get("horizon") or HORIZON)


def tanks() -> Case:
    """The four tanks with peak bounds; the levels bear pump faults up to 4 V.

    With ellipsoids they are the table's entry of the bounded-error observer.
    """
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    observer = ob.BoundedErrorUIO(bounds="peak", horizon=HORIZON).design(plant)
    return Case(
        observer,
        plant,
        [170.0, 170, 52.5, 52.5],
        lambda k, y: [10 + np.sin(k / 50), 10 + np.cos(k / 80)],
        unknown=lambda k: [0.02 * np.sin(k / 40)],
        faults=[4.0, 4.0],
    )


def machine() -> Case:
    """A permanent-magnet machine whose load torque is unknown."""
    R = sp.Rational
    plant = ob.Plant("machine")
    i_d, i_q, w = plant.states("i_d i_q w", range=[(-10, 10), (-10, 10), (-300, 300)], nominal=0)
    u = plant.inputs("u_d u_q", range=(-200, 200), nominal=0)
    plant.actuator_faults("f", of=u[1], range=(-20, 20), rate=1000)
    (load,) = plant.unknown_inputs("load")
    n = plant.disturbances("n1:4", bound=[0.05, 0.05, 0.5])
    plant.dynamics(
        [
            (u[0] - R(3, 10) * i_d) / R(2, 1000) + 4 * w * i_q,
            (u[1] - R(3, 10) * i_q - R(4, 10) * w) / R(2, 1000) - 4 * w * i_d,
            (R(6, 10) * i_q - w / 1000 - load) * 1000,
        ]
    )
    plant.outputs([i_d + n[0], i_q + n[1], w + n[2]])
    plant = plant.discretise("euler", Ts=1e-4)
    return Case(
        ob.BoundedErrorUIO(bounds="peak", horizon=HORIZON).design(plant),
        plant,
        [0.0, 0.0, 50.0],
        lambda k, y: [0.2 * np.sin(k / 30), 20 + 2 * np.sin(k / 20)],
        unknown=lambda k: [0.5 * np.sin(k / 25)],
        faults=[20.0],
    )


def leaky_row() -> Case:
    """Two tanks in a row, both levels measured, with a leak."""
    plant = ob.Plant("leaky row")
    h1, h2 = plant.states("h1 h2", range=[(4, 40), (4, 40)], nominal=[9, 9], unit="cm")
    (v,) = plant.inputs("v", range=(0, 10), nominal=3, unit="V")
    (f,) = plant.process_faults("leak", range=(-0.3, 0.3), rate=0.03)
    w = plant.disturbances("w1:5", bound=[0.01, 0.01, 0.02, 0.02])
    plant.dynamics(
        [(v - sp.sqrt(h1)) / 4 + w[0], (sp.sqrt(h1) - sp.sqrt(h2)) / 4 - f + w[1]],
    )
    plant.outputs([h1 + w[2], h2 + w[3]])
    plant = plant.discretise("euler", Ts=1.0)
    return Case(
        ob.BoundedErrorUIO(bounds="peak", horizon=HORIZON).design(plant),
        plant,
        [16.0, 16.0],
        lambda k, y: [4 + np.sin(k / 20)],
        faults=[0.3],
    )


def of_method(name: str) -> Case:
    """The plant and the inputs of a method's entry in the table, at rest."""
    entry, observer = METHODS[name], observer_of(name)
    plant, scenario = entry.plant(), entry.scenario()
    if observer.record["options"].get("horizon") != HORIZON:
        observer = replace(entry.method, horizon=HORIZON).design(plant)
    arrays = scenario.arrays(plant, 0)
    given: Any = scenario.inputs
    law = given if scenario.feedback else lambda k, y: arrays["u"][k % (scenario.steps + 1)]
    half = 0.5 * np.ptp(plant.box("f"), axis=1)
    return Case(
        observer,
        plant,
        0.0 * scenario.x0 if name == "interval_observer" else scenario.x0,
        law,
        unknown=lambda k: 0.2 * arrays["d"][k % (scenario.steps + 1)],
        scheduling=lambda k: arrays["rho"][k % (scenario.steps + 1)],
        faults={"bounded_error_uio": [4.0, 4.0], "qpv_observer": [0.08]}.get(name, half),
        constant=name in ("set_adaptive_observer", "qpv_observer"),
        means=tuple(observer.record["filters"]) if name == "filter_bank" else (),
        memory={"f_range": plant.box("f")} if name == "set_adaptive_observer" else {},
        substeps=None if observer.ode is None and plant.Ts is not None else 2,
    )


CASES: dict[str, Callable[[], Case]] = {
    **{name: functools.partial(of_method, name) for name in METHODS},
    "four tanks, peak": tanks,
    "machine": machine,
    "leaky row": leaky_row,
}


@functools.cache
def case_of(name: str) -> Case:
    """The case, designed once."""
    return CASES[name]()


@dataclass(frozen=True, eq=False)
class Trials:
    """What is broken in B trials over K samples.

    glitch: (K, B, m) added to y, nan where it is missing
    shift: (K, B, n) where a state is forced to, nan elsewhere
    fault: (K, B, n_f), noise: (K, B, n_w)
    """

    kinds: tuple[str, ...]
    glitch: Any
    shift: Any
    fault: Any
    noise: Any


def trials(case: Case, count: int, seed: int = 1000) -> Trials:
    """Return `count` trials of each kind that the plant knows, the same for the same seed."""
    model = case.truth
    n, m, n_f, n_w = (len(s) for s in (model.x, model.output_names, model.f, model.w))
    bound = np.abs(model.box("w")).max(axis=1)
    finite = np.isfinite(bound)
    kinds = [k for k in KINDS if (k != "fault jump" or n_f) and (k != "burst" or finite.any())]
    labels = (*(kind for kind in kinds for _ in range(count)), CALM, CALM)
    K, B = SETTLED + LATEST + 2 * case.window + SPARE, len(labels)
    C = np.abs(_gain_of_noise(case))
    size = np.maximum(C @ np.where(finite, bound, 0.0), 1e-3)
    box = model.box("x")
    glitch, shift = np.zeros((K, B, m)), np.full((K, B, n), np.nan)
    fault, noise = np.zeros((K, B, n_f)), np.zeros((K, B, n_w))
    for b, kind in enumerate(labels):
        rng = np.random.default_rng(seed + b)
        reach = np.where(finite, bound, 0.1)
        noise[:, b] = rng.uniform(-1, 1, (K, n_w)) * reach
        start, length = SETTLED + int(rng.integers(LATEST)), int(rng.choice(LENGTHS))
        during = slice(start, start + length)
        sign = rng.choice([-1.0, 1.0])
        if kind == "glitch":
            i = rng.integers(m)
            power = rng.uniform(0, 20) if rng.random() < 0.3 else rng.uniform(-2, 2)
            glitch[during, b, i] = sign * 10 * size[i] * 10**power
        elif kind == "drop-out":
            missing = rng.random((3 * length, m)) < 0.5
            glitch[start : start + 3 * length, b][missing] = np.nan
        elif kind == "excursion":
            j = rng.choice(np.flatnonzero(np.isfinite(box).all(axis=1)))
            away = rng.uniform(0.05, 1.0) * np.ptp(box[j])
            shift[during, b, j] = _beyond(case, int(j), away, sign)
            shift[start + length, b, j] = np.inf  # back to where it was
        elif kind == "fault jump":
            j = rng.integers(n_f)
            fault[start:, b, j] = sign * rng.uniform(0.1, 0.9) * np.asarray(case.faults)[j]
        elif kind == "burst":
            i = rng.choice(np.flatnonzero(finite))
            noise[during, b, i] = sign * bound[i] * 10 ** rng.uniform(0.3, 2)
    return Trials(labels, glitch, shift, fault, noise)


def _beyond(case: Case, j: int, away: float, sign: float) -> float:
    """Return a value of state j outside its range, on a side where the equations give numbers."""
    function = Truth(case.truth, case.observer, case.substeps).function
    low, high = case.truth.box("x")[j]
    value = high + away if sign > 0 else low - away
    x = np.array(case.x0, dtype=float)
    x[j] = value
    zeros = [np.zeros(function.numel_in(i)) for i in range(1, 6)]
    return value if np.isfinite(np.array(function(x, *zeros)[0])).all() else high + away


def _gain_of_noise(case: Case) -> Any:
    model = case.truth
    rows = sp.Matrix(model.output).jacobian([s.symbol for s in model.w]) if len(model.w) else None
    m = len(model.output_names)
    return np.zeros((m, 0)) if rows is None else np.array(rows, dtype=float)


@dataclass(frozen=True, eq=False)
class Record:
    """What was true and what was said: (K, B, ...) each.

    age: (K, B), calls over which a mean of the fault goes back, where the fault's set holds one
    """

    x: Any
    f: Any
    status: Any
    x_lower: Any
    x_upper: Any
    f_lower: Any
    f_upper: Any
    broken: Any
    age: Any = None


def record(case: Case, given: Trials) -> Record:
    """Run all trials, truth and observer."""
    model, observer = case.truth, case.observer
    K, B, m = given.glitch.shape
    truth = Truth(model, observer, case.substeps).function
    plant, step = Call(dense(truth).map(B)), Call(dense(observer.step).map(B))
    sizes = [truth.numel_in(i) for i in range(6)]
    x, u, d, f, w, rho = (a.reshape(B, s) for a, s in zip(plant.args, sizes, strict=True))
    following, y = plant.results[0].reshape(B, -1), plant.results[1].reshape(B, m)
    measured = [i for i, s in enumerate(model.rho) if s.measured]
    n_memory = observer.step.numel_in(0)
    memory, told_u, told_y = (a.reshape(B, -1) for a in step.args[:3])
    said = [result.reshape(B, -1) for result in step.results]
    x[:] = case.x0
    home = x.copy()
    logs: list[list[Any]] = [[] for _ in range(7)]
    ages = []
    for k in range(K):
        forced = given.shift[k]
        out = np.isfinite(forced)
        home[~out] = x[~out]
        x[out] = forced[out]
        d[:], rho[:], f[:], w[:] = case.unknown(k), case.scheduling(k), given.fault[k], 0.0
        w[:] = given.noise[k]
        plant.evaluate()
        for b in range(B):
            u[b] = case.inputs(k, y[b])
        plant.evaluate()
        if k == 0:
            near = np.column_stack([x[0] - 1e-6, x[0] + 1e-6])
            first = observer.memory0(x[0], x_range=near, y0=y[0], **case.memory)
            memory[:] = np.asarray(first, dtype=float).reshape(1, n_memory)
        told_u[:], told_y[:] = u, y + given.glitch[k]
        if len(step.args) > 3:
            step.args[3].reshape(B, -1)[:] = rho[:, measured]
        step.evaluate()
        ages.append(_age(case, memory))
        values = (x, f, said[7], *said[3:7])
        for log, value in zip(logs, values, strict=True):
            log.append(value.copy())
        memory[:] = said[0]
        # a state that was forced goes back to where it was when that ends
        back = np.isinf(given.shift[k + 1]) if k + 1 < K else np.zeros_like(out)
        following_x = following.copy()
        following_x[back] = home[back]
        x[:] = following_x
    arrays = [np.array(log) for log in logs]
    arrays[2] = arrays[2][:, :, 0].astype(np.int64)
    return Record(*arrays, broken=broken(case, given, arrays[0], arrays[1]), age=np.array(ages))


def _age(case: Case, memory: Any) -> Any:
    """Return (B,): how many calls the mean in the fault's set goes back, from its response."""
    if not case.means:
        return np.zeros(len(memory), dtype=int)
    layout, rate = case.observer.memory_layout, case.means[0]
    response = memory[:, layout["response"]][:, 0] * (memory[:, layout["begin"]][:, 0] < 0.5)
    full = case.observer.record["gain"][0] / rate
    return np.rint(-np.log1p(-response / full) / (rate * case.observer.model.Ts)).astype(int)


def broken(case: Case, given: Trials, x: Any, f: Any) -> Any:
    """Return (K, B): an assumption fails at an instant, or in the transition that leads to it."""
    model = case.truth
    K, B, _ = x.shape
    found = np.zeros((K, B), dtype=bool)
    box = model.box("x")
    found |= (~((x >= box[:, 0]) & (x <= box[:, 1]))).any(axis=2)
    found |= (np.nan_to_num(given.glitch) != 0).any(axis=2)
    found |= (~np.isnan(given.shift)).any(axis=2)
    ranges = model.box("f")
    found |= ((f < ranges[:, 0]) | (f > ranges[:, 1])).any(axis=2)
    wide = model.box("w")
    out = (given.noise < wide[:, 0]) | (given.noise > wide[:, 1])
    seen = (_gain_of_noise(case) != 0).any(axis=0)
    found |= out[:, :, seen].any(axis=2)
    symbols = [s.symbol for s in model.w]
    moves = np.array([any(row.has(s) for row in model.rhs) for s in symbols], dtype=bool)
    found[1:] |= out[:-1][:, :, moves].any(axis=2)
    rates = np.array([np.inf if s.rate is None else float(s.rate) for s in case.observer.model.f])
    limit = np.zeros(len(rates)) if case.constant else rates
    found[1:] |= (np.abs(np.diff(f, axis=0)) > limit * (1 + 1e-9)).any(axis=2)
    return found


@dataclass(frozen=True)
class Count:
    """Samples of one kind with status 0 and a set that misses the truth.

    unbroken: before anything was broken, or where nothing ever was
    after: from the first flag at or after the violation's end
    late: more than 2 N samples after its end
    before: until that flag; never: in trials without one
    longest: the last such sample after the violation's end
    recovery: samples from its end until the status stays 0 and no set is 1.1 times as wide as
    in calm trials, median and largest over the trials in which something was broken or missing
    lasting: trials in which the violation does not end, which count for nothing
    """

    trials: int
    unbroken: int
    after: int
    late: int
    before: int
    never: int
    longest: int
    flagged: int
    recovery: tuple[float, int]
    lasting: int


def missed(case: Case, seen: Record) -> Any:
    """Return (K, B): some set misses the truth, or a bound is no number."""
    late, good_f = case.observer.fault_delay, np.zeros(seen.f.shape, dtype=bool)
    for f in [_mean(case, seen, rate) for rate in case.means] or [seen.f]:
        f = np.roll(f, late, axis=0)
        good_f |= (seen.f_lower <= f) & (f <= seen.f_upper)
    good_f[:late] = True
    good = ((seen.x_lower <= seen.x) & (seen.x <= seen.x_upper)).all(axis=2) & good_f.all(axis=2)
    return ~good


def _mean(case: Case, seen: Record, rate: float) -> Any:
    """Return (K, B, n_f): means since the sets began, the fault itself where they just did."""
    f = seen.f
    later = np.exp(rate * case.observer.model.Ts * np.arange(len(f)))[:, None, None]
    sums = np.concatenate([np.zeros_like(f[:1]), np.cumsum(later * f, axis=0)])
    weights = np.concatenate([np.zeros((1, 1, 1)), np.cumsum(later, axis=0)])
    k, b = np.arange(len(f))[:, None], np.arange(f.shape[1])
    gone = weights[k, 0] - weights[k - seen.age, 0]
    mean = (sums[k, b] - sums[k - seen.age, b]) / np.where(gone > 0.0, gone, 1.0)
    return np.where(gone > 0.0, mean, f)


def counted(case: Case, given: Trials, seen: Record) -> dict[str, Count]:
    """Count by kinds."""
    wrong = missed(case, seen) & (seen.status == 0)
    flags = (seen.status & FLAGS) != 0
    width = np.concatenate([seen.x_upper - seen.x_lower, seen.f_upper - seen.f_lower], axis=2)
    calm = [b for b, label in enumerate(given.kinds) if label == CALM]
    wide = 1.1 * width[SETTLED:, calm].max(axis=(0, 1))
    poor = (~(width <= wide)).any(axis=2) | (seen.status != 0)
    found = {}
    for kind in dict.fromkeys(given.kinds):
        tally = dict.fromkeys(("unbroken", "after", "late", "before", "never", "flagged"), 0)
        longest, recovery, lasting = 0, [], 0
        chosen = [b for b, label in enumerate(given.kinds) if label == kind]
        for b in chosen:
            at, bad = np.flatnonzero(seen.broken[:, b]), np.flatnonzero(wrong[:, b])
            if not at.size:  # a missing measurement breaks nothing, but widens the sets
                tally["unbroken"] += bad.size
                at = np.flatnonzero(np.isnan(given.glitch[:, b]).any(axis=1))
                if not at.size:
                    continue
                recovery.append(int(np.flatnonzero(poor[at[-1] :, b]).max(initial=-1)) + 1)
                continue
            start, end = int(at[0]), int(at[-1])
            if end + 2 * case.window + 10 > len(wrong):
                lasting += 1
                continue
            tally["unbroken"] += int((bad < start).sum())
            tally["late"] += int((bad > end + 2 * case.window).sum())
            flag = end + np.flatnonzero(flags[end:, b])
            bad = bad[bad >= start]
            if flag.size:
                tally["flagged"] += 1
                tally["after"] += int((bad >= flag[0]).sum())
                tally["before"] += int((bad < flag[0]).sum())
            else:
                tally["never"] += bad.size
            longest = max(longest, int((bad - end).max(initial=0)))
            recovery.append(int(np.flatnonzero(poor[at[-1] :, b]).max(initial=-1)) + 1)
        middle = float(np.median(recovery)) if recovery else 0.0
        found[kind] = Count(
            len(chosen),
            **tally,
            longest=longest,
            recovery=(middle, max(recovery, default=0)),
            lasting=lasting,
        )
    return found


def campaign(name: str, count: int, seed: int = 1000) -> dict[str, Count]:
    """Run `count` trials of each kind for one case."""
    case = case_of(name)
    given = trials(case, count, seed)
    return counted(case, given, record(case, given))
