"""Peak bounds of the four tanks against the published numbers, their proof, and refusals."""

import dataclasses
import json
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob
from obsynth.derive.rigour import Enclosure
from obsynth.designs.bounded_error.peak import bound as peak_bound_module
from obsynth.designs.bounded_error.peak.attained import attained
from obsynth.designs.bounded_error.peak.bound import (
    PeakBound,
    peak_bound,
    prove_peak,
    small_gain_solution,
)
from obsynth.designs.bounded_error.peak.design import _unknown_input_bound
from obsynth.designs.bounded_error.peak.system import PeakSystem, peak_system, projected_gains
from obsynth.designs.bounded_error.peak.transient import Transient, transient
from obsynth.designs.core.errors import CertificateError, InfeasibleDesign
from obsynth.designs.general.responses import power_sum, response
from obsynth.symbolic.errors import ObsynthError

REFERENCE = Path(__file__).parents[2] / "reference" / "bounded_error_uio.json"
WBAR, EPSBAR = np.full(3, 0.1), np.full(2, 0.05)
K = [[0.3279, 0.0012, 0], [0.0023, 0.2659, 0], [0, 0, 0], [0.2222, 0.0008, 0]]
F = [[0.6766, 0.0023, 0], [-0.0042, 0.6263, 0]]
XIBAR_0 = [5.0, 5.0, 25.0, 5.0, 0.0, 0.0]


def tank_data() -> dict[str, object]:
    model = json.loads(REFERENCE.read_text())["model"]
    low, high = np.array(model["Jmin"]), np.array(model["Jmax"])
    e = np.eye(4)
    # one level enters two rows: m13 = -m33, m24 = -m44
    columns = [e[0], e[1], e[2] - e[0], e[3] - e[1]]
    return {
        "A": model["A"],
        "B_f": model["B"],
        "C": e[:3],
        "D": e[:, [2]],
        "W1": np.zeros((4, 3)),
        "W2": np.eye(3),
        "K": K,
        "F": F,
        "constant": np.zeros((4, 4)),
        "directions": [np.outer(b, c) for b, c in zip(columns, e, strict=True)],
        "ranges": np.column_stack([np.diag(low), np.diag(high)]),
    }


@pytest.fixture(scope="module")
def tanks() -> PeakSystem:
    return peak_system(**tank_data())


@pytest.fixture(scope="module")
def peak(tanks: PeakSystem) -> PeakBound:
    return peak_bound(tanks, WBAR, EPSBAR)


@pytest.fixture(scope="module")
def start(peak: PeakBound) -> Transient:
    return transient(peak, XIBAR_0, steps=1001)


def digits(text: str) -> np.ndarray:
    return np.array([float(word) for word in text.split()])


def agrees(value: np.ndarray, text: str) -> bool:
    """Equal to the digits given; bounds are rounded up, so one unit of the last digit more."""
    places = max(len(word.partition(".")[2]) for word in text.split())
    return bool(np.all(np.abs(np.asarray(value) - digits(text)) <= 0.50001 * 10.0**-places))


