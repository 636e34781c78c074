"""Peak bounds against simulated errors: random, bang-bang and worst-case sequences.

The simulations run the plant and the observer of eqs. (1), (2), (10)-(12), or the recursion (16)
of the unshifted error, and so share nothing with the shifted system that the bounds come from.
"""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from obsynth.derive.rigour import Enclosure
from obsynth.designs.bounded_error.peak import bound as peak_bound_module
from obsynth.designs.bounded_error.peak.attained import Attained, attained
from obsynth.designs.bounded_error.peak.bound import PeakBound, peak_bound
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system, projected_gains
from obsynth.designs.bounded_error.peak.transient import transient
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.responses import response

REFERENCE = Path(__file__).parents[2] / "reference" / "bounded_error_uio.json"
WBAR, EPSBAR = np.full(3, 0.1), np.full(2, 0.05)
K = [[0.3279, 0.0012, 0], [0.0023, 0.2659, 0], [0, 0, 0], [0.2222, 0.0008, 0]]
F = [[0.6766, 0.0023, 0], [-0.0042, 0.6263, 0]]
STEPS = 3000


@pytest.fixture(scope="module")
def tanks() -> PeakSystem:
    model = json.loads(REFERENCE.read_text())["model"]
    e = np.eye(4)
    columns = [e[0], e[1], e[2] - e[0], e[3] - e[1]]
    ranges = np.column_stack([np.diag(model["Jmin"]), np.diag(model["Jmax"])])
    return peak_system(
        A=model["A"],
        B_f=model["B"],
        C=e[:3],
        D=e[:, [2]],
        W1=np.zeros((4, 3)),
        W2=np.eye(3),
        K=K,
        F=F,
        constant=np.zeros((4, 4)),
        directions=[np.outer(b, c) for b, c in zip(columns, e, strict=True)],
        ranges=ranges,
    )


@pytest.fixture(scope="module")
def peak(tanks: PeakSystem) -> PeakBound:
    return peak_bound(tanks, WBAR, EPSBAR)


@pytest.fixture(scope="module")
def worst(peak: PeakBound) -> Attained:
    return attained(peak)


def jacobian(system: PeakSystem, s: np.ndarray) -> np.ndarray:
    return system.constant + np.tensordot(s, system.directions, axes=1)


def run_observer(
    system: PeakSystem,
    jacobians: np.ndarray,
    w: np.ndarray,
    eps: np.ndarray,
    d: np.ndarray,
    x0: np.ndarray,
    xhat0: np.ndarray,
    f0: np.ndarray,
    noise: np.ndarray | None = None,
) -> np.ndarray:
    """Errors [x - xhat; f - fhat] of plant and observer with g(x) = M_k x; row k at instant k."""
    n = system.n
    T, E, C = np.eye(n) + system.E @ system.C, system.E, system.C
    x, z, f, fhat = x0.copy(), T @ xhat0, f0.copy(), np.zeros_like(f0)
    errors = np.zeros((len(w), n + len(f)))
    for k in range(len(w)):
        M = jacobians[k]
        y = C @ x + system.W2 @ w[k]
        xhat = z - E @ y
        errors[k] = np.concatenate([x - xhat, f - fhat])
        innovation = y - C @ xhat
        z = T @ (system.A @ xhat + system.B_f @ fhat + M @ xhat) + system.K @ innovation
        fhat = fhat + system.F @ innovation
        if noise is not None:
            z, fhat = z + noise[k, :n], fhat + noise[k, n:]
        x = (system.A + M) @ x + system.B_f @ f + system.D @ d[k] + system.W1 @ w[k]
        f = f + eps[k]
    return errors


def from_rest(system: PeakSystem, s: np.ndarray, w: np.ndarray, eps: np.ndarray) -> np.ndarray:
    """Errors for zeta_0 = 0 and e_f = 0: z_0 = T x_0."""
    zero = np.zeros(system.n)
    d = np.zeros((len(w), system.D.shape[1]))
    jacobians = np.array([jacobian(system, at) for at in s])
    return run_observer(system, jacobians, w, eps, d, zero, zero, np.zeros(system.n_f))


def paper_matrix(system: PeakSystem, s: np.ndarray) -> np.ndarray:
    """X + Y M V of eq. (17)."""
    T = np.eye(system.n) + system.E @ system.C
    closed = T @ (system.A + jacobian(system, s)) - system.K @ system.C
    return np.block([[closed, T @ system.B_f], [-system.F @ system.C, np.eye(system.n_f)]])


