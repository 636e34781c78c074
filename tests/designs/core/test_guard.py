"""The guard over a core without sets: what is void, forgotten, left out, and returned."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from contracted import by_hand, made

import obsynth as ob
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.contractor import CUTS
from obsynth.designs.core.core import Core, Known
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.guard import MOST_CALLS, YOUNG, Guard, Watch, monitored
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import fill

HORIZON, RECOVERY = 7, 3


HIDDEN = sp.Rational(1, 10**6)


def drifting():
    """A measured state, and one that the measurements hardly feel and that never forgets."""
    plant = ob.Plant("drifting")
    a, b = plant.states("a b", range=[(-10, 10), (-10, 10)])
    (u,) = plant.inputs("u", range=(-1, 1))
    w, v = plant.disturbances("w v", bound=[0.01, 0.1])
    plant.dynamics([sp.sin(a) / 2 + HIDDEN * b * a + u / 2 + w, b - b**3 / 10**6], Ts=1)
    plant.outputs([a + v])
    return plant


def blind(n_f=0):
    """A core that knows nothing and whose estimate is zero."""

    def run(seen):
        return Known(ca.SX.zeros(2), ca.SX.zeros(n_f), None, None, {})

    return Core(run, lambda x, f, kept: {})


class Watched:
    """A step over the blind core, called with numbers."""

    def __init__(self, plant, horizon=HORIZON, cuts=None, core=None):
        options = {"horizon": horizon, "recovery": RECOVERY, "cuts": cuts}
        self.plant = plant
        self.guard = Guard(plant, {}, Watch.of(options), 0, 1.0)
        self.step = Step(self.guard, blind() if core is None else core).build()
        self.layout = self.guard.layout()
        self.rhs = plant.function()

    def start(self, box):
        parts = self.guard.first({}, np.array(box, dtype=float), np.zeros((0, 2)))
        return fill(self.layout, parts)

    def call(self, memory, u, y):
        values = [np.array(v).ravel() for v in self.step(memory, u, y)]
        return values[0], values[3], values[4], int(values[7][0])

    def move(self, x, u, w):
        none = np.zeros(0)
        return np.array(self.rhs(x, u, none, none, w, none, none)[0]).ravel()


def holds(lower, upper, x):
    return bool(np.all(lower <= x) and np.all(x <= upper))


def march(watched, x, box, steps, jump=None, reading=None, seed=0):
    """Run plant and step; `jump` (k, value) moves the hidden state, `reading` (k, value) y."""
    rng, memory, told = np.random.default_rng(seed), watched.start(box), []
    for k in range(steps):
        if jump is not None and jump[0] == k:
            x = np.array([x[0], jump[1]])
        w = rng.uniform([-0.01, -0.1], [0.01, 0.1])
        u, y = [np.sin(0.3 * k)], x[0] + w[1]
        if reading is not None and reading[0] == k:
            y = reading[1]
        memory, lower, upper, status = watched.call(memory, u, [y])
        told.append((holds(lower, upper, x), status, lower, upper))
        x = watched.move(x, u, w)
    return told


def test_sets_hold_the_truth_while_the_assumptions_do():
    watched = Watched(drifting())
    for seed in range(5):
        told = march(watched, np.array([0.3, 2.0]), [(-1, 1), (1.9, 2.1)], 60, seed=seed)
        assert all(inside and status == 0 for inside, status, *_ in told)
    # the hidden state is remembered until the first copy is given up
    widths = [upper[1] - lower[1] for *_, lower, upper in told]
    assert max(widths[: 2 * HORIZON]) < 0.3 < widths[2 * HORIZON]


def test_an_unnoticed_violation_is_forgotten_after_two_horizons():
    """Mutants: the younger copy never begun anew; given up after 3 N."""
    watched = Watched(drifting())
    jump = 5
    told = march(watched, np.array([0.3, 2.0]), [(-1, 1), (1.9, 2.1)], 60, jump=(jump, -7.0))
    wrong = [k for k, (inside, *_) in enumerate(told) if not inside]
    assert all(status == 0 for _, status, *_ in told), "nothing contradicts the readings"
    assert wrong
    assert min(wrong) == jump
    assert max(wrong) <= jump + 2 * HORIZON
    never = march(
        Watched(drifting(), 10**6),
        np.array([0.3, 2.0]),
        [(-1, 1), (1.9, 2.1)],
        60,
        jump=(jump, -7.0),
    )
    assert not never[-1][0]


def test_the_age_is_below_two_horizons_and_both_copies_begin_apart():
    watched = Watched(drifting())
    memory, ages, begun = watched.start([(-1, 1), (-1, 1)]), [], []
    for _ in range(5 * HORIZON):
        memory, *_ = watched.call(memory, [0.0], [0.0])
        ages.append(memory[watched.layout["age"]].item())
        begun.append(memory[watched.layout["begin" + YOUNG]].item() > 0.5)
    assert max(ages) == 2 * HORIZON - 1
    assert [k + 1 for k, fresh in enumerate(begun) if fresh] == [HORIZON * i for i in range(1, 6)]


def test_an_impossible_reading_is_void_and_what_came_before_is_forgotten():
    """Mutant: sets kept over a void instant."""
    watched = Watched(drifting())
    followed = []
    for b in (2.0, -3.0):
        told = march(
            watched, np.array([0.3, b]), [(-1, 1), (b - 0.1, b + 0.1)], 20, reading=(9, 1e6)
        )
        inside, status, lower, upper = told[9]
        assert inside
        assert status == 8 + 32
        assert lower.tolist() == [-10, -10]
        assert upper.tolist() == [10, 10]
        assert [status for _, status, *_ in told[10:14]] == [64] * RECOVERY + [0]
        followed.append(told[10][2:])
    # the instant after knows the reading of that instant alone
    for one, other in zip(*followed, strict=True):
        assert one[1] == other[1]
        assert abs(one[0]) < 10


def test_a_set_without_a_point_is_void():
    watched = Watched(drifting())
    told = march(watched, np.array([0.3, 2.0]), [(-1, 1), (1.9, 2.1)], 20, reading=(9, 5.0))
    assert told[9][1] == 8
    assert [status for _, status, *_ in told[10:14]] == [64] * RECOVERY + [0]
    assert told[9][0]


@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf, 1e200])
def test_a_missing_reading_costs_its_strip_only(missing):
    watched = Watched(drifting())
    box = [(-1, 1), (1.9, 2.1)]
    told = march(watched, np.array([0.3, 2.0]), box, 20, reading=(9, missing))
    assert told[9][1] == 32
    assert all(inside for inside, *_ in told)
    assert np.all(told[9][3] - told[9][2] < 0.3)
    assert [status for _, status, *_ in told[10:]] == [0] * 10


def test_a_declared_range_leaves_a_reading_out_and_nothing_else():
    plant = ob.Plant("declared")
    a, b = plant.states("a b", range=[(-10, 10), (-10, 10)])
    (u,) = plant.inputs("u", range=(-1, 1))
    w, v = plant.disturbances("w v", bound=[0.01, 0.1])
    plant.dynamics([sp.sin(a) / 2 + u / 2 + w, b / 2 + a**2 / 100], Ts=1)
    plant.outputs([a + v], range=(-3, 3))
    watched = Watched(plant)
    box = [(-1, 1), (1.9, 2.1)]
    told = march(watched, np.array([0.3, 2.0]), box, 20, reading=(9, 3.1))
    assert told[9][1] == 32
    assert all(inside for inside, *_ in told)
    told = march(watched, np.array([0.3, 2.0]), box, 20, reading=(9, 2.9))
    assert told[9][1] == 8


def test_an_input_that_is_not_a_number_begins_the_sets_anew():
    watched = Watched(drifting())
    memory = watched.start([(-1, 1), (1.9, 2.1)])
    for _ in range(3):
        memory, lower, upper, status = watched.call(memory, [0.0], [0.0])
    assert upper[1] - lower[1] < 0.3
    memory, lower, upper, status = watched.call(memory, [np.nan], [0.0])
    assert status == 2
    assert upper[1] - lower[1] < 0.3, "y_k and what came before still hold at k"
    memory, lower, upper, status = watched.call(memory, [0.0], [0.0])
    assert status == 0
    assert (lower[1], upper[1]) == (-10, 10)


def test_no_call_before_the_start():
    watched = Watched(drifting())
    size = watched.layout["initialised"].stop
    memory, lower, upper, status = watched.call(np.zeros(size), [0.0], [0.0])
    assert status & 1
    assert not memory.any()
    assert np.all(lower == -np.inf)
    assert np.all(upper == np.inf)


def test_parts_of_the_contractor_are_left_out_by_name():
    rows = {
        cuts: march(Watched(drifting(), cuts=cuts), np.array([0.3, 2.0]), [(-1, 1), (1.9, 2.1)], 6)[
            -1
        ]
        for cuts in ((), ("strips",), CUTS)
    }
    none, strips, everything = (row[3] - row[2] for row in rows.values())
    assert np.isinf(none).all()
    assert strips[0] == pytest.approx(0.2)
    assert np.isinf(strips[1])
    assert everything[0] < 0.2
    assert everything[1] < 0.3


@pytest.mark.parametrize(
    "spoilt",
    [
        {"horizon": 0},
        {"horizon": 2.5},
        {"recovery": None},
        {"cuts": "strips"},
        {"cuts": ["nets"]},
        {"cuts": [[]]},
    ],
)
def test_stored_options_are_read_or_refused(spoilt):
    with pytest.raises(CertificateError, match="horizon"):
        Watch.of({"horizon": 400, "recovery": 10, "cuts": None, **spoilt})


def test_a_core_that_claims_too_much_is_void_not_believed():
    """A core whose set misses the reading: the intersection is empty."""

    def run(seen):
        x = Ends(ca.SX([5.0, -1.0]), ca.SX([6.0, 1.0]))
        return Known(ca.SX.zeros(2), ca.SX(0, 1), x, None, {})

    watched = Watched(drifting(), core=Core(run, lambda x, f, kept: {}))
    *_, status = watched.call(watched.start([(-10, 10), (-10, 10)]), [0.0], [0.0])
    assert status == 8


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize(("horizon", "told", "calls"), [(None, None, 66), (9, 4, 9), (2, 1, 2)])
def test_bounds_settle_from_what_one_instant_says(delay, horizon, told, calls):
    """Strips and ranges; 15 calls of the core, 2 before it, 49 of c's image after it.

    Mutants: the calls added to the horizon; the calls of the image left out.
    """
    asked = []

    def settle(begun, number):
        asked.append((begun, number))
        return (15 if number is None else number), 0.5 * begun

    watch = Watch.of({"horizon": horizon, "recovery": 1, "cuts": None})
    guard = Guard(by_hand(), {}, watch, delay, 1.0, settle=settle)
    assert guard.horizon == pytest.approx(calls, abs=1 if horizon is None else 0)
    ((begun, number),) = asked
    assert number == told
    assert begun == pytest.approx([0.1, 0.2, 4.0, 0.1, 5.0, 9.0, 2.0], rel=1e-6)
    promised = guard.widths(np.full(7, 9.0))
    assert np.all(promised <= np.maximum(0.5 * begun, 1e-6) * (1 + 1e-6))


def test_what_cannot_begin_anew_is_not_given_up():
    """Mutant: what a method says of bounds that begin from infinity taken for calls."""

    def settle(begun, number):
        return 3, np.full(begun.shape, np.inf)

    for horizon, calls in ((None, MOST_CALLS), (9, 9)):
        watch = Watch.of({"horizon": horizon, "recovery": 1, "cuts": ["strips"]})
        guard = Guard(drifting(), {}, watch, 0, 1.0, settle=settle)
        assert guard.settled[:2] == (calls, None)


def test_measured_scheduling_is_remembered_with_the_input():
    """The image of the next call is taken with both. Mutant: room for inputs alone."""
    plant = made("gains")
    watch = Watch.of({"horizon": 400, "recovery": 1, "cuts": None})
    guard = Guard(plant, {}, watch, 0, 1.0)
    step = Step(guard, blind(2)).build()
    layout, box = guard.layout(), np.array([[2.0, 2.1], [0.0, 0.1]])
    memory = fill(layout, guard.first({}, box, np.zeros((2, 2))))
    widths = []
    for theta in (0.0, 1.0):
        moved = step(memory, [1.0], [2.05, 0.05], [theta])[0]
        assert np.array(moved[layout["before"]]).ravel().tolist() == [1.0, theta]
        after = step(moved, [1.0], [np.nan, np.nan], [0.5])
        widths.append([float(after[k][0]) for k in (3, 4)])
    # x - (1 + theta) k x / 10 + f x / 2 + u / 50 + n, about 2.05
    assert widths[0][0] - widths[1][0] == pytest.approx(0.205, rel=0.2)


@pytest.mark.parametrize(
    ("name", "inside", "unbounded"),
    [("by_hand", "a, b, e inside of", None), ("loose", "b inside of", "level has no declared")],
)
def test_the_guarantee_names_the_states_that_begin_from_declared_ranges(name, inside, unbounded):
    """Those that nothing holds to their ranges elsewhere. Mutant: the others named."""
    plant = by_hand() if name == "by_hand" else made(name)
    watch = Watch.of({"horizon": 30, "recovery": 1, "cuts": None})
    found = monitored(Guarantee(("own",), ("its",)), Guard(plant, {}, watch, 0, 1.0), False)
    text = [*found.claims, *found.assumptions]
    assert sum(line.startswith(inside) for line in text) == 1
    assert sum("no declared range" in line for line in text) == (unbounded is not None)
    assert unbounded is None or any(line.startswith(unbounded) for line in text)
    assert sum("60 calls" in line for line in text) == 2
    assert text[0] == "own" and found.assumptions[0] == "its"


@pytest.mark.parametrize("precision", ["double", "single"])
def test_first_boxes_are_stored_outside_of_what_is_given(precision):
    """In numbers of the precision. Mutant: the box as it is, which single precision rounds."""
    kind = np.float32 if precision == "single" else np.float64
    watch = Watch.of({"horizon": 30, "recovery": 1, "cuts": None})
    guard = Guard(drifting(), {}, replace(watch, precision=precision), 0, 1.0)
    box = np.array([[0.1, 0.3], [-0.7, -0.1]])
    parts = guard.first({}, box, np.zeros((0, 2)))
    for end in ("", YOUNG):
        lower, upper = (np.asarray(parts[f"x_{name}{end}"]) for name in ("lower", "upper"))
        assert (lower <= box[:, 0]).all() and (upper >= box[:, 1]).all()
        assert (lower == lower.astype(kind)).all() and (upper == upper.astype(kind)).all()
        assert np.abs(np.stack([lower, upper], axis=1) - box).max() < 2 * np.finfo(kind).eps
