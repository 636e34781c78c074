"""The search for the worst case: strong enough to prove something, never above what is proved."""

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.hinf.worst_case import (
    excite,
    frozen_gain,
    half_sine,
    hold_points,
    loop_of,
    worst_case,
)

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "hinf_worst_case.py"

# The first 30 plants that have a design; the benchmark counts the refusals too.
SEEDS = [seed for seed in range(37) if seed not in (2, 11, 12, 24, 29, 32, 34)]


@pytest.fixture(scope="module")
def bench():
    return runpy.run_path(str(SCRIPT))


def linear_plant(seed):
    """A random stable plant of third order without nonlinearity, one fault, two disturbances."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((3, 3))
    A *= rng.uniform(0.3, 0.97) / np.abs(np.linalg.eigvals(A)).max()
    L, W, C = rng.standard_normal((3, 1)), rng.standard_normal((3, 2)), rng.standard_normal((1, 3))
    plant = ob.Plant(f"linear {seed}")
    x, (f,), w = plant.states("x1:4"), plant.faults("f"), plant.disturbances("w1:3")
    rows = [
        sum(a * s for a, s in zip(A[i], x, strict=True))
        + L[i, 0] * f
        + sum(a * s for a, s in zip(W[i], w, strict=True))
        for i in range(3)
    ]
    plant.dynamics(rows, Ts=1)
    plant.outputs([sum(c * s for c, s in zip(C[0], x, strict=True))])
    return plant, A, L, W, C


def norm(A, L, W, C, gains):
    """H-infinity norm from w to f - fhat, by the bounded real lemma."""
    import cvxpy as cp

    kept = np.eye(3) - gains["F"] @ C
    loop, noise = kept @ A - gains["K"] @ C, kept @ W
    output, direct = gains["H"] @ C @ A + gains["D"] @ C, gains["H"] @ C @ W
    P, mu2 = cp.Variable((3, 3), symmetric=True), cp.Variable()
    top = np.vstack([np.hstack([loop, noise]), np.hstack([output, direct])])
    weight = cp.bmat([[P, np.zeros((3, 1))], [np.zeros((1, 3)), np.eye(1)]])
    size = cp.bmat([[P, np.zeros((3, 2))], [np.zeros((2, 3)), mu2 * np.eye(2)]])
    matrix = size - top.T @ weight @ top
    problem = cp.Problem(cp.Minimize(mu2), [0.5 * (matrix + matrix.T) >> 0, P >> 0])
    problem.solve(solver="CLARABEL")
    return float(np.sqrt(mu2.value))


def detectable_seeds(count):
    """Seeds of plants with stable zeros."""
    found = []
    for seed in range(100):
        _, A, L, _, C = linear_plant(seed)
        G = np.eye(3) - L @ C / (C @ L)
        if np.abs(np.linalg.eigvals(G @ A)).max() < 0.98:
            found.append(seed)
        if len(found) == count:
            break
    return found


@pytest.mark.parametrize("seed", detectable_seeds(4))
def test_linear_plants_reach_the_norm(seed):
    plant, *matrices = linear_plant(seed)
    observer = ob.HinfUIO(method="polytopic").design(plant)
    found = worst_case(observer, points=16)
    exact = norm(*matrices, observer.gains)
    assert 0.99 * exact <= found.gain <= exact * (1 + 1e-9)
    assert found.gain <= found.certified
    assert found.limit == pytest.approx(exact, rel=1e-6)


def test_the_papers_gain_is_reached(paper_filter):
    found = worst_case(paper_filter)
    assert found.gain == pytest.approx(0.4607947, abs=1e-6)
    assert 0.99999 * found.certified < found.gain <= found.certified
    # the slope of -.33 sin(x3) is +.33 there, an odd multiple of pi away from zero
    assert np.cos(found.x[2]) == pytest.approx(-1.0, abs=1e-4)
    assert found.frequency == pytest.approx(0.0, abs=1e-6)
    assert str(found).startswith("worst case found: gain 0.46079")


def test_the_papers_gain_as_the_notes_hold_it(paper_filter, consistent):
    """Written out anew: x3 kept at pi by the fault, a half sine in the worst direction."""
    split = consistent[0]
    A, C, W = split.A, split.C, split.W1
    N = 5000
    kept = np.eye(3) - paper_filter.gains["F"] @ C
    slope = np.zeros((3, 3))
    slope[2, 2] = 0.33
    loop = kept @ (A + slope) - paper_filter.gains["K"] @ C
    HC = paper_filter.gains["H"] @ C
    transfer = HC @ (A + slope) @ np.linalg.solve(np.eye(3) - loop, kept @ W) + HC @ W
    direction = np.linalg.svd(transfer)[2][0]
    w = 1e-4 * np.sin(np.pi * (np.arange(N) + 0.5) / N)[:, None] * direction
    model = split.model.function()
    # x3 = pi needs .894 x1 + .661 x2 + .065 pi = pi at every step; f sets x2
    x = np.array([0.0, (0.935 * np.pi) / 0.661, np.pi])
    memory, f = paper_filter.memory0(x), 0.0
    faults, estimates = [], []
    for k in range(N + 1):
        noise = w[k] if k < N else np.zeros(3)
        quiet = np.array(model(x, [0], [], [0], noise, [], [])[0]).ravel()
        first = quiet[0]
        later = w[k + 1, 2] if k + 1 < N else 0.0
        # what x2 of the next instant has to be for x3 = pi one instant later
        sine = -0.33 * np.sin(quiet[2])
        f = (np.pi - 0.894 * first - 0.065 * quiet[2] - sine - 0.3 * later) / 0.661 - quiet[1]
        result = paper_filter.step(memory, [0.0], C @ x)
        memory = np.array(result[0]).ravel()
        estimates.append(float(result[2]))
        faults.append(f)
        x = quiet + np.array([0.0, f, 0.0])
    error = np.array(faults[:-1]) - np.array(estimates[1:])
    assert np.linalg.norm(error) / np.linalg.norm(w) == pytest.approx(0.4607947, abs=1e-6)


def test_a_level_that_is_claimed_too_low_is_exceeded(consistent):
    """Without the factor 2 in (45) the claim would be .4438 for a gain that does .4587."""
    import cvxpy as cp

    method = ob.HinfUIO(form="printed", majorant=(0.0, 0.517, 0.1089))
    data = method.read(consistent[0]).design.data
    A, C, W, G = data.A, data.C, data.W, data.G
    Hb, MM, eye = (data.H @ C).T @ (data.H @ C), np.diag([0.0, 0.517, 0.1089]), np.eye(3)
    zero = np.zeros((3, 3))
    P, Q = cp.Variable((3, 3), symmetric=True), cp.Variable((3, 3), symmetric=True)
    N, alpha, beta, mu2 = cp.Variable((3, 2)), cp.Variable(), cp.Variable(), cp.Variable()
    X = P @ G @ A - N @ C
    block = cp.bmat(
        [
            [P - A.T @ Hb @ A - beta * MM, -A.T @ Hb, -A.T @ Hb @ W, zero, -X.T],
            [-Hb @ A, Q + beta * eye - Hb, -Hb @ W, zero, -(P @ G).T],
            [-W.T @ Hb @ A, -W.T @ Hb, mu2 * eye - W.T @ Hb @ W, zero, -(P @ G @ W).T],
            [zero, zero, zero, alpha * eye - Q, zero],
            [-X, -P @ G, -P @ G @ W, zero, P],
        ]
    )
    rules = [block + block.T >> 0, P - alpha * MM >> 0, Q >> 0, beta >= 0, P << 1e3 * eye]
    cp.Problem(cp.Minimize(mu2), rules).solve(solver="CLARABEL")
    claimed = float(np.sqrt(mu2.value))
    assert claimed == pytest.approx(0.4438, abs=1e-3)
    gain = {"K": np.linalg.solve(P.value, N.value)}
    observer = ob.HinfUIO(method="polytopic").analyse(consistent[0], gain)
    assert worst_case(observer, steps=2000).gain > claimed + 0.01


@pytest.mark.long
def test_random_plants_never_exceed_what_is_certified(bench):
    measured = [bench["measure"](seed, steps=1000, points=24, largest=3) for seed in SEEDS]
    designs = [row for row in measured if len(row) == 4]
    assert len(designs) == len(SEEDS) == 30
    share = np.array([found / certified for _, certified, found, _ in designs])
    assert share.max() <= 1.0
    # a weak search proves nothing: half of the levels are reached to within a tenth
    assert np.median(share) > 0.9
    assert {row[0] for row in designs} == set(bench["METHODS"])


def test_a_search_that_leaves_the_domain_counts_for_nothing(bench):
    """At the border of X the plant leaves it, g is clipped, and the error has no bound."""
    plant = bench["random_plant"](28)
    observer = bench["METHODS"]["general"].design(plant)
    design = observer.certificate.design
    inner = hold_points(plant, np.array([[14.0, 19.9, 19.9]]), np.zeros((1, 3)))
    limit, frequency, direction = frozen_gain(design, inner.jacobian)
    chunk, about = loop_of(observer), (limit[0], frequency[0])
    small = half_sine(500, frequency[0], direction[0], 1e-4)
    assert 0.0 < excite(observer, chunk, inner, small, *about).gain < 1e-3
    assert excite(observer, chunk, inner, 1e6 * small, *about).gain == 0.0


def test_a_plant_that_cannot_be_held_anywhere():
    """x grows by at least one at every step, whatever f does."""
    plant = ob.Plant("clock")
    x, (f,), w = plant.states("x1:3", range=(-5, 5)), plant.faults("f"), plant.disturbances("w1:3")
    plant.dynamics([x[0] + 3 + w[0], x[1] / 2 + f + w[1]], Ts=1)
    plant.outputs(list(x))
    observer = ob.HinfUIO(method="general").design(plant)
    with pytest.raises(ob.ObsynthError, match="cannot be held"):
        worst_case(observer)


def test_other_methods_are_refused():
    with pytest.raises(ob.ObsynthError, match="bounded_error_uio"):
        worst_case(SimpleNamespace(method="bounded_error_uio"))