def paper_inputs(system: PeakSystem) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns of w_k, eps_k and w_{k+1} in eq. (18), with E W2 in the place of E W1."""
    n, n_f, n_w = system.n, system.n_f, system.W2.shape[1]
    T = np.eye(n) + system.E @ system.C
    now = np.vstack([T @ system.W1 - system.K @ system.W2, -system.F @ system.W2])
    rate = np.vstack([np.zeros((n, n_f)), np.eye(n_f)])
    return now, rate, np.vstack([system.E @ system.W2, np.zeros((n_f, n_w))])


def worst_disturbances(
    peak: PeakBound, output: int, s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Disturbances w, eps that maximise one error at the last instant, and the adjoint of (16)."""
    system, steps = peak.system, len(s)
    now, rate, after = paper_inputs(system)
    w, eps = np.zeros((steps, len(peak.wbar))), np.zeros((steps, system.n_f))
    adjoint = np.zeros((steps, system.n + system.n_f))
    adjoint[-1, output] = 1.0
    w[-1] = np.sign(after.T @ adjoint[-1]) * peak.wbar
    transposed: dict[bytes, np.ndarray] = {}
    for k in range(steps - 2, -1, -1):
        key = s[k].tobytes()
        if key not in transposed:
            transposed[key] = paper_matrix(system, s[k]).T
        adjoint[k] = transposed[key] @ adjoint[k + 1]
        w[k] = np.sign(now.T @ adjoint[k + 1] + after.T @ adjoint[k]) * peak.wbar
        eps[k] = np.sign(rate.T @ adjoint[k + 1]) * peak.epsbar
    return w, eps, adjoint


def worst_switching(peak: PeakBound, output: int, s: np.ndarray, passes: int) -> np.ndarray:
    """Errors when the Jacobian switches, too, wherever that increases the error at the end."""
    system = peak.system
    T = np.eye(system.n) + system.E @ system.C
    low, high = system.ranges.T
    found = []
    for _ in range(passes):
        w, eps, adjoint = worst_disturbances(peak, output, s)
        errors = from_rest(system, s, w, eps)
        found.append(errors)
        push = np.einsum(
            "ki,jil,kl->kj", adjoint[1:, : system.n] @ T, system.directions, errors[:-1, : system.n]
        )
        s = np.vstack([np.where(push > 0, high, low), s[-1:]])
    return max(found, key=lambda errors: errors[-1, output])


class TestWorstSequences:
    @pytest.mark.parametrize("output", range(6))
    def test_a_constant_vertex_is_attained_and_stays_inside(self, peak, worst, output):
        s = np.tile(worst.scheduling[output], (STEPS, 1))
        w, eps, _ = worst_disturbances(peak, output, s)
        errors = from_rest(peak.system, s, w, eps)
        # after 3000 steps the fourth level still remembers .9966^3000
        assert errors[-1, output] >= worst.peaks[output] * (1 - 1e-4)
        assert np.all(np.abs(errors) <= peak.steady)

    @pytest.mark.parametrize(("output", "gain"), [(1, 1.03), (3, 1.005), (5, 1.08)])
    def test_switching_jacobians_exceed_a_constant_one_and_stay_inside(
        self, peak, worst, output, gain
    ):
        s = np.tile(worst.scheduling[output], (STEPS, 1))
        errors = worst_switching(peak, output, s, passes=5)
        assert errors[-1, output] > worst.peaks[output] * gain
        assert np.all(np.abs(errors) <= peak.steady)


def late_response(powers, outputs, B):
    right = response(powers, outputs, B)
    return dataclasses.replace(right, total=right.total - right.terms[0])


