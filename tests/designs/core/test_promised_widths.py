"""Half widths of the cut sets hold for the sets of the step, in its order and at its ages."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.core import Core, Known
from obsynth.designs.core.guard import Guard, Watch
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import fill

R = sp.Rational
OPTIONS = {"horizon": 9, "recovery": 1, "cuts": None}


def plant(rows, outputs, x=9, f=None, rate=None):
    """Two states, a fault and a reading with noise of .01; rows and outputs of (x1, x2, f, v)."""
    p = ob.Plant("two")
    x1, x2 = p.states("x1 x2", range=(-x, x))
    faults = p.faults("f", range=f, rate=rate) if f is not None else [0]
    w, v = p.disturbances("w v", bound=0.01)
    p.dynamics([row + w for row in rows(x1, x2, faults[0])], Ts=1)
    p.outputs([outputs(x1, x2) + v])
    return p


def widths(given, horizon, knows=(np.inf, np.inf), delay=0, steps=None):
    """Promised half widths, and the largest from call N on, over a core of fixed sets."""
    guard = Guard(given, {}, Watch.of({**OPTIONS, "horizon": horizon}), delay, 1.0)
    n_f, zero = len(given.f), ca.SX.zeros(2)
    ends = Ends(-ca.DM(knows), ca.DM(knows))
    core = Core(lambda seen: Known(zero, ca.SX.zeros(n_f), ends, None, {}), lambda x, f, kept: {})
    step = Step(guard, core).build()
    parts = guard.first({}, given.box("x"), given.box("f").reshape(-1, 2))
    memory, found = fill(guard.layout(), parts), []
    for _ in range(3 * horizon + 5 if steps is None else steps):
        told = [np.array(part).ravel() for part in step(memory, [], [0.0])]
        memory = told[0]
        found.append(0.5 * np.concatenate([told[4] - told[3], told[6] - told[5]]))
    return guard.widths(np.array([*knows, *([np.inf] * n_f)])), np.max(found[horizon:], axis=0)


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("rate", [None, 0.5])
def test_an_image_knows_of_a_fault_what_the_call_before_did(rate, delay):
    """The inversion tells a fault one call late. Mutant: the image takes what it will tell."""
    given = plant(lambda a, b, f: (a / 2 + f, b / 5 + f), lambda a, b: a, f=(-3, 3), rate=rate)
    promised, found = widths(given, 30, delay=delay)
    assert np.all(found <= promised)
    assert found[1] == pytest.approx(promised[1], rel=0.01)


def test_strips_come_before_the_core():
    """Mutant: a strip takes the other state from the core's set of the same call."""
    given = plant(lambda a, b, f: (R(9, 10) * a, R(9, 10) * b), lambda a, b: a + b)
    promised, found = widths(given, 60, knows=(1e-3, np.inf))
    assert np.all(found <= promised)
    assert found == pytest.approx(promised, rel=0.01)


@pytest.mark.parametrize("horizon", [1, 2, 5, 20])
def test_a_copy_that_is_young_has_had_few_images(horizon):
    """Mutant: as many passes as it takes, whatever the horizon."""
    given = plant(lambda a, b, f: (a / 2, R(9, 10) * b), lambda a, b: a)
    promised, found = widths(given, horizon)
    assert np.all(found <= promised)
    assert found[1] > 9 * 0.9**horizon
    assert found[1] == pytest.approx(promised[1], rel=1e-6)


def test_a_state_that_may_leave_its_range_has_no_promised_width():
    """Mutant: the declared range taken for what holds at every call."""
    given = plant(lambda a, b, f: (a / 2, R(11, 10) * b), lambda a, b: a)
    promised, found = widths(given, 10)
    assert np.isfinite(promised[0]) and np.isinf(promised[1]) and found[1] > 9


@pytest.mark.parametrize("bounded", [True, False])
def test_a_core_begins_from_the_declared_range_of_a_fault_or_from_the_inversion(bounded):
    """Mutants: the inversion where the core does not wait for it; one rate where it takes two."""
    given = plant(
        lambda a, b, f: (a / 2 + f, b / 5),
        lambda a, b: a,
        f=(-3, 3) if bounded else (-np.inf, np.inf),
        rate=0.25,
    )
    for delay in (0, 1):
        begun = Guard(given, {}, Watch.of(OPTIONS), delay, 1.0).half_widths.begun
        told = 3.0 if bounded else 0.01 + 0.005 + 0.01 + 0.5
        assert begun == pytest.approx([0.01, 9.0, told])


