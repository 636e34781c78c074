"""Random compartments: both observers hold states and faults that the three tanks do not show."""

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.model import read

NOISE = 0.02


def compartments(seed):
    """Three or four saturating compartments, two measured, each of these with a fault."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(3, 5))
    plant = ob.Plant("compartments")
    x = plant.states(f"x1:{n + 1}", range=(0.0, 4.0))
    u1, u2 = plant.inputs("u1:3", range=(0, 1))
    faults = plant.actuator_faults("f1:3", of=[u1, u2], range=(-0.1, 0.1))
    v = plant.disturbances("v1:3", bound=NOISE)
    (w,) = plant.disturbances("w", range=(-0.01, 0.03))
    rates = [0] * n
    for i in range(n):
        rates[i] -= round(float(rng.uniform(0.4, 0.8)), 3) * x[i] / (1 + x[i] / 8)
        j = int(rng.integers(0, n))
        if j != i:
            flow = round(float(rng.uniform(0.05, 0.2)), 3) * x[i] / (1 + x[i])
            rates[i] -= flow
            rates[j] += flow
    rates[0] += u1
    rates[1] += u2
    rates[n - 1] += w + 0.1
    plant.dynamics(rates)
    plant.outputs([x[0] + v[0], 2 * x[1] + v[1]])
    assert len(faults) == 2
    return plant, n


def follow(observer, plant, n, seed, steps=60):
    """States and constant faults outside of their sets; noise and disturbance at their ends."""
    rng = np.random.default_rng(seed + 1)
    Ts = float(observer.model.Ts)
    fine = plant.discretise("rk4", Ts / 4).function()
    x, theta = rng.uniform(0.5, 1.5, n), 0.1 * rng.choice([-1.0, 0.0, 1.0], 2)
    memory = observer.memory0(x, x_range=np.column_stack([x - 0.3, x + 0.3]))
    wrong = 0
    for _ in range(steps):
        u = rng.uniform(0.2, 1.0, 2)
        v = NOISE * (1 - 1e-12) * rng.choice([-1.0, 1.0], 2)
        w = np.array([*v, rng.choice([-0.01, 0.03])])
        y = np.array([x[0], 2 * x[1]]) + v
        memory, _, _, low, high, f_low, f_high, status = observer.step(memory, u, y)
        wrong += int(status) != 0
        wrong += int((np.array(low).ravel() > x).sum() + (np.array(high).ravel() < x).sum())
        wrong += int((np.array(f_low).ravel() > theta).sum())
        wrong += int((np.array(f_high).ravel() < theta).sum())
        for _ in range(4):
            x = np.array(fine(x, u, [], theta, w, [], [])[0]).ravel()
    assert ((x > 0.0) & (x < 4.0)).all()
    return wrong, np.array(f_high - f_low).ravel()


@pytest.mark.long
@settings(max_examples=5, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.1]))
def test_the_observer_on_random_compartments(seed, Ts):
    plant, n = compartments(seed)
    observer = SetAdaptiveObserver(gain_cap=1.0, Gamma=1.0, Ts=Ts).design(plant)
    wrong, _ = follow(observer, plant, n, seed)
    assert wrong == 0


@pytest.mark.long
@settings(max_examples=5, deadline=None, derandomize=True)
@given(st.integers(0, 10_000), st.sampled_from([0.02, 0.1]))
def test_the_bank_on_random_compartments(seed, Ts):
    plant, n = compartments(seed)
    bank = SetAdaptiveObserver(robust=True, Ts=Ts, filters=(1.0, 0.3)).design(plant)
    wrong, _ = follow(bank, plant, n, seed)
    assert wrong == 0


@pytest.mark.parametrize("robust", [False, True])
def test_intervals_of_faults_shrink(robust):
    plant, n = compartments(4)
    options = {"filters": (0.3,)} if robust else {"gain_cap": 1.0, "Gamma": 20.0}
    observer = SetAdaptiveObserver(robust=robust, Ts=0.1, **options).design(plant)
    wrong, width = follow(observer, plant, n, 4, steps=200)
    assert wrong == 0
    assert (width < 0.199).all()


def coupled(A, measured):
    """x' = A x + u + G f, with some states measured."""
    made = ob.Plant("coupled")
    x = made.states("x0 x1 x2", range=(0, 5))
    (u,), (f,) = made.inputs("u", range=(0, 1)), made.process_faults("f", range=(0, 0.1))
    rows = [sum(float(a) * s for a, s in zip(row, x, strict=True)) + u for row in A]
    made.dynamics([rows[0], rows[1], rows[2] + f / 2])
    made.outputs([x[i] for i in measured])
    return made


@pytest.mark.parametrize(
    ("A", "measured", "word"),
    [
        ([[-1.5, 0, 1], [1, -1, 0], [0.5, 0, 1]], (2, 0, 1), None),
        ([[1, 0, 0.5], [0.5, 0.499, 0], [1, 1, -3]], (2, 0, 1), None),
        ([[-1, 0, 0], [0, 1, 0], [0, 0, -1]], (0, 2), "no gain makes"),
        ([[-1, 0, 0], [0, 0, 0], [0, 0, -1]], (0, 2), "no gain makes"),
    ],
)
def test_unstable_and_decoupled_states_are_designed_or_refused(A, measured, word):
    """The solver returns p = 0 where it keeps p >= 1e-9 within its tolerance.

    Mutant: that p, by which W is divided.
    """
    if word is None:
        assert SetAdaptiveObserver().design(coupled(A, measured)).certificate.check().valid
    else:
        with pytest.raises(ob.InfeasibleDesign, match=word) as refusal:
            SetAdaptiveObserver().design(coupled(A, measured))
        # a measured state is not called unmeasured because another output does not show it
        assert "unmeasured states (x1)" in str(refusal.value)


def test_outputs_move_as_typed_not_as_written_out():
    """Air between two zones: written out, the root of 1 + (a - b)^2 is one of a difference."""
    plant = ob.Plant("two zones")
    a, b = plant.states("a b", range=(15, 28))
    (u,) = plant.inputs("u", range=(0, 3))
    plant.actuator_faults("f", of=u, range=(-1, 0))
    flow = 0.05 * (a - b) * sp.sqrt(1 + (a - b) ** 2)
    plant.dynamics([u / 2 - flow - 0.1 * a, flow - 0.1 * b])
    v, w = plant.disturbances("v w", bound=0.1)
    plant.outputs([a + v, b + w])
    found = read(plant)
    assert found.input_rate == pytest.approx(np.array([[0.5], [0.0]]))
    # less u / 2: f = -1, a = 28, b = 15 at the one end, f = 0, a = 15, b = 28 at the other
    steep = 0.05 * 13 * np.sqrt(170)
    assert found.rate[0] == pytest.approx([-0.5 - steep - 2.8, steep - 1.5], rel=1e-2)
    assert found.rate[1] == pytest.approx([-steep - 2.8, steep - 1.5], rel=1e-2)