class TestMutantsAreViolated:
    """Each wrong bound is exceeded by a sequence that the right one contains."""

    def violated(self, mutant: PeakBound, peak: PeakBound, worst: Attained, output: int) -> bool:
        s = np.tile(worst.scheduling[output], (STEPS, 1))
        w, eps, _ = worst_disturbances(peak, output, s)
        errors = np.abs(from_rest(peak.system, s, w, eps))
        assert np.all(errors <= peak.steady)
        return bool(np.any(errors > mutant.steady))

    def test_without_the_feedthrough(self, tanks, peak, worst):
        none = Enclosure(np.zeros_like(tanks.D_w.mid), np.zeros_like(tanks.D_w.rad))
        mutant = peak_bound(dataclasses.replace(tanks, D_w=none), WBAR, EPSBAR)
        assert self.violated(mutant, peak, worst, output=2)

    def test_too_little_noise(self, tanks, peak, worst):
        assert self.violated(peak_bound(tanks, 0.98 * WBAR, EPSBAR), peak, worst, output=0)

    def test_too_slow_faults(self, tanks, peak, worst):
        assert self.violated(peak_bound(tanks, WBAR, 0.9 * EPSBAR), peak, worst, output=4)

    @pytest.mark.parametrize("output", [0, 4])
    def test_sum_begun_one_late(self, tanks, peak, worst, output, monkeypatch):
        with monkeypatch.context() as patch:
            patch.setattr(peak_bound_module, "response", late_response)
            mutant = peak_bound(tanks, WBAR, EPSBAR)
        assert self.violated(mutant, peak, worst, output)


