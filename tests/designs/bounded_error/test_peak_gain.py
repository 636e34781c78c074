"""Gains that minimise the peak bounds: what is reached, that it is proved, and refusals."""

import json
from decimal import Decimal
from pathlib import Path

import numpy as np
import pytest

from obsynth.designs.bounded_error.peak import gain as peak_gain_module
from obsynth.designs.bounded_error.peak.attained import attained
from obsynth.designs.bounded_error.peak.bound import peak_bound, prove_peak
from obsynth.designs.bounded_error.peak.gain import PeakGain, peak_gain
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system, projected_gains
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.general.responses import absolute_sums
from obsynth.symbolic.errors import ObsynthError

REFERENCE = json.loads(
    (Path(__file__).parents[2] / "reference" / "bounded_error_uio.json").read_text()
)
WBAR, EPSBAR = np.full(3, 0.1), np.full(2, 0.05)
K = [[0.3279, 0.0012, 0], [0.0023, 0.2659, 0], [0, 0, 0], [0.2222, 0.0008, 0]]
F = [[0.6766, 0.0023, 0], [-0.0042, 0.6263, 0]]


@pytest.fixture(scope="module")
def tanks() -> PeakSystem:
    model = REFERENCE["model"]
    e = np.eye(4)
    columns = [e[0], e[1], e[2] - e[0], e[3] - e[1]]
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
        ranges=np.column_stack([np.diag(model["Jmin"]), np.diag(model["Jmax"])]),
    )


@pytest.fixture(scope="module")
def design(tanks: PeakSystem) -> PeakGain:
    return peak_gain(tanks, WBAR, EPSBAR)


