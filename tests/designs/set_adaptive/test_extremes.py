"""The extremes of A_m and A_M over the ranges, against every pair of ends that a reading leaves."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.set_adaptive.model import read


def mixer():
    """Two measured levels and a hidden one; entries rise and fall, one with both ends of a."""
    plant = ob.Plant("mixer")
    a, b, c = plant.states("a b c", range=[(0.5, 2.0), (1.0, 3.0), (0.0, 1.0)])
    u, q = plant.inputs("u q", range=[(0.2, 1.5), (-1, 3)], nominal=1)
    (f,) = plant.process_faults("f", range=(-0.1, 0.1))
    plant.dynamics(
        [-a * a + b * c + 2 * q + f, -u * b - b / (1 + a) + a, c * (a**2 - 2 * a) - (3 + u) * c]
    )
    v = plant.disturbances("v1:3", bound=[0.02, 0.03])
    plant.outputs([a + v[0], 2 * b + v[1]])
    return plant


MODEL = read(mixer())


def brute(reach, points=31):
    """The least and the largest entry by ends y -+ reach inside of the ranges, and inputs."""
    function, grids = MODEL.bounds.function(), []
    for state, wide in zip(MODEL.bounds.states, reach, strict=True):
        y = np.linspace(state.lower, state.upper, points)
        y = np.append(
            y, np.clip([state.lower + wide, state.upper - wide], state.lower, state.upper)
        )
        pairs = np.column_stack([y - wide, y + wide]).clip(state.lower, state.upper)
        ends = [(p, q) for p in (state.lower, state.upper) for q in (state.lower, state.upper)]
        grids.append(pairs if wide < np.inf else np.array([e for e in ends if e[0] <= e[1]]))
    pairs = [(p, q, v) for p in grids[0] for q in grids[1] for v in (0.2, 1.5)]
    low, high, known = (np.array(part).T for part in zip(*[
        ((p[0], q[0]), (p[1], q[1]), (v,)) for p, q, v in pairs
    ], strict=True))  # fmt: skip
    found = function.map(len(pairs))(low, high, known)
    parts = [np.array(found[side]).reshape(3, len(pairs), 3) for side in (0, 1)]
    return parts[0].min(axis=1), parts[1].max(axis=1)


@pytest.mark.parametrize("reach", [(0.0, 0.0), (0.1, 0.1), (0.3, 0.05), (0.1, np.inf), (9.0, 0.2)])
def test_extremes_are_those_of_all_ends(reach):
    """Held, and attained up to the grid and the search.

    Mutants: a sign of the reach, an end that leaves its range, two ends that are one, apart.
    """
    wide = tuple(np.inf if w > 2.0 else w for w in reach)
    least, largest = brute(wide)
    low, high = MODEL.bounds.extremes(np.array(reach))
    assert (low <= least + 1e-15).all()
    assert (high >= largest - 1e-15).all()
    assert least == pytest.approx(low, abs=1e-6)
    assert largest == pytest.approx(high, abs=1e-6)
    assert not np.allclose(low, high)


@pytest.mark.parametrize("Ts", [0.0, 0.01, 0.1])
def test_the_extremes_of_a_step_reach_as_far_as_noise_and_motion(Ts):
    """Speeds by sampling the equations. Mutants: noise, motion or inputs left out or taken off."""
    plant, rng = mixer(), np.random.default_rng(1)
    boxes = [plant.box(kind) for kind in ("x", "u", "f")]
    x, u, f = (rng.uniform(*box.T, (2000, len(box))).T for box in boxes)
    for part, box in zip((x, u, f), boxes, strict=True):
        part[:, ::2] = box[np.arange(len(box))[:, None], rng.integers(0, 2, (len(box), 1000))]
    none, w = np.zeros((0, 2000)), np.zeros((2, 2000))
    moved = np.array(plant.function().map(2000)(x, u, none, f, w, none, none)[0])
    speed = np.abs(moved[:2]).max(axis=1)
    reach = np.array([0.02, 0.015]) + Ts * speed
    low, high = MODEL.extremes(Ts)
    least, largest = MODEL.bounds.extremes(reach)
    assert (low <= least + 1e-12).all()
    assert (high >= largest - 1e-12).all()
    assert low == pytest.approx(least, abs=0.1)
    assert high == pytest.approx(largest, abs=0.1)


def bent():
    """An entry that falls over a part of the range of a reading and rises over the rest."""
    plant = ob.Plant("bent")
    a, c = plant.states("a c", range=[(0.5, 2.0), (0.0, 1.0)])
    (f,) = plant.process_faults("f", range=(-0.1, 0.1))
    plant.dynamics([-a + c + f, a - (2 + sp.cos(3 * a)) * c])
    plant.outputs([a])
    return plant


def test_an_entry_that_turns_is_held_between_any_ends():
    """No end of a reading is the one at which cos(3 a) is least: its constant range is taken."""
    found = read(bent())
    function = found.bounds.function()
    for low, high in ((0.5, 2.0), (0.5, 0.9), (0.7, 1.4), (1.1, 1.2), (1.2, 2.0)):
        values = function(low, high, np.zeros(0))
        least, largest = (np.array(values[side])[1, 1] for side in (0, 1))
        entry = -(2 + np.cos(3 * np.linspace(low, high, 101)))
        assert least <= entry.min() + 1e-12
        assert largest >= entry.max() - 1e-12