class TestPublishedNumbers:
    def test_channels(self, tanks):
        assert agrees(tanks.channels.radii, ".00194698 .00122372 .00974959 .00612783")
        assert tanks.channels.columns.T.tolist() == [
            [1, 0, 0, 0],
            [0, 1, 0, 0],
            [-1, 0, 1, 0],
            [0, -1, 0, 1],
        ]

    def test_n(self, peak):
        assert agrees(peak.n, ".23283510 .23798845 .10000000 .31025503 .75174791 .88902338")
        assert agrees(np.sum(peak.n), "2.52184987")

    def test_b(self, peak):
        assert agrees(peak.steady, ".23985572 .28211696 .10000000 1.12410313 .77555366 1.17477582")
        assert agrees(np.sum(peak.steady), "3.69640530")

    def test_ratio_to_the_repaired_printed_condition(self, peak):
        assert round(float(np.sum(peak.steady)) / 24.32, 3) == 0.152

    def test_rho(self, peak):
        assert agrees(peak.rho, ".6345487807")
        assert peak.rho <= peak.proof.small_gain < 1

    def test_responses_of_level_1(self, peak):
        row = np.concatenate([peak.Hw[0], peak.He[0], peak.Hp[0, [0, 2, 1, 3]]])
        expected = "1.46066108 .00663675 .07278249 1.56921652 .00732486 4.73674696 4.73674696"
        assert agrees(row, expected + " .02537129 .02637685")

    def test_responses_of_level_4(self, peak):
        row = np.concatenate([peak.Hw[3], peak.He[3], peak.Hp[3, [0, 2, 1, 3]]])
        expected = "1.24114331 .00449310 1.07183758 1.56235311 .00779957 69.75611345 69.75611345"
        assert agrees(row, expected + " .01766714 103.54602062")

    def test_attained_by_a_constant_vertex(self, peak):
        worst = attained(peak)
        assert agrees(worst.peaks, ".238914 .244833 .100000 .715622 .770373 .933383")
        assert agrees(np.sum(worst.peaks), "3.003125")
        assert np.all(worst.peaks <= peak.steady)
        corners = (worst.scheduling == peak.system.ranges[:, 0]) | (
            worst.scheduling == peak.system.ranges[:, 1]
        )
        assert corners.all()

    @pytest.mark.parametrize(
        ("k", "expected"),
        [
            (1, "3.977597 3.750380 .000000 6.097351 3.394500 3.152500"),
            (10, "1.297929 1.485901 .000000 9.378144 5.544723 8.515422"),
            (100, ".001093 .245908 .000000 6.200101 .002023 1.939678"),
            (1000, ".000045 .010204 .000000 .257281 .000084 .080489"),
        ],
    )
    def test_transient(self, start, k, expected):
        assert agrees(start.beta[k], expected)

    def test_remainder_of_the_sums(self, peak):
        assert peak.proof.remainder < 3.2e-13

    def test_entrywise_intervals_are_wider(self):
        data = tank_data()
        ranges, directions = [], []
        for k, direction in enumerate(data["directions"]):
            for i, j in np.argwhere(direction):
                single = np.zeros((4, 4))
                single[i, j] = direction[i, j]
                directions.append(single)
                ranges.append(data["ranges"][k])
        entrywise = peak_system(**{**data, "directions": directions, "ranges": ranges})
        assert len(entrywise.channels) == 6
        assert agrees(np.sum(peak_bound(entrywise, WBAR, EPSBAR).steady), "3.733")

    def test_third_level_is_its_own_noise(self, tanks, peak):
        """The decoupling is exact here: T, Pi and T D carry no rounding at all."""
        assert not np.any(tanks.T.rad) and not np.any(tanks.residual)
        assert not np.any(tanks.A0.mid[2]) and not np.any(tanks.A0.rad[2])
        assert 0.1 <= peak.steady[2] < 0.1 + 1e-12


class TestCertificate:
    def test_holds_in_exact_arithmetic(self, peak):
        b, n = ([Fraction(float(v)) for v in vector] for vector in (peak.b, peak.n))
        for i, row in enumerate(peak.G):
            image = n[i] + sum(Fraction(float(g)) * x for g, x in zip(row, b, strict=True))
            assert image + Fraction(float(peak.proof.slack[i])) <= b[i]
        coupled = np.any(peak.system.seen, axis=0)
        assert np.all(peak.b > 0)
        assert np.all((peak.G @ peak.b)[coupled] < peak.b[coupled])

    def test_check_repeats_the_proof_from_the_data(self, peak):
        proof = peak.check()
        assert proof.slack.tolist() == peak.proof.slack.tolist()
        assert np.all(proof.slack >= 0)

    @pytest.mark.parametrize("output", range(6))
    def test_no_bound_can_be_lowered(self, peak, output):
        b = peak.b.copy()
        b[output] *= 1 - 1e-9
        with pytest.raises(CertificateError) as caught:
            dataclasses.replace(peak, b=b).check()
        assert caught.value.shortfall > 0

    def test_without_the_feedthrough(self, tanks, peak):
        """Mutant: |D_w| left out."""
        zero = Enclosure(np.zeros_like(tanks.D_w.mid), np.zeros_like(tanks.D_w.rad))
        mutant = peak_bound(dataclasses.replace(tanks, D_w=zero), WBAR, EPSBAR)
        assert mutant.b[2] < 1e-9
        with pytest.raises(CertificateError):
            mutant.check()

    def test_with_a_sign_wrong_in_a_channel(self, tanks, peak):
        """Mutant: b_4 = e4 + e2, as if what leaves tank 4 left tank 2 too."""
        mid = tanks.B_p.mid.copy()
        mid[1, 3] *= -1
        mutant = peak_bound(
            dataclasses.replace(tanks, B_p=Enclosure(mid, tanks.B_p.rad)), WBAR, EPSBAR
        )
        assert mutant.b[1] < peak.b[1] - 1e-3
        with pytest.raises(CertificateError):
            mutant.check()

    def test_with_too_little_noise(self, tanks, peak):
        """Mutant: wbar of another sensor."""
        mutant = peak_bound(tanks, 0.99 * WBAR, EPSBAR)
        with pytest.raises(CertificateError, match="not proved"):
            prove_peak(tanks, WBAR, EPSBAR, mutant.b)
        assert prove_peak(tanks, 0.99 * WBAR, EPSBAR, peak.b).slack.min() > 0

    def test_with_the_sum_begun_one_late(self, tanks, monkeypatch):
        """Mutant: the response at k = 0 left out."""

        def late(powers, outputs, B):
            right = response(powers, outputs, B)
            return dataclasses.replace(right, total=right.total - right.terms[0])

        with monkeypatch.context() as patch:
            patch.setattr(peak_bound_module, "response", late)
            mutant = peak_bound(tanks, WBAR, EPSBAR)
        with pytest.raises(CertificateError):
            mutant.check()

    def test_with_jacobians_of_a_smaller_domain(self, tanks):
        """Mutant: level 4 bounded over half of its range."""
        data = tank_data()
        data["ranges"][3] *= 0.5
        mutant = peak_bound(peak_system(**data), WBAR, EPSBAR)
        with pytest.raises(CertificateError):
            prove_peak(tanks, WBAR, EPSBAR, mutant.b)