class TestTanks:
    def test_beats_the_sum_reached_by_hand(self, design):
        assert abs(design.start_value - 3.69640530) < 1e-6
        assert design.value <= 3.27369
        assert design.value / 24.32 <= 0.1346

    def test_is_proved_for_the_gains_as_stored(self, tanks, design):
        assert design.bound.system.K is not tanks.K
        np.testing.assert_array_equal(design.bound.system.K, design.K)
        assert design.value == np.sum(design.bound.steady)
        again = tanks.with_gains(design.K, design.F)
        assert prove_peak(again, WBAR, EPSBAR, design.bound.b).slack.min() >= 0
        assert np.all(attained(design.bound).peaks <= design.bound.steady)

    def test_gains_are_short_decimals_of_the_right_form(self, tanks, design):
        for gain in (design.K, design.F):
            for value in gain.ravel():
                assert Decimal(repr(float(value))).as_tuple().exponent >= -6
        assert not np.any(design.K[2]) and not np.any(design.K[:, 2])
        assert not np.any(design.F[:, 2])
        K_used, F_used = projected_gains(design.K, design.F, tanks.E, tanks.C)
        np.testing.assert_array_equal(K_used, design.K)
        np.testing.assert_array_equal(F_used, design.F)

    def test_no_neighbour_is_better(self, tanks, design):
        rng = np.random.default_rng(1)
        for _ in range(20):
            shift = 1e-3 * rng.normal(size=(6, 3))
            near = projected_gains(design.K + shift[:4], design.F + shift[4:], tanks.E, tanks.C)
            value = np.sum(peak_bound(tanks.with_gains(*near), WBAR, EPSBAR).steady)
            assert value > design.value * (1 - 1e-4)

    def test_from_the_gains_of_an_ellipsoidal_design(self, tanks):
        gain = np.array(REFERENCE["base"]["Kbar"])
        start = tanks.with_gains(gain[:4], gain[4:])
        found = peak_gain(start, WBAR, EPSBAR, starts=2)
        assert found.start_value > 4
        assert found.value <= 3.2738

    def test_weights(self, tanks, design):
        found = peak_gain(tanks, WBAR, EPSBAR, weights=[1, 1, 1, 1, 0, 0], starts=2)
        assert np.sum(found.bound.steady[:4]) < np.sum(design.bound.steady[:4]) - 0.02
        assert found.value == pytest.approx(np.sum(found.bound.steady[:4]), rel=1e-15)

    def test_same_seed_same_gains(self, tanks):
        seen: list[float] = []
        first, second = (
            peak_gain(tanks, WBAR, EPSBAR, starts=3, evaluations=500, progress=seen.append)
            for _ in range(2)
        )
        np.testing.assert_array_equal(first.K, second.K)
        assert seen[-1] == 1.0 and seen == sorted(seen[: len(seen) // 2]) * 2


class TestSearch:
    def test_value_is_the_bound(self, tanks):
        """The fast sums agree with the proved ones, for gains near and far."""
        search = peak_gain_module._Search(peak_bound(tanks, WBAR, EPSBAR), np.ones(6))
        rng = np.random.default_rng(0)
        origin = search.coordinates(tanks.K, tanks.F)
        for _ in range(5):
            point = search.neighbour(origin, rng)
            system = tanks.with_gains(*search.gains(point))
            proved = np.sum(peak_bound(system, WBAR, EPSBAR).steady)
            assert search.value(point) == pytest.approx(proved, rel=1e-6)

    @pytest.mark.parametrize("wanted", [1, 5, 31, 100])
    def test_batched_sums(self, wanted):
        rng = np.random.default_rng(wanted)
        matrix, inputs = 0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
        outputs = rng.normal(size=(4, 3))
        fast = absolute_sums(matrix, inputs, outputs, wanted).total
        steps = 4
        while steps < wanted:
            steps *= 2
        direct = sum(
            np.abs(outputs @ np.linalg.matrix_power(matrix, k) @ inputs) for k in range(steps)
        )
        np.testing.assert_allclose(fast, direct, rtol=1e-12)

    def test_derivative_of_the_sums(self):
        rng = np.random.default_rng(7)
        matrix, inputs = 0.4 * rng.normal(size=(3, 3)), rng.normal(size=(3, 2))
        outputs, weights = rng.normal(size=(4, 3)), rng.uniform(size=(4, 2))
        bars = absolute_sums(matrix, inputs, outputs, 31).derivative(weights)
        step = 1e-7
        for which, bar in enumerate(bars):
            for entry in np.ndindex(bar.shape):
                ends = []
                for sign in (1, -1):
                    data = [matrix.copy(), inputs.copy()]
                    data[which][entry] += sign * step
                    ends.append((weights * absolute_sums(*data, outputs, 31).total).sum())
                assert bar[entry] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=1e-5)

    def test_rotated_unknown_input(self):
        """T and Pi have no zeros here; the gains keep the form T K Pi, F Pi."""
        rng = np.random.default_rng(3)
        A = 0.5 * np.eye(3) + 0.1 * rng.normal(size=(3, 3))
        system = peak_system(
            A=A,
            B_f=np.zeros((3, 0)),
            C=np.eye(3) + 0.2 * rng.normal(size=(3, 3)),
            D=[[1.0], [2.0], [-1.0]],
            W1=np.eye(3),
            W2=0.1 * np.eye(3),
            K=0.1 * np.eye(3),
            F=np.zeros((0, 3)),
            constant=np.zeros((3, 3)),
            directions=[np.diag([1.0, -1.0, 0.0])],
            ranges=[[-0.1, 0.1]],
        )
        found = peak_gain(system, np.ones(3), [], dbar=[1e3], starts=2)
        assert found.value < found.start_value * 0.9
        K_used, _ = projected_gains(found.K, found.F, system.E, system.C)
        np.testing.assert_allclose(found.K, K_used, atol=1e-12)
        assert found.bound.check().slack.min() >= 0


class TestRefusals:
    def test_unstable_start(self, tanks):
        start = tanks.with_gains(np.array(K), -np.array(F))
        with pytest.raises(InfeasibleDesign, match="spectral radius") as caught:
            peak_gain(start, WBAR, EPSBAR)
        assert caught.value.spectral_radius > 1

    def test_start_without_small_gain(self, tanks):
        wide = peak_system(**{**tanks.data, "ranges": 3 * tanks.ranges})
        with pytest.raises(InfeasibleDesign, match="small-gain") as caught:
            peak_gain(wide, WBAR, EPSBAR)
        assert caught.value.rho > 1

    def test_useless_part_of_the_start_does_not_matter(self, tanks):
        useless = np.zeros((4, 3))
        useless[2] = 5.0
        start = tanks.with_gains(np.array(K) + useless, F)
        with pytest.raises(InfeasibleDesign):
            peak_bound(start, WBAR, EPSBAR)
        found = peak_gain(start, WBAR, EPSBAR, starts=1, evaluations=1)
        assert found.value < found.start_value

    @pytest.mark.parametrize("weights", [[1.0] * 5, [-1.0] * 6])
    def test_weights(self, tanks, weights):
        with pytest.raises(ObsynthError, match="weights"):
            peak_gain(tanks, WBAR, EPSBAR, weights=weights)
