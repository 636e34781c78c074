"""What a step makes of a core: when it begins anew, which of its sets count, what is told of it."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from contracted import made

import obsynth as ob
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.core import Core, Known
from obsynth.designs.core.guard import YOUNG, Guard, Watch
from obsynth.designs.core.lifted import FAR
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import fill

HORIZON = 6
OUTPUTS = ("memory", "xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status")


def tank():
    """A state that is measured, with a fault; an input that enters in no constant way."""
    plant = ob.Plant("tank")
    (a,) = plant.states("a", range=(-4, 4))
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.process_faults("f", range=(-1, 1), rate=0.1)
    w, v = plant.disturbances("w v", bound=[0.01, 0.1])
    plant.dynamics([sp.sin(a) / 2 + u**2 / 8 + f / 2 + w], Ts=1)
    plant.outputs([a + v])
    return plant


def interval(low, high):
    return Ends(ca.SX(low), ca.SX(high))


def counting(f=None, x=None, mean=False, bridges=False, **told):
    """A core whose memory counts its calls since it began; sets and words are functions of it."""

    def run(seen):
        count = seen.memory["count"] + 1.0
        words = {name: given(count, seen) for name, given in told.items()}
        sets = (None if given is None else given(count) for given in (x, f))
        return Known(ca.SX(0.5), ca.SX(0.25), *sets, {"count": count}, **words)

    def begin(x, f, kept):
        return {"count": ca.SX(0.0)}

    return Core(run, begin, bridges=bridges, mean_fault=mean)


class Calls:
    """A step over a core, called with numbers; `count` is of the older copy."""

    def __init__(
        self, core, plant=None, delay=0, cuts=None, horizon=HORIZON, shared=(), precision="double"
    ):
        self.plant = tank() if plant is None else plant
        watch = Watch.of({"horizon": horizon, "recovery": 2, "cuts": cuts})
        sizes = {"count": 1, **dict.fromkeys(shared, 1)}
        self.guard = Guard(self.plant, sizes, watch, delay, 1.0, precision, shared)
        self.step = Step(self.guard, core).build()
        self.layout = self.guard.layout()
        parts = self.guard.first({"count": [0.0]}, self.plant.box("x"), self.plant.box("f"))
        self.memory = fill(self.layout, parts)

    def __call__(self, y=0.0, u=0.0, *theta):
        values = self.step(self.memory, u, y, *theta)
        told = dict(zip(OUTPUTS, (np.array(v).ravel() for v in values), strict=True))
        self.memory = told["memory"]
        self.count, self.young = (
            self.memory[self.layout[n]][0] for n in ("count", "count" + YOUNG)
        )
        self.status = int(told["status"][0])
        self.f = [told["f_lower"][0], told["f_upper"][0]]
        self.x = [told["x_lower"][0], told["x_upper"][0]]
        self.xhat, self.fhat = told["xhat"][0], told["fhat"][0]
        return self


def estimating():
    """A core that also keeps an estimate, placed in the middle of a box."""

    def run(seen):
        moved = {"count": seen.memory["count"] + 1.0, "z": seen.memory["z"]}
        return Known(seen.memory["z"], ca.SX(0.0), None, None, moved)

    def begin(x, f, kept):
        return {"count": kept["z"]}

    return Core(run, begin, place=lambda x, f, kept: {"z": x.middle})


def counts(calls, given):
    return [calls(*g).count for g in given]


GOOD = (0.0, 0.0)


@pytest.mark.parametrize(
    ("bad", "status"),
    [((np.nan, 0.0), 32), ((0.0, np.nan), 2), ((0.0, 1.5), 4), ((99.0, 0.0), 8 + 32)],
)
def test_a_core_begins_anew_after_what_breaks_its_chain(bad, status):
    """A missing reading, an input that is missing or outside of its range, a void instant.

    Mutants: the core goes on; one copy of two begins anew; an input of any size.
    """
    calls = Calls(counting(), horizon=400)
    assert counts(calls, [GOOD] * 3) == [1, 2, 3]
    calls(*bad)
    assert calls.status == status
    calls(*GOOD)
    assert calls.count == calls.young == 1
    assert calls(*GOOD).count == 2


def test_an_input_at_its_ends_is_covered():
    calls = Calls(counting())
    assert [calls(0.0, u).status for u in (1.0, -1.0, 1.0000001, -1.0000001)] == [0, 0, 4, 4]


def test_a_core_that_bridges_gaps_goes_on():
    calls = Calls(counting(bridges=True), horizon=400)
    assert counts(calls, [GOOD, (np.nan, 0.0), GOOD]) == [1, 2, 3]


def test_copies_take_turns():
    """The younger begins every N calls and takes over at the age of 2 N. Mutant: never."""
    calls, found = Calls(counting()), []
    for _ in range(4 * HORIZON):
        calls()
        found.append((calls.count, calls.young))
    N = HORIZON
    # what is stored at the age of 2 N is the younger copy's
    old = [*range(1, 2 * N), *[N + k % N for k in range(2 * N + 1)]]
    assert [c for c, _ in found] == old
    assert [y for _, y in found][N:] == [1 + k % N for k in range(3 * N)]


def test_an_estimate_is_placed_where_both_copies_begin():
    """And each is begun around it. Mutants: never placed; placed where one copy begins."""
    calls = Calls(estimating(), shared=("z",), cuts=["ranges", "strips"])
    calls(1.0)
    assert (calls.xhat, calls.count) == pytest.approx((1.0, 2.0))
    told = [(calls(0.5).xhat, calls.young) for _ in range(HORIZON)]
    assert [xhat for xhat, _ in told] == pytest.approx([1.0] * HORIZON)
    assert told[-1][1] == pytest.approx(2.0), "begun around the estimate"
    calls(99.0)
    assert calls(-0.5).xhat == pytest.approx(-0.5)


def test_an_unsound_memory_and_an_endless_set_begin_anew():
    """Mutants: soundness not asked; the width not looked at."""
    unsound = Calls(counting(sound=lambda count, _: count < 2.5), horizon=400)
    assert counts(unsound, [GOOD] * 6) == [1, 2, 3, 1, 2, 3]
    endless = Calls(counting(x=lambda count: interval(-FAR, ca.if_else(count < 1.5, 1.0, FAR))))
    assert counts(endless, [GOOD] * 4) == [1, 1, 1, 1]
    wide = Calls(counting(x=lambda count: interval(-1e40, 1e40)))
    assert counts(wide, [GOOD] * 3) == [1, 2, 3]


def test_sets_of_a_core_count_where_it_was_told():
    """Without the reading that it needs nothing of it is used. Mutants: its x, or f, used."""
    core = counting(x=lambda _: interval(-0.01, 0.02), f=lambda _: interval(0.3, 0.4))
    calls = Calls(core, cuts=["ranges"])
    assert (calls().x, calls.f) == ([-0.01, 0.02], [0.3, 0.4])
    assert (calls.xhat, calls.fhat) == (0.02, 0.3), "the nearest points to its estimates"
    assert (calls(np.nan).x, calls.f) == ([-4, 4], [-1, 1])
    assert (calls.xhat, calls.fhat) == (0.0, 0.0), "the middle of the sets"


@pytest.mark.parametrize("mean", [False, True])
def test_a_fault_is_carried_by_its_rate_and_a_mean_is_not(mean):
    """Mutants: a mean carried on as the fault itself; the fault not carried."""

    def f(count):
        told = count < 1.5
        return interval(ca.if_else(told, 0.2, -FAR), ca.if_else(told, 0.3, FAR))

    calls = Calls(counting(f=f, mean=mean), cuts=["ranges", "rates"], horizon=400)
    assert calls().f == [0.2, 0.3]
    assert calls().f == pytest.approx([-1.0, 1.0] if mean else [0.1, 0.4])
    assert calls().f == pytest.approx([-1.0, 1.0] if mean else [0.0, 0.5])


@pytest.mark.parametrize("mean", [False, True])
def test_means_over_two_memories_are_not_cut_with_each_other(mean):
    """They need not have anything in common; two bounds of one fault do."""

    def f(count):
        late = count > HORIZON - 0.5
        return interval(ca.if_else(late, 0.5, -1.0), ca.if_else(late, 1.0, -0.5))

    calls = Calls(counting(f=f, mean=mean), cuts=["ranges"])
    told = [(calls().status & 8, calls.f) for _ in range(HORIZON + 1)]
    assert told[0] == (0, [-1.0, -0.5])
    assert told[HORIZON - 1][1] == [0.5, 1.0] or not mean
    assert told[HORIZON] == ((0, [0.5, 1.0]) if mean else (8, [-1.0, 1.0]))


def test_a_fault_one_call_late():
    """Nothing is known of it at the first call. Mutants: the core's set at once, or never."""
    core = counting(f=lambda _: interval(0.3, 0.4))
    calls = Calls(core, delay=1, cuts=["ranges"])
    assert (calls().f, calls.status) == ([-1.0, 1.0], 16)
    assert (calls().f, calls.status) == ([0.3, 0.4], 0)
    # without its own reading a core says nothing; the inversion does
    assert calls(np.nan).f == [-1.0, 1.0]
    inverted = Calls(counting(), delay=1, horizon=400)
    inverted(0.0), inverted(0.0)
    # a' = sin(a) / 2 + f / 2 + w with a and a' within .1
    assert inverted.f == pytest.approx([-0.32, 0.32], abs=2e-3)
    assert inverted(0.05).f == pytest.approx([-0.22, 0.42], abs=2e-3)