class TestOptionalInputs:
    def test_rounding_adds_its_l1_response(self, tanks, peak):
        rounding = np.array([0, 0, 0, 1e-3, 0, 0])
        wider = peak_bound(tanks, WBAR, EPSBAR, rounding=rounding)
        powers = np.array([np.linalg.matrix_power(tanks.A0.mid, k) for k in range(6000)])
        expected = peak.n + np.abs(powers).sum(axis=0) @ rounding
        np.testing.assert_allclose(wider.n, expected, rtol=1e-8)
        assert np.all(wider.n >= peak.n)
        with pytest.raises(CertificateError):
            prove_peak(tanks, WBAR, EPSBAR, peak.b, rounding=rounding)

    def test_radius_of_the_family_equals_channels_for_every_entry(self, peak):
        data = tank_data()
        small = peak_bound(peak_system(**data, radius=np.full((4, 4), 1e-5)), WBAR, EPSBAR)
        entries = [np.outer(np.eye(4)[i], np.eye(4)[j]) for i in range(4) for j in range(4)]
        data["directions"] = [*data["directions"], *entries]
        data["ranges"] = np.vstack([data["ranges"], np.tile([-1e-5, 1e-5], (16, 1))])
        channels = peak_bound(peak_system(**data), WBAR, EPSBAR)
        np.testing.assert_allclose(small.b, channels.b, rtol=1e-9)
        assert np.all(small.b[[0, 1, 3]] > 1.0001 * peak.b[[0, 1, 3]])

    def test_a_box_of_w_counts_by_its_larger_side(self, tanks, peak):
        box = np.array([[-0.1, 0.05], [-0.1, 0.1], [0.0, 0.1]])
        assert peak_bound(tanks, box, EPSBAR).b.tolist() == peak.b.tolist()

    def test_inexact_decoupling_needs_a_bound_of_d(self):
        data = tank_data()
        data["D"] = np.array([[0.0], [0.1], [0.3], [0.0]])
        data["K"] = np.diag([0.3, 0.2, 0, 0])[:, :3]
        data["F"] = np.zeros((0, 3))
        data["B_f"] = np.zeros((4, 0))
        system = peak_system(**data)
        assert 0 < np.max(system.residual) < 1e-15
        with pytest.raises(ObsynthError, match="dbar"):
            peak_bound(system, WBAR, [])
        tight = peak_bound(system, WBAR, [], dbar=[1.0])
        wide = peak_bound(system, WBAR, [], dbar=[1e9])
        assert np.all(tight.steady <= wide.steady)
        assert np.sum(wide.steady) < np.sum(tight.steady) + 1e-4


