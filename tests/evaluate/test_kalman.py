"""The extended Kalman filter against Gaussians conditioned all at once, which no recursion is."""

import numpy as np
import pytest

import obsynth as ob
from obsynth.evaluate.choosing.kalman import ExtendedKalman

A = np.array([[0.9, 0.2], [-0.1, 0.7]])
F = np.array([0.3, 1.0])
W1 = np.array([[0.02, 0.0], [0.01, 0.03]])


def linear(rate=0.05, f_range=(-0.5, 0.5)):
    """One disturbance enters dynamics and reading alike."""
    plant = ob.Plant("line")
    x = plant.states("x1 x2", range=[(-1, 3), (-2, 2)])
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.faults("f", range=f_range, rate=rate)
    w = plant.disturbances("w1:3", bound=1)
    rows = [sum(A[i, j] * x[j] for j in range(2)) + F[i] * f + W1[i] @ np.array(w) for i in (0, 1)]
    plant.dynamics([rows[0] + u, rows[1]], Ts=1)
    plant.outputs([x[0] + 0.1 * w[1], x[0] + x[1] + 0.1 * w[0]])
    return plant


def conditioned(y, u, walk):
    """Means and deviations of (x_k, f_(k-1)) given y_0..y_k; every signal is a row of numbers."""
    count = len(y)
    size = 3 + 3 * count
    unit = np.eye(size)
    x, f = np.array([unit[0] * 2.0, unit[1] * 2.0]) / np.sqrt(3), unit[2] * 0.5 / np.sqrt(3)
    means, rows, offsets, found, before = np.array([1.0, 0.0]), [], [], [], None
    for k in range(count):
        w = unit[3 + 3 * k : 5 + 3 * k] / np.sqrt(3)
        rows += [x[0] + 0.1 * w[1], x[0] + x[1] + 0.1 * w[0]]
        offsets += [means[0], means.sum()]
        read = y[: k + 1].ravel()
        told = np.flatnonzero(np.isfinite(read))
        R, off = np.array(rows)[told], (read - np.array(offsets))[told]
        wanted = np.array([*x, f if before is None else before])
        gain = wanted @ R.T @ np.linalg.inv(R @ R.T)
        deviation = np.sqrt(np.diag(wanted @ wanted.T - gain @ R @ wanted.T))
        found.append((np.append(means, 0.0) + gain @ off, deviation))
        before = f
        x = A @ x + np.outer(F, f) + W1 @ w
        f = f + walk * unit[5 + 3 * k]
        means = A @ means + [u[k], 0.0]
    return found


@pytest.mark.parametrize(("rate", "walk"), [(0.05, 0.05), (None, 0.5)])
def test_the_filter_is_exact_where_the_plant_is_linear(rate, walk):
    """Mutants: noise of readings apart from that of the dynamics; half ranges as deviations; the
    fault of this instant for that of the one before; a missing reading taken as zero."""
    rng = np.random.default_rng(1)
    u, y = rng.uniform(0, 0.2, (8, 1)), rng.uniform(-0.1, 0.1, (8, 2))
    y += 0.9 ** np.arange(8)[:, None]
    y[3, 0] = np.nan
    kalman = ExtendedKalman(linear(rate))
    memory = kalman.memory0([1.0, 0.0])
    # the box of the states is left alone by means this tame
    for k, (mean, deviation) in enumerate(conditioned(y, u[:, 0], walk)):
        memory, *told = (np.array(v).ravel() for v in kalman.step(memory, u[k], y[k]))
        xhat, fhat, x_lower, x_upper, f_lower, f_upper, status = told
        estimate = np.append(xhat, fhat)
        half = 0.5 * (np.append(x_upper, f_upper) - np.append(x_lower, f_lower))
        kept = slice(None) if k else slice(0, 2)  # no fault is told of before the first instant
        np.testing.assert_allclose(estimate[kept], mean[kept], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(half[kept], 3.0 * deviation[kept], rtol=1e-7)
        assert status == 0


def test_what_has_no_range_reaches_as_far_as_a_state_does():
    """x1 has half a range of 2 and the factor .3, x2 of 2 and 1. Mutant: the smaller reach."""
    kalman = ExtendedKalman(linear(f_range=(-np.inf, np.inf)))
    assert kalman.half[2] == pytest.approx(2 / 0.3)


def test_the_leak_is_found_and_no_guarantee_is_given():
    record, plant = ob.records.three_tank_leak(), ob.plants.leaking_tanks(rate=0.003)
    choice = ob.choose(plant, record, methods=[])
    leak, flow = choice.kalman.run["leak"], 0.00098737 * np.diff(record["pulses"])
    assert np.median(leak.half_width) == pytest.approx(0.00797, rel=0.01)
    assert np.mean((leak.lower <= flow) & (flow <= leak.upper)) > 0.97
    assert np.flatnonzero(leak.lower > 0)[0] + 36 == 61
    assert choice.recommended is None and "no method" in choice.reason
    assert "no guarantee" in str(choice.table)