def random_run(
    system: PeakSystem, peak: PeakBound, rng: np.random.Generator, steps: int, spread: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Errors of an admissible run from a random start, and bounds of its initial error."""
    n = system.n
    low, high = system.ranges.T
    vertex = rng.random((steps, len(low))) < 0.5
    s = np.where(vertex, np.where(rng.random((steps, len(low))) < 0.5, low, high), low)
    s = np.where(vertex, s, rng.uniform(low, high, (steps, len(low))))
    jacobians = np.array([jacobian(system, at) for at in s])
    jacobians += system.radius * np.sign(rng.normal(size=jacobians.shape))
    w = rng.uniform(-1, 1, (steps, len(peak.wbar)))
    w = np.where(rng.random((steps, 1)) < 0.5, np.sign(w), w) * peak.wbar
    eps = rng.uniform(-1, 1, (steps, system.n_f)) * peak.epsbar
    d = rng.normal(size=(steps, system.D.shape[1]))
    x0 = rng.normal(size=n)
    xhat0 = x0 + rng.uniform(-1, 1, n) * spread[:n]
    f0 = rng.uniform(-1, 1, system.n_f) * spread[n:]
    T = np.eye(n) + system.E @ system.C
    errors = run_observer(system, jacobians, w, eps, d, x0, xhat0, f0)
    return errors, np.concatenate([np.abs(T @ (x0 - xhat0)), np.abs(f0)])


class TestTransient:
    spread = np.array([5.0, 5.0, 25.0, 5.0, 1.0, 1.0])

    @pytest.mark.parametrize("seed", range(4))
    def test_every_instant_is_inside(self, tanks, peak, seed):
        errors, start = random_run(tanks, peak, np.random.default_rng(seed), 2000, self.spread)
        bounds = transient(peak, start, steps=300)
        for k, error in enumerate(np.abs(errors)):
            assert np.all(error <= bounds.half_widths(k))
            if k:
                tail = peak.steady + bounds.c * bounds.decay**k
                assert np.all(error <= tail)

    def test_a_set_one_step_late_is_not_enough(self, tanks, peak):
        errors, start = random_run(tanks, peak, np.random.default_rng(0), 10, self.spread)
        bounds = transient(peak, start, steps=20)
        late = [np.all(np.abs(errors[k]) <= bounds.half_widths(k + 1)) for k in range(10)]
        assert not all(late)

    def test_without_the_transient_the_start_is_outside(self, tanks, peak):
        errors, _ = random_run(tanks, peak, np.random.default_rng(0), 50, self.spread)
        assert np.any(np.abs(errors) > peak.steady)

    def test_vertices_come_close(self, tanks, peak, worst):
        start = np.array([5, 5, 25, 5, 0, 0.0])
        beta = transient(peak, start, steps=1001).beta
        corners = np.indices((2,) * 4).reshape(4, -1)
        matrices = [paper_matrix(tanks, tanks.ranges[range(4), c]) for c in corners.T]
        for k, share in ((1, 0.999), (10, 0.95), (100, 0.9), (1000, 0.5)):
            reached = np.max(
                [np.abs(np.linalg.matrix_power(M, k)) @ start for M in matrices], axis=0
            )
            assert np.all(reached <= beta[k])
            assert reached[3] > share * beta[k, 3]


class TestRoundingOfTheRecursion:
    def test_is_covered_by_an_input_of_its_size(self, tanks):
        """What a coarse arithmetic adds in each step, chosen as badly as possible."""
        size = np.array([1e-3, 1e-3, 0.0, 1e-3, 1e-3, 1e-3])
        quiet = peak_bound(tanks, 1e-4 * WBAR, 1e-4 * EPSBAR)
        covered = peak_bound(tanks, 1e-4 * WBAR, 1e-4 * EPSBAR, rounding=size)
        s = np.tile(tanks.ranges.mean(axis=1), (STEPS, 1))
        _, _, adjoint = worst_disturbances(quiet, 3, s)
        # what is added to z and fhat is taken from the errors
        noise = -np.sign(np.vstack([adjoint[1:], adjoint[-1:]])) * size
        zero, none = np.zeros(4), np.zeros((STEPS, 3))
        still = np.tile(jacobian(tanks, s[0]), (STEPS, 1, 1))
        errors = run_observer(
            tanks, still, none, none[:, :2], none[:, :1], zero, zero, np.zeros(2), noise
        )
        assert errors[-1, 3] > 10 * quiet.steady[3]
        assert np.all(np.abs(errors) <= covered.steady)
        assert errors[-1, 3] > 0.25 * covered.steady[3]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 10_000),
    n=st.integers(2, 4),
    n_f=st.integers(0, 1),
    q=st.integers(0, 1),
    kinds=st.lists(st.sampled_from(["entry", "row", "column", "full"]), max_size=3),
    radius=st.sampled_from([0.0, 0.01]),
)
def test_random_plants(seed, n, n_f, q, kinds, radius):
    """Everything measured or not, with and without decoupling, for Jacobians of any shape."""
    rng = np.random.default_rng(seed)
    m = int(rng.integers(q + n_f + 1 if n > q + n_f else n, n + 1))
    C = np.eye(n)[:m] + 0.2 * rng.normal(size=(m, n))
    D, B_f = rng.normal(size=(n, q)), rng.normal(size=(n, n_f))
    A = rng.normal(size=(n, n)) * 0.4 / np.sqrt(n)
    data = {
        "A": A,
        "B_f": B_f,
        "C": C,
        "D": D,
        "W1": rng.normal(size=(n, 2)),
        "W2": rng.normal(size=(m, 2)),
        "constant": 0.05 * rng.normal(size=(n, n)),
        "radius": np.full((n, n), radius),
    }
    masks = {
        "entry": np.eye(n)[:, :1] * np.eye(n)[1:2],
        "row": np.eye(n)[:, :1] * np.ones((1, n)),
        "column": np.ones((n, 1)) * np.eye(n)[1:2],
        "full": np.ones((n, n)),
    }
    data["directions"] = np.array([rng.normal(size=(n, n)) * masks[k] for k in kinds]).reshape(
        -1, n, n
    )
    data["ranges"] = np.sort(rng.uniform(-0.08, 0.08, (len(kinds), 2)), axis=1)
    system = peak_system(**data, K=np.zeros((n, m)), F=np.zeros((n_f, m)))
    T = np.eye(n) + system.E @ C
    gain_f = 0.5 * np.linalg.pinv(C @ T @ B_f) if n_f else np.zeros((0, m))
    K_used, F_used = projected_gains(0.5 * T @ A @ np.linalg.pinv(C), gain_f, system.E, C)
    system = system.with_gains(K_used, F_used)
    # the simulation rounds, too: its l1 response is part of the bound
    rounding = np.full(n + n_f, 1e-12)
    try:
        peak = peak_bound(system, [0.1, 0.2], [0.05] * n_f, rounding=rounding, dbar=[10.0] * q)
    except InfeasibleDesign:
        assume(False)
    errors, start = random_run(system, peak, rng, 60, np.ones(n + n_f))
    bounds = transient(peak, start)
    for k, error in enumerate(np.abs(errors)):
        assert np.all(error <= bounds.half_widths(k))
    reached = attained(peak)
    assert np.all(reached.peaks <= peak.steady)
    if not kinds and not radius:
        np.testing.assert_allclose(reached.peaks, peak.steady, rtol=1e-8)
    steps = min(reached.steps, 1000)
    for output in range(n + n_f):
        s = np.tile(reached.scheduling[output], (steps, 1)).reshape(steps, -1)
        w, eps, _ = worst_disturbances(peak, output, s)
        errors = from_rest(system, s, w, eps)
        assert np.all(np.abs(errors) <= peak.steady)
        if steps == reached.steps:
            assert errors[-1, output] > reached.peaks[output] * (1 - 1e-6)
