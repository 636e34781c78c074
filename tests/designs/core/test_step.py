"""What a step makes of a core: when it begins anew, which of its sets count, what is told of it."""

from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from contracted import made

import obsynth as ob
from obsynth.designs.core.boxes import FAR, Ends
from obsynth.designs.core.core import Core, Known
from obsynth.designs.core.guard import YOUNG, Guard, Watch
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import all_finite, clip, extended, fill, largest_level

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
        given = {"horizon": horizon, "recovery": 2, "cuts": cuts, "precision": precision}
        watch = Watch.of(given)
        sizes = {"count": 1, **dict.fromkeys(shared, 1)}
        self.guard = Guard(self.plant, sizes, watch, delay, 1.0, shared)
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

    return Core(run, begin, place=lambda x, f, kept: {"z": x.middle()})


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


def test_where_both_begin_the_older_sets_place_the_estimate():
    """They know more. An input above a half is what ends both copies. Mutant: the younger's."""
    plant = ob.Plant("hidden")
    a, b = plant.states("a b", range=[(-4, 4), (-9, 9)])
    (u,) = plant.inputs("u", range=(-1, 1))
    (v,) = plant.disturbances("v", bound=0.1)
    plant.dynamics([sp.sin(a) / 2 + a * b / 10**6 + u**2 / 10**6, b - b**3 / 10**6], Ts=1)
    plant.outputs([a + v])

    def run(seen):
        return Known(seen.memory["z"], ca.SX(0, 1), None, None, seen.memory, seen.u[0] < 0.5)

    core = Core(run, lambda x, f, kept: {}, place=lambda x, f, kept: {"z": x.middle()})
    watch = Watch.of({"horizon": HORIZON, "recovery": 2, "cuts": None})
    guard = Guard(plant, {"z": 2}, watch, 0, 1.0, shared=("z",))
    step, first = Step(guard, core).build(), np.array([[-0.1, 0.1], [1.9, 2.1]])
    memory, told = fill(guard.layout(), guard.first({"z": [0, 0]}, first, np.zeros((0, 2)))), None
    for k in range(HORIZON + 4):
        told = step(memory, float(k == HORIZON + 2), 0.0)
        memory = told[0]
    assert float(told[1][1]) == pytest.approx(2.0, abs=1e-3)


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


# -- parts -------------------------------------------------------------------------------------


def test_a_right_hand_side_moves_both_copies_and_nothing_of_the_guard():
    """And nothing at all before the start. Mutants: a copy that stands still, or everything."""
    own = ca.SX.sym("m", 3)
    ode = ca.Function(
        "ode", [own, ca.SX.sym("u", 1)], [ca.vertcat(2, 3, 5) * own], ["memory", "u"], ["d"]
    )
    sizes = {"p": 2, "q": 1}
    parts = {"p": 2, "q": 1, "p_2": 2, "begin": 1, "age": 1, "initialised": 1}
    ends = np.cumsum([0, *parts.values()]).tolist()
    layout = {name: slice(a, b) for name, a, b in zip(parts, ends, ends[1:], strict=False)}
    whole = extended(ode, sizes, layout, "_2")
    moved = np.array(whole([1, 10, 100, 7, 8, 9, 9, 1], 0)).ravel().tolist()
    assert moved == [2, 30, 500, 2, 30, 0, 0, 0]
    assert not np.array(whole([1, 10, 100, 7, 8, 9, 9, 0], 0)).any()


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e200])
def test_one_entry_that_is_no_number_is_seen_wherever_it_stands(place, bad):
    v = ca.SX.sym("v", 3)
    function, given = ca.Function("f", [v], [all_finite(v, 1e90)]), [1.0, -2.0, 1e80]
    assert float(function(given)) == 1.0
    given[place] = bad
    assert float(function(given)) == 0.0


def test_the_nearest_point_of_a_box_with_ends_that_do_not_bind():
    v = ca.SX.sym("v", 4)
    box = np.array([[-1.0, 2.0], [-np.inf, 2.0], [-1.0, np.inf], [-np.inf, np.inf]])
    function = ca.Function("f", [v], [clip(v, box)])
    assert np.array(function([5.0] * 4)).ravel().tolist() == [2.0, 2.0, 5.0, 5.0]
    assert np.array(function([-5.0] * 4)).ravel().tolist() == [-1.0, -5.0, -1.0, -5.0]
    assert np.array(function([0.5] * 4)).ravel().tolist() == [0.5] * 4


@pytest.mark.parametrize("size", [3, 14, 15, 20])
def test_the_largest_level_is_not_below_that_of_any_point(size):
    """Against rationals, at corners or by the sum of sizes. Mutant: its rounding subtracted."""
    rng = np.random.default_rng(size)
    root = rng.uniform(0.1, 1.0, (size, size))
    P, low, high = root @ root.T, -rng.uniform(0.1, 1.0, size), rng.uniform(0.1, 1.0, size)
    found = Fraction(largest_level(P, low, high))
    reach = [max(Fraction(b), -Fraction(a)) for a, b in zip(low, high, strict=True)]
    sums = [sum(Fraction(P[i, j]) * reach[j] for j in range(size)) for i in range(size)]
    most = sum(r * s for r, s in zip(reach, sums, strict=True))
    # all entries are positive: the level is that of the upper corner, or of the lower one
    corners = [[Fraction(v) for v in end] for end in (low, high)]
    levels = [
        sum(c[i] * Fraction(P[i, j]) * c[j] for i in range(size) for j in range(size))
        for c in corners
    ]
    assert max(levels) <= found <= most * (1 + Fraction(1, 2**39))
    assert size <= 14 or found >= most