@pytest.mark.parametrize("told", [True, False])
def test_a_core_that_contradicts_its_readings_is_void(told):
    """If it was told them. Mutant: void without a reading."""
    calls = Calls(counting(empty=lambda count, _: count > 1.5))
    assert calls().status == 0
    assert calls(0.0 if told else np.nan).status == (8 if told else 32)


def test_words_of_a_core_reach_the_status():
    """Outside of its domain (4), but not where that is void; a fault that is not valid (16)."""
    words = {"outside": lambda count, _: count > 1.5, "valid": lambda count, _: count < 2.5}
    core = counting(f=lambda _: interval(-1.0, 1.0), **words)
    calls = Calls(core, horizon=400)
    assert [calls().status for _ in range(3)] == [0, 4, 4 + 16]
    assert calls(99.0).status & 4 == 0


def test_declared_ranges_are_numbers_of_the_precision_outside_of_what_is_declared():
    """Mutant: ends that single precision rounds inwards."""
    plant = ob.Plant("tenths")
    (a,) = plant.states("a", range=(-0.7, 0.1))
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.process_faults("f", range=(-0.1, 0.7), rate=0.1)
    (v,) = plant.disturbances("v", bound=0.1)
    plant.dynamics([sp.sin(a) / 2 + f / 2 + u / 8], Ts=1)
    plant.outputs([a + v])
    calls = Calls(counting(), plant, precision="single")
    calls()
    assert calls(99.0).status & 8
    for ends, (low, high) in ((calls.x, (-0.7, 0.1)), (calls.f, (-0.1, 0.7))):
        assert ends == np.array(ends).astype(np.float32).astype(float).tolist()
        assert ends[0] < low and ends[1] > high
        assert ends == pytest.approx([low, high], rel=1e-6)


def test_recovering_lasts_as_many_calls_as_is_said():
    calls = Calls(counting())
    assert [calls(y).status & 64 for y in (0, 99, 0, 0, 0)] == [0, 0, 64, 64, 0]


def test_scheduling_outside_of_its_range_or_missing():
    """Its middle takes its place where it is no number, and the sets begin anew."""
    none = Core(
        lambda seen: Known(*map(ca.SX.zeros, (2, 2)), None, None, {"count": seen.memory["count"]}),
        lambda x, f, kept: {"count": ca.SX(0.0)},
    )
    calls = Calls(none, made("gains"))
    before = calls.layout["before"]
    for theta, status, used in ((0.5, 0, 0.5), (1.1, 4, 1.1), (-0.1, 4, -0.1), (np.nan, 2, 0.5)):
        calls([np.nan, np.nan], 1.0, theta)
        assert calls.status == 32 + status
        assert calls.memory[before].tolist() == [1.0, used]
