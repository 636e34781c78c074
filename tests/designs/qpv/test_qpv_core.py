"""How the bound of V begins, where estimates are placed, and runs with gaps in what is measured."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from methods import observer_of
from obsynth.codegen.kernel import Call, dense
from obsynth.designs.core.boxes import Ends
from obsynth.designs.qpv.step import build_core
from obsynth.evaluate.truth import Truth
from obsynth.symbolic.scenarios.qpv_example import _equilibrium


def parts(design):
    """Functions (x, f, xhat, fhat) -> level and -> placed estimates; boxes of shape (n, 2)."""
    core, n, n_f = build_core(design), len(design.plant.x), len(design.plant.f)
    x, f = ca.SX.sym("x", n, 2), ca.SX.sym("f", n_f, 2)
    kept = {"xhat": ca.SX.sym("xhat", n), "fhat": ca.SX.sym("fhat", n_f)}
    boxes = Ends(x[:, 0], x[:, 1]), Ends(f[:, 0], f[:, 1])
    placed = core.place(*boxes, kept)
    inputs = [x, f, *kept.values()]
    return (
        ca.Function("begin", inputs, [core.begin(*boxes, kept)["level"]]),
        ca.Function("place", inputs, [ca.vertcat(placed["xhat"], placed["fhat"])]),
    )


def levels(P, errors):
    return np.einsum("ki,ij,kj->k", errors, P, errors)


def test_a_level_begins_at_the_largest_that_a_truth_in_the_boxes_can_have():
    """Exact where the signs of P allow all far ends at once, so one per cent less is too little.

    Mutants: `begin` with the boxes one per cent narrower; a thousandth of the level.
    """
    design = observer_of("qpv_observer").certificate.design
    begin, _ = parts(design)
    rng, P = np.random.default_rng(4), design.P
    assert P[0, 1] < 0
    for _ in range(300):
        low, wide = rng.uniform(-1, 1, 2), rng.uniform(0, 0.3, 2)
        box = np.stack([low, low + wide], axis=1)
        # the far ends of one above the estimate, of the other below: the cross term is positive
        state = low + wide * [0.3, 0.7] + rng.uniform(-0.2, 0.2, 2) * wide
        found = float(begin(box[[0]], box[[1]], state[0], state[1]))
        corners = np.array([[a, b] for a in box[0] for b in box[1]]) - state
        largest = levels(P, corners).max()
        assert largest <= found <= largest * (1 + 1e-11)


def test_a_level_that_begins_holds_every_truth_in_the_boxes(designed):
    design = designed("noise").certificate.design
    begin, _ = parts(design)
    rng = np.random.default_rng(5)
    for _ in range(50):
        state, low = rng.normal(size=6), rng.normal(size=6)
        box = np.stack([low, low + rng.uniform(0, 1, 6)], axis=1)
        truths = box[:, 0] + rng.integers(0, 2, (200, 6)) * np.diff(box, axis=1)[:, 0]
        found = float(begin(box[:3], box[3:], state[:3], state[3:]))
        assert levels(design.P, truths - state).max() <= found
    everything = np.tile([-1e100, 1e100], (6, 1))
    assert float(begin(everything[:3], everything[3:], state[:3], state[3:])) > 1e150


def test_estimates_are_moved_as_little_as_they_have_to(designed):
    """Mutants: the middle itself; a root of 1.1 in place of `_PLACED`."""
    design = designed("noise").certificate.design
    begin, place = parts(design)
    half = np.array([0.05, 0.04, 0.05, 0.2, 0.2, 0.2])
    middle = np.array([10.0, 10.1, 9.9, 0.0, 0.05, 0.0])
    box = np.stack([middle - half, middle + half], axis=1)

    def placed(state, box=box):
        return np.array(place(box[:3], box[3:], state[:3], state[3:])).ravel()

    def level(state):
        return float(begin(box[:3], box[3:], state[:3], state[3:]))

    near = middle + 0.05 * half
    assert level(near) < 0.9
    np.testing.assert_allclose(placed(near), near, rtol=1e-14)
    away = middle + np.array([0.0, 0.0, 0.0, 0.5, -0.2, 0.4])
    moved = placed(away)
    assert level(away) > 1.0 >= level(moved) > 0.3
    share = (moved - middle)[3:] / (away - middle)[3:]
    assert 0.05 < share[0] < 1.0
    np.testing.assert_allclose(share, share[0], rtol=1e-9)
    # hopeless: even the middle is not in the error set
    wide = np.stack([middle - 20 * half, middle + 20 * half], axis=1)
    np.testing.assert_allclose(placed(away, wide), away, rtol=1e-14)
    for strange in (np.nan, np.inf, -1e95, 1e200):
        np.testing.assert_allclose(placed(np.append(away[:5], strange)), middle, atol=1e-12)


def swarm(observer, seed, count=12, steps=300):
    """Plants at their worst side by side, readings and inputs missing now and then.

    Returns sets that miss the truth at status 0 or 4, and the status words, (steps, count).
    """
    rng = np.random.default_rng(seed)
    design = observer.certificate.design
    Ts, w_box = design.Ts, design.plant.box("w")
    truth = Truth(design.plant, observer, 2).function
    plant, step = Call(dense(truth).map(count)), Call(dense(observer.step).map(count))
    x, u, _, f, w, rho = (
        a.reshape(count, -1) if a.size else a
        for a in (*plant.args[:2], np.zeros(0), *plant.args[3:])
    )
    y = plant.results[1].reshape(count, -1)
    memory, told_u, told_y, told_rho = (a.reshape(count, -1) for a in step.args)
    said = [result.reshape(count, -1) for result in step.results]
    x[:] = 10.0 + rng.choice([-0.05, 0.05], x.shape)
    f[:] = rng.choice([-0.14, 0.0, 0.14], f.shape)
    memory[:] = observer.memory0([10.0] * 3, x_range=[(9.95, 10.05)] * 3, f_range=[(-0.2, 0.2)] * 3)
    B = np.array([[-1.2, 0, 0.7], [0, 0.5, 0], [0, 0, 2.0]])
    bad, words = [], []
    for k in range(steps):
        if k % 7 == 0:
            w[:] = rng.choice(w_box[:, 0], w.shape) * rng.choice([-1.0, 1.0], w.shape)
            w[::3] *= rng.uniform(0, 1, w[::3].shape)
        rho[:] = 0.5 + 0.5 * np.sin(3 * k * Ts + np.arange(count)[:, None] + [0.0, 1.0])
        for b in range(count):
            pulled = B - np.diag([rho[b, 0], 0, 0])
            u[b] = _equilibrium(*rho[b]) + np.linalg.solve(pulled, 8 * (10 - x[b]) - 10 * f[b])
        plant.evaluate()
        told_u[:], told_y[:], told_rho[:] = u, y, rho
        told_y[rng.random(y.shape) < 0.01] = np.nan
        told_u[rng.random(count) < 0.01] = np.nan
        step.evaluate()
        inside = (said[3] <= x) & (x <= said[4]) & (said[5] <= f) & (f <= said[6])
        words.append(said[7][:, 0].astype(int))
        bad.append(~inside.all(axis=1))
        memory[:] = said[0]
        x[:] = plant.results[0].reshape(count, -1)
    return np.array(bad), np.array(words)


@pytest.mark.parametrize("horizon", [400, 20])
def test_sets_hold_through_gaps_and_restarts(horizon, method, plant):
    """The worst disturbances that are declared, faults far out, gaps in y and u, short memories."""
    observer = method("noise", horizon=horizon).design(plant)
    bad, words = swarm(observer, seed=horizon)
    assert not bad.any()
    assert not (words & 8).any()
    assert (words & 32).any() and (words & 2).any()
    # the bound is found again
    assert (words & 16).mean() < 0.05


def test_nothing_is_known_of_V_behind_a_missing_reading(noiseless):
    """The bound would shrink below the error of a fault that no reading corrects.

    Mutant: `sound` without the readings.
    """
    Ts, f = noiseless.model.Ts, 0.05
    memory = noiseless.memory0([5.0], x_range=[(4.9, 5.1)], f_range=[(-0.06, 0.06)])
    x, widths = 5.02, []
    for k in range(round(16.0 / Ts)):
        y = np.nan if 5 <= k < round(12.0 / Ts) else x
        memory, *said, status = noiseless.step(memory, 5.0 * (1.0 - f), y)
        low, high, f_low, f_high = (float(v) for v in said[2:])
        assert low <= x <= high and f_low <= f <= f_high
        assert not int(status) & (2 | 8)
        widths.append(f_high - f_low)
        x = 5.0 + (x - 5.0) * np.exp((f - 1.0) * Ts)
    assert widths[-1] < 0.7 * max(widths)


def test_half_widths_hold_when_a_copy_has_taken_over(noiseless):
    """Without disturbances a set is as old as a copy is, no older.

    Mutants: half widths of zero; the decay of V in place of its root's.
    """
    contract, N = noiseless.certificate.contract, 150
    design = noiseless.certificate.design
    design = replace(design, options={**design.options, "horizon": N, "cuts": ()})
    observer = contract.certify(design, "lmi").observer()
    memory, x, f, widths = observer.memory0([5.0]), 5.02, 0.02, []
    for _ in range(4 * N + 5):
        memory, *said = observer.step(memory, 5.0 * (1.0 - f), x)
        low, high, f_low, f_high = (float(v) for v in said[2:6])
        assert low <= x <= high
        assert f_low <= f <= f_high
        widths.append([high - low, f_high - f_low])
        x = 5.0 + (x - 5.0) * np.exp((f - 1.0) * design.Ts)
    half = 0.5 * np.array(widths)
    assert (half[N:] <= observer.half_widths).all()
    # of E at the start, had the region not told more
    full = np.sqrt(np.diag(np.linalg.inv(design.P)))
    np.testing.assert_allclose(half[N] / half[1], observer.half_widths / full, rtol=0.01)