class TestFamilies:
    def test_a_row_direction_is_bounded_as_one_combination(self):
        """g = phi(x1 - x2) sees the difference, not two errors of their own."""
        data = {
            "A": [[0.6, 0.2], [0.3, 0.5]],
            "B_f": [[], []],
            "C": [[1.0, 0.0]],
            "D": [[], []],
            "W1": [[0.1], [0.1]],
            "W2": [[0.0]],
            "K": [[0.1], [0.0]],
            "F": np.zeros((0, 1)),
            "constant": np.zeros((2, 2)),
            "ranges": [[-0.2, 0.2]],
        }
        one = peak_bound(peak_system(**data, directions=[[[1.0, -1.0], [0.0, 0.0]]]), [1.0], [])
        assert one.system.outputs[2].tolist() == [1.0, -1.0]
        split = {**data, "ranges": [[-0.2, 0.2]] * 2}
        columns = [[[1.0, 0.0], [0.0, 0.0]], [[0.0, -1.0], [0.0, 0.0]]]
        two = peak_bound(peak_system(**split, directions=columns), [1.0], [])
        assert np.all(one.steady[:2] < two.steady[:2])
        assert one.b[2] < two.b[0] + two.b[1]
        assert one.check().slack.min() >= 0

    def test_a_direction_of_higher_rank_becomes_its_columns(self, tanks):
        direction = np.array([[1.0, 0, 0, 0], [0, 0, 0, 2.0], [0, 0, 0, 0], [0, 0, 0, 3.0]])
        system = peak_system(**{**tank_data(), "directions": [direction], "ranges": [[0.0, 0.5]]})
        assert system.channels.source.tolist() == [0, 0]
        parts = system.channels.columns @ system.channels.rows
        np.testing.assert_array_equal(parts, direction)
        assert np.all(system.channels.radii >= 0.25)

    def test_scaled_rank_one_is_found_exactly(self, tanks):
        direction = np.outer([1.0, 2.0, 0.0, -3.0], [0.5, 0.0, 1.0, 4.0])
        system = peak_system(**{**tank_data(), "directions": [direction], "ranges": [[0.0, 0.5]]})
        assert len(system.channels) == 1
        parts = system.channels.columns @ system.channels.rows
        np.testing.assert_array_equal(parts, direction)

    def test_fixed_parameters_make_no_channel(self, tanks):
        data = tank_data()
        data["ranges"][0] = [0.003, 0.003]
        assert peak_system(**data).channels.source.tolist() == [1, 2, 3]


class TestRefusals:
    def test_unstable(self, tanks):
        with pytest.raises(InfeasibleDesign, match="spectral radius") as caught:
            peak_bound(tanks.with_gains(np.zeros((4, 3)), np.zeros((2, 3))), WBAR, EPSBAR)
        assert caught.value.spectral_radius >= 1

    def test_small_gain(self):
        data = tank_data()
        data["ranges"][3] = [-0.02, 0.02]
        with pytest.raises(InfeasibleDesign, match="state 4") as caught:
            peak_bound(peak_system(**data), WBAR, EPSBAR)
        assert caught.value.rho > 1

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"C": np.eye(4)[[0, 1, 3]]}, "rank"),
        ],
    )
    def test_data(self, change, words):
        with pytest.raises(ObsynthError, match=words):
            peak_system(**{**tank_data(), **change})

    @pytest.mark.parametrize("wbar", [[0.1, 0.1], [0.1, 0.1, -0.1], [0.1, 0.1, np.inf]])
    def test_bounds(self, tanks, wbar):
        with pytest.raises(ObsynthError, match="wbar"):
            peak_bound(tanks, wbar, EPSBAR)