@pytest.mark.parametrize("delay", [0, 1])
@pytest.mark.parametrize("bounded", [True, False])
def test_the_step_begins_a_core_from_no_wider_sets(bounded, delay):
    """From a step that remembers what its core was given; mutant: one rate where it takes two."""
    given = plant(
        lambda a, b, f: (a / 2 + f, b / 5),
        lambda a, b: a,
        f=(-3, 3) if bounded else (-np.inf, np.inf),
        rate=0.25,
    )

    def begin(x, f, kept):
        return {"given": ca.vertcat(x.upper - x.lower, f.upper - f.lower)}

    def run(seen):
        width = seen.memory["given"]
        knows = ca.vertcat(ca.if_else(width[2] > 1e6, 1e60, 1e9), 1e9)
        return Known(ca.SX.zeros(2), ca.SX.zeros(1), Ends(-knows, knows), None, seen.memory)

    guard = Guard(given, {"given": 3}, Watch.of(OPTIONS), delay, 1.0)
    step = Step(guard, Core(run, begin)).build()
    parts = guard.first({"given": np.zeros(3)}, given.box("x"), given.box("f"))
    memory, place, found = fill(guard.layout(), parts), guard.layout()["given"], []
    for _ in range(40):
        memory = np.array(step(memory, [], [0.0])[0]).ravel()
        found.append(0.5 * memory[place])
    late = 0 if bounded else 2
    begun = guard.half_widths.begun
    assert np.all(np.array(found)[late:] <= begun * (1 + 1e-12))
    assert found[late][::2] == pytest.approx(begun[::2], rel=1e-6)


def test_what_a_varying_gain_leaves_of_a_fault():
    """J / 10 in [.1, .3]: .025 / .1 + (4.2 .3 + .025) s / .01, s = h_b / 10 or at most .1.

    Mutants: half of the range of J; its ends exchanged; the largest fault left out.
    """
    p = ob.Plant("varying")
    a, b = p.states("a b", range=[(-9, 9), (-1, 1)])
    (f,) = p.faults("f", range=(-4.2, 4.2))
    p.dynamics([a / 2 + (2 + b) * f / 10, b / 2], Ts=1)
    p.outputs([a])
    found = Guard(p, {}, Watch.of(OPTIONS), 0, 1.0).half_widths
    for b_half, spread in ((0.5, 0.05), (2.0, 0.1), (0.0, 0.0)):
        told = found._divided(0, 0, 0.025, np.array([0.01, b_half, 4.2]))
        assert told == pytest.approx(0.25 + 1.285 * spread / 0.01, rel=1e-6)


def test_a_prediction_at_the_nominal_point_stands_beside_what_is_promised():
    """By hand: (h + h / 2 + w) 9 / x for x+ = x / 2 + x f / 9 + w, h of the strip, at x = 2.

    Mutants: middles in place of nominal values; the range of the fault; the prediction promised.
    """
    given = ob.Plant("gained")
    (x,) = given.states("x", range=(1, 5), nominal=2)
    (f,) = given.faults("f", range=(-1, 3))
    w, v = given.disturbances("w v", bound=[0.02, 0.01])
    given.dynamics([x / 2 + x * f / 9 + w], Ts=1)
    given.outputs([x + v])
    observer = ob.IntervalObserver(cuts=("strips", "inversion")).design(given)
    told = observer.performance["predicted_half_widths"]
    assert told == pytest.approx([0.01, (0.01 + 0.01 / 2 + 0.02) * 9 / 2], rel=1e-6)
    assert observer.half_widths[1] > 2.0 * told[1]
    assert observer.widths["f"].endswith(f"(predicted at the nominal point: +-{told[1]:.4g})")
    assert "predicted" not in observer.widths["x"]
    assert "predicted_half_widths" in observer.searched
    # a method that predicts for itself knows better
    other = ob.SetMembershipObserver().design(given)
    assert other.fault_delay == 1
    own = other.certificate.design.predicted
    assert other.performance["predicted_half_widths"].tolist() == own.tolist()