class TestTransient:
    def test_the_tail_covers_what_is_known(self, peak, start):
        short = transient(peak, XIBAR_0, steps=300, decay=start.decay)
        for k in range(1, 1001):
            tail = short.c * short.decay**k
            # beta carries a rounding error that does not decay
            assert np.all(start.beta[k] <= tail * (1 + 1e-9) + 1e-12)

    def test_more_known_instants_make_a_smaller_tail(self, peak, start):
        few, many = (transient(peak, XIBAR_0, steps=n, decay=0.9972) for n in (10, 1000))
        assert np.sum(many.c) < 0.5 * np.sum(few.c)

    def test_choice_of_the_decay(self, peak):
        chosen = transient(peak, XIBAR_0)
        cost = np.sum(chosen.c / peak.b) / (1 - chosen.decay)
        for decay in (0.9966, 0.997, 0.9985, 0.9995):
            other = transient(peak, XIBAR_0, steps=len(chosen.beta), decay=decay)
            assert cost <= np.sum(other.c / peak.b) / (1 - decay) * 1.01

    def test_check(self, start):
        assert start.check() > 0
        with pytest.raises(CertificateError, match="c"):
            dataclasses.replace(start, c=start.c * (1 - 1e-9)).check()
        with pytest.raises(CertificateError, match="beta"):
            dataclasses.replace(start, beta=start.beta * (1 - 1e-9)).check()
        shifted = np.vstack([start.beta[1:], start.beta[-1:]])
        with pytest.raises(CertificateError, match="beta"):
            dataclasses.replace(start, beta=shifted).check()
        with pytest.raises(CertificateError, match="c"):
            dataclasses.replace(start, decay=start.decay - 1e-6).check()

    def test_a_decay_that_nothing_guarantees(self, peak, start):
        with pytest.raises(InfeasibleDesign) as caught:
            transient(peak, XIBAR_0, decay=0.9960)
        assert 0.9960 < caught.value.slowest < 0.9966
        with pytest.raises(InfeasibleDesign, match=r"no decay of 0\.996"):
            dataclasses.replace(start, decay=0.9960).check()

    def test_the_recursion_of_a_step_stays_above(self, start):
        value = start.c[3]
        for k in range(1, 2001):
            value *= start.step_decay
            if k % 500 == 0:
                exact = Fraction(float(start.c[3])) * Fraction(start.decay) ** k
                assert exact <= Fraction(float(value)) <= exact * (1 + Fraction(1, 10**11))

    def test_half_widths(self, peak, start):
        np.testing.assert_allclose(start.half_widths(0), peak.steady + XIBAR_0, rtol=1e-9)
        np.testing.assert_allclose(start.half_widths(100_000), peak.steady, rtol=1e-9)
        assert np.all(start.half_widths(5000) > peak.steady)

    @pytest.mark.parametrize("xibar_0", [[1.0] * 5, [-1.0] * 6, [np.nan] * 6])
    def test_refusals(self, peak, xibar_0):
        with pytest.raises(ObsynthError, match="xibar_0"):
            transient(peak, xibar_0)

    def test_start_at_the_truth(self, peak):
        nothing = transient(peak, np.zeros(6), steps=50)
        assert np.all(nothing.beta < 1e-200) and np.all(nothing.c < 1e-200)


def exact_inverse(matrix: list[list[Fraction]]) -> list[list[Fraction]]:
    """Return the inverse by Gauss-Jordan elimination."""
    size = len(matrix)
    table = [[*row, *(Fraction(int(i == j)) for j in range(size))] for i, row in enumerate(matrix)]
    for i in range(size):
        pivot = next(r for r in range(i, size) if table[r][i])
        table[i], table[pivot] = table[pivot], table[i]
        table[i] = [value / table[i][i] for value in table[i]]
        for r in range(size):
            if r != i:
                table[r] = [a - table[r][i] * b for a, b in zip(table[r], table[i], strict=True)]
    return [row[size:] for row in table]


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    values=st.lists(st.floats(0, 1), min_size=9, max_size=9),
    radius=st.sampled_from([0.0, 1e-9]),
    norm=st.sampled_from([0.3, 0.9, 0.99]),
    unit=st.sampled_from([1.0, 1e8]),
)
def test_sums_of_powers_are_above_the_exact_ones(values, radius, norm, unit):
    """For A >= 0 the sum of all powers is (I - A)^-1, computed here in fractions."""
    matrix = np.array(values).reshape(3, 3)
    matrix *= norm / max(matrix.sum(axis=1).max(), 1e-3)
    matrix[0, 1:] *= unit
    matrix[1:, 0] /= unit
    rad = radius * matrix
    sums = power_sum(Enclosure(matrix, rad))
    largest = [
        [
            Fraction(int(i == j)) - Fraction(float(a)) - Fraction(float(r))
            for j, (a, r) in enumerate(zip(row, rrow, strict=True))
        ]
        for i, (row, rrow) in enumerate(zip(matrix, rad, strict=True))
    ]
    exact = exact_inverse(largest)
    total = response(sums, np.eye(3), Enclosure.of(np.eye(3))).total
    for bound in (sums.bound, total):
        for i in range(3):
            for j in range(3):
                assert exact[i][j] <= Fraction(float(bound[i, j]))
        expected = np.array([[float(x) for x in row] for row in exact])
        # the fourth power of the remainder stands in every entry
        scale = np.array([[1, unit, unit], [1 / unit, 1, 1], [1 / unit, 1, 1]])
        np.testing.assert_allclose(bound / scale, expected / scale, 1e-10 + 1e5 * radius, 1e-22)


def test_the_naive_sum_is_not_a_bound():
    """Mutant: the plain sum of computed powers falls below the exact value."""
    matrix = np.array([[0.9, 0.05], [0.03, 0.7]])
    naive = sum(np.linalg.matrix_power(matrix, k) for k in range(2000))
    one = [
        [Fraction(int(i == j)) - Fraction(float(matrix[i, j])) for j in range(2)] for i in range(2)
    ]
    exact = exact_inverse(one)
    sums = power_sum(Enclosure.of(matrix)).bound
    pairs = [(i, j) for i in range(2) for j in range(2)]
    assert any(Fraction(float(naive[i, j])) < exact[i][j] for i, j in pairs)
    assert all(Fraction(float(sums[i, j])) >= exact[i][j] for i, j in pairs)


def test_single_powers_are_within_their_error():
    matrix = np.array([[0.5, 0.25], [-0.125, 0.75]])
    sums = power_sum(Enclosure.of(matrix))
    power = [[Fraction(1), Fraction(0)], [Fraction(0), Fraction(1)]]
    entries = [[Fraction(float(v)) for v in row] for row in matrix]
    for k in range(200):
        computed = sums.powers[k] if k < sums.steps else np.zeros((2, 2))
        for i in range(2):
            for j in range(2):
                lost = abs(power[i][j] - Fraction(float(computed[i, j])))
                assert lost <= Fraction(float(sums.error[i, j]))
        power = [
            [sum(entries[i][m] * power[m][j] for m in range(2)) for j in range(2)] for i in range(2)
        ]
        power = [[Fraction(round(x * 2**200), 2**200) for x in row] for row in power]


@settings(max_examples=30, deadline=None, derandomize=True)
@given(
    values=st.lists(st.floats(0, 1), min_size=16, max_size=16),
    noise=st.lists(st.sampled_from([0.0, 1e-6, 1.0, 1e3]), min_size=4, max_size=4),
    norm=st.sampled_from([0.0, 0.5, 0.999]),
)
def test_small_gain_solutions_are_exact_supersolutions(values, noise, norm):
    G = np.array(values).reshape(4, 4)
    G *= norm / max(G.sum(axis=1).max(), 1e-3)
    n = np.array(noise)
    b = small_gain_solution(G, n)
    for i in range(4):
        image = Fraction(n[i]) + sum(Fraction(G[i, j]) * Fraction(b[j]) for j in range(4))
        assert image <= Fraction(b[i])
    np.testing.assert_allclose(b, np.linalg.solve(np.eye(4) - G, n), rtol=1e-8, atol=1e-250)


def test_projection_of_the_gains_changes_nothing_after_the_first_instant(tanks):
    full = np.array(K) + np.array([[0, 0, 7], [0, 0, -3], [0, 0, 0], [0, 0, 2.0]])
    wide = np.array(F) + np.array([[0, 0, 5], [0, 0, 1.0]])
    K_used, F_used = projected_gains(full, wide, tanks.E, tanks.C)
    np.testing.assert_array_equal(K_used, K)
    np.testing.assert_array_equal(F_used, F)


def test_an_unknown_input_counts_with_its_larger_end():
    """What rounding leaves of it in the error. Mutant: the smaller end of an uneven range."""
    plant = ob.Plant("uneven")
    x, z = plant.states("x z", range=(-1, 1))
    d, e, free = plant.unknown_inputs("d e free", range=[(-3, 1), (-1, 2), None])
    plant.dynamics([x / 2 + d + free, z / 2 + e], Ts=1)
    plant.outputs([x, z])
    design: Any = SimpleNamespace(plant=plant)
    assert _unknown_input_bound(design).tolist() == [3.0, 2.0, 0.0]
