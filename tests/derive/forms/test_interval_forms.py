"""Elementwise and centred forms: the three tanks and the LPV example of the interval papers."""

import json
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import DerivationError, UnboundedError
from obsynth.derive.forms.measured import read_measured, readings
from obsynth.derive.forms.quasi_lpv import elementwise as elementwise_module
from obsynth.derive.forms.quasi_lpv.build import quasi_lpv
from obsynth.derive.forms.quasi_lpv.elementwise import bound_elements
from obsynth.symbolic import Plant, plants

REFERENCE = Path(__file__).parents[2] / "reference"
A13 = A32 = 1.329e-4
A20 = 1.772e-4
S_C = 0.0154
LOW, HIGH = (0.44, 0.04, 0.24), (0.56, 0.16, 0.36)


def lam(z):
    return np.abs(z) ** -0.5


def printed(y1, y2):
    """A_m and A_M as the paper of Efimov, Raissi and Zolghadri prints them, below (20)."""
    m3, M3 = LOW[2], HIGH[2]

    def matrix(a, b):
        # a stands where the entries of A_m have x_M3 with y1 or x_m3 with y2, b at the other ends
        near, far = lam(y1 - a[0]), lam(a[1] - y2)
        other, away = lam(y1 - b[0]), lam(b[1] - y2)
        return np.array(
            [
                [-A13 * near, 0, A13 * other],
                [0, -A32 * far - A20 * lam(y2), A32 * away],
                [A13 * other, A32 * away, -A32 * far - A13 * near],
            ]
        )

    return (matrix((M3, m3), (m3, M3)) / S_C, matrix((m3, M3), (M3, m3)) / S_C)


@pytest.fixture(scope="module")
def tanks():
    return quasi_lpv(plants.three_tanks())


@pytest.fixture(scope="module")
def set_adaptive():
    return json.loads((REFERENCE / "set_adaptive.json").read_text())["part1"]


@pytest.fixture(scope="module")
def by_levels(tanks):
    return tanks.interval(measured=["x1", "x2"])


@pytest.fixture(scope="module")
def by_outputs(tanks):
    return tanks.interval(measured="outputs")


# -- three tanks --------------------------------------------------------------------


def test_three_tanks_the_eighteen_printed_entries(by_levels):
    rng = np.random.default_rng(3)
    for y1, y2 in rng.uniform((0.44, 0.04), (0.56, 0.16), (200, 2)):
        low, high = by_levels.at([y1, y2])["A"]
        A_m, A_M = printed(y1, y2)
        assert np.allclose(low, A_m, rtol=1e-12, atol=1e-16)
        assert np.allclose(high, A_M, rtol=1e-12, atol=1e-16)
        # rounded outwards, so never inside the printed values by more than their own rounding
        assert (low <= A_m + 1e-15 * np.abs(A_m)).all()
        assert (high >= A_M - 1e-15 * np.abs(A_M)).all()
    assert by_levels.how["A"][2, 2] == "termwise"
    assert set(by_levels.how["A"].ravel()) == {"known", "monotone", "termwise"}


def test_three_tanks_the_printed_functions_symbol_by_symbol(by_levels):
    x1, x2 = by_levels.arguments
    m3, M3 = sp.Rational(0.24), sp.Rational(0.36)
    lower = by_levels.A_lower * sp.Rational(154, 10**4) / sp.Rational(1329, 10**7)
    assert lower[0, 0] == -1 / sp.sqrt(sp.Abs(x1 - M3))
    assert lower[0, 2] == 1 / sp.sqrt(sp.Abs(x1 - m3))
    assert (
        sp.expand(
            lower[1, 1] + 1 / sp.sqrt(sp.Abs(x2 - m3)) + sp.Rational(4, 3) / sp.sqrt(sp.Abs(x2))
        )
        == 0
    )


def test_three_tanks_values_and_eigenvalues_of_the_note(by_levels, set_adaptive):
    low, high = by_levels.at([0.5, 0.1])["A"]
    assert low == pytest.approx(np.array(set_adaptive["Am_y0.5_0.1"]), rel=1e-12)
    assert high == pytest.approx(np.array(set_adaptive["AM_y0.5_0.1"]), rel=1e-12)
    gain = 3.0 * np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0]])
    for matrix, eigenvalues in (
        (low, [-3.05954633, -3.02316026, -0.04593733]),
        (high, [-3.05348832, -3.01710201, -0.03349467]),
    ):
        found = np.sort(np.linalg.eigvals(matrix - gain).real)
        assert found == pytest.approx(np.array(eigenvalues), abs=1e-7)
    largest = np.linalg.eigvals(high).real.max()
    assert largest == pytest.approx(0.00272165, abs=1e-7)


def test_three_tanks_least_and_largest_bounds_over_the_box(by_levels, set_adaptive):
    assert by_levels.A_min == pytest.approx(np.array(set_adaptive["Am_hull_lo"]), rel=1e-6)
    assert by_levels.A_max == pytest.approx(np.array(set_adaptive["AM_hull_hi"]), rel=1e-6)
    assert (by_levels.A_min <= np.array(set_adaptive["Am_hull_lo"]) + 1e-15).all()


def test_three_tanks_both_bounds_are_metzler(by_levels):
    for low_or_high in by_levels.at([0.47, 0.12])["A"]:
        off_diagonal = low_or_high[~np.eye(3, dtype=bool)]
        assert (off_diagonal >= 0.0).all()


def test_three_tanks_constant_bounds_are_tighter_where_the_functions_are_not(tanks, by_levels):
    constant = tanks.interval()
    assert constant.A_min[2, 2] > by_levels.A_min[2, 2] + 0.01
    assert constant.A_min[0, 0] == pytest.approx(by_levels.A_min[0, 0], rel=1e-6)


def samples(count):
    rng = np.random.default_rng(11)
    x = rng.uniform(LOW, HIGH, (count, 3))
    v = rng.uniform(-4.5e-3, 4.5e-3, (count, 2))
    return x, v


def matrix_at(x):
    l13, l32, l20 = lam(x[0] - x[2]), lam(x[2] - x[1]), lam(x[1])
    a, b, c = A13 * l13, A32 * l32, A20 * l20
    return np.array([[-a, 0, a], [0, -b - c, b], [a, b, -a - b]]) / S_C


def test_three_tanks_noise_breaks_the_printed_bounds_and_not_the_widened_ones(
    by_levels, by_outputs
):
    x, v = samples(2000)
    broken = 0
    for state, noise in zip(x, v, strict=True):
        true = matrix_at(state)
        y = np.clip(state[:2] + noise, LOW[:2], HIGH[:2])
        low, high = by_levels.at(y)["A"]
        broken += bool((true < low - 1e-15).any() or (true > high + 1e-15).any())
        low, high = by_outputs.at(state[:2] + noise)["A"]
        assert (low - 1e-15 <= true).all()
        assert (high + 1e-15 >= true).all()
    assert broken / len(x) == pytest.approx(0.115, abs=0.02)


def test_three_tanks_a_margin_covers_what_moves_between_samples(tanks, by_outputs):
    assert [str(a) for a in by_outputs.arguments] == ["y1", "y2"]
    wide = tanks.interval(measured="outputs", margin=1e-3)
    x, v = samples(300)
    for state, noise in zip(x, v, strict=True):
        y = state[:2] + noise
        low, high = wide.at(y + np.array([1e-3, -1e-3]))["A"]
        assert (low - 1e-15 <= matrix_at(state)).all()
        assert (high + 1e-15 >= matrix_at(state)).all()
        inner = by_outputs.at(y)["A"]
        outer = wide.at(y)["A"]
        assert (outer[0] <= inner[0]).all()
        assert (outer[1] >= inner[1]).all()
    exact = tanks.interval(measured=["x1", "x2"], margin=4.5e-3)
    for found, expected in zip(
        exact.at([0.5, 0.1])["A"], by_outputs.at([0.5, 0.1])["A"], strict=True
    ):
        np.testing.assert_allclose(found, expected, rtol=1e-12)
    with pytest.raises(DerivationError, match="margin"):
        tanks.interval(measured="outputs", margin=-1.0)


def test_three_tanks_outside_the_domain_is_reported_not_clipped(by_levels, by_outputs):
    with pytest.raises(DerivationError, match=r"x1 = 0\.36 is outside of \[0\.44, 0\.56\]"):
        by_levels.at([0.36, 0.1])
    inside = by_levels.function()
    assert float(inside([0.5, 0.1])[6]) == 1.0
    assert float(inside([0.43, 0.1])[6]) == 0.0
    # what a noisy but possible measurement shows is inside
    assert by_outputs.at([0.44 - 4.4e-3, 0.1])["A"][0].shape == (3, 3)
    with pytest.raises(DerivationError, match="y1"):
        by_outputs.at([0.44 - 4.6e-3, 0.1])
    with pytest.raises(DerivationError, match="one value for each of x1, x2"):
        by_levels.at([0.5])


def test_the_run_time_function_is_the_bound_up_to_rounding(by_levels):
    function = by_levels.function()
    names = [function.name_out(k) for k in range(function.n_out())]
    assert names[:2] == ["A_lower", "A_upper"]
    rng = np.random.default_rng(5)
    for y in rng.uniform((0.44, 0.04), (0.56, 0.16), (50, 2)):
        low, high = by_levels.at(y)["A"]
        found = [np.array(m) for m in function(y)[:2]]
        assert (low <= found[0]).all() or np.abs(low - found[0]).max() < 1e-16
        assert np.abs(high - found[1]).max() < 1e-15


def test_a_bound_at_the_wrong_end_is_seen(tanks, monkeypatch):
    right = elementwise_module._Bounder._at_ends

    def swapped(self, entry, signs):
        low, high = right(self, entry, signs)
        return high, low

    monkeypatch.setattr(elementwise_module._Bounder, "_at_ends", swapped)
    wrong = tanks.interval(measured=["x1", "x2"])
    low, high = wrong.at([0.5, 0.1])["A"]
    true = matrix_at((0.5, 0.1, 0.3))
    assert (true < low - 1e-6).any()
    assert (true > high + 1e-6).any()
    A_m, _ = printed(0.5, 0.1)
    assert not np.allclose(low, A_m, rtol=1e-3)


# -- bounds of other shapes ---------------------------------------------------------


@pytest.fixture
def mixed():
    plant = Plant("mixed")
    plant.states("x1:4", range=[(-2, 3), (1, 2), (-1, 1)])
    plant.params("k", range=(0.5, 1.5))
    plant.disturbances("w1:3", bound=[0.1, 0.2])
    x1, x2, x3 = (s.symbol for s in plant.x)
    w1, w2 = (s.symbol for s in plant.w)
    plant.dynamics([-x1, -x2, -x3])
    plant.outputs([-2 * x1 + w1 - 3 * w2, x2 + x3])
    return plant


@pytest.mark.parametrize(
    ("entry", "how"),
    [
        ("x1*x2", "range"),
        ("x1 + x2**2", "monotone"),
        ("x2**3 - x2**2*3 + x1", "termwise"),
        ("x1*sin(3*x3)", "range"),
        ("x1*x3*k", "range"),
        ("x1**2 + 1", "known"),
        ("exp(x3)*x1 - k", "range"),
    ],
)
def test_every_way_of_bounding_holds_pointwise(mixed, entry, how):
    symbols = {s.name: s.symbol for s in (*mixed.x, *mixed.p)}
    expression = sp.sympify(entry, locals=symbols)
    known = read_measured(mixed, ["x1"])
    found = bound_elements({(0, 0): expression}, mixed, known)
    order = [symbols[n] for n in ("x1", "x2", "x3", "k")]
    value = sp.lambdify(order, expression)
    low = sp.lambdify(order[:1], found.lower[(0, 0)])
    high = sp.lambdify(order[:1], found.upper[(0, 0)])
    rng = np.random.default_rng(2)
    box = [(-2, 3), (1, 2), (-1, 1), (0.5, 1.5)]
    for point in rng.uniform(*zip(*box, strict=True), (500, 4)):
        assert low(point[0]) - 1e-12 <= value(*point) <= high(point[0]) + 1e-12
    if how in ("known", "monotone", "termwise"):
        assert found.how[(0, 0)] == how
    else:
        assert found.how[(0, 0)] in ("termwise", "range")


def test_outputs_are_read_with_their_scale_and_noise(mixed):
    (reading,) = readings(mixed)
    assert (reading.output, reading.scale) == ("y1", -2)
    (known,) = read_measured(mixed, "outputs")
    y1 = known.argument
    # y = -2 x + w1 - 3 w2 with |w1| <= .1, |w2| <= .2: x within .35 of -y/2
    low, high = (e.subs(y1, -1) for e in known.ends)
    assert float(low) == pytest.approx(0.15)
    assert float(high) == pytest.approx(0.85)
    assert (known.lower, known.upper) == pytest.approx((-6.7, 4.7))
    # clipped to the box, inside of which the state is known to be
    assert float(known.ends[0].subs(y1, sp.Rational(47, 10))) == -2.0


@pytest.mark.parametrize(
    ("measured", "words"),
    [(["y2"], "y2.*single state"), (["x9"], "'x9'.*y1, y2.*x1"), (["k"], "'k'")],
)
def test_what_is_not_measured_is_refused(mixed, measured, words):
    with pytest.raises(DerivationError, match=words):
        read_measured(mixed, measured)


def test_noise_without_a_bound_is_refused():
    plant = Plant("free noise")
    (x,) = plant.states("x", range=(0, 1))
    (w,) = plant.disturbances("w")
    plant.dynamics([-(x**2)])
    plant.outputs([x + w])
    form = quasi_lpv(plant)
    with pytest.raises(DerivationError, match="w, which has no bound"):
        form.interval(measured="outputs")
    assert form.interval(measured=["x"]).A_lower[0] == -x


def test_an_unknown_signal_without_a_range_is_named():
    plant = Plant("no range")
    x, z = plant.states("x z", range=[(0, 1), (-np.inf, np.inf)])
    plant.dynamics([x * z, -z])
    plant.outputs([x])
    form = quasi_lpv(plant, prefer={"x*z": "x"})
    with pytest.raises(UnboundedError, match="z, which has no range"):
        form.interval(measured=["x"])


def test_an_interval_form_reads_well(by_levels, tanks):
    assert "a33 in [-0.061022397, -0.030511198]  termwise" in str(by_levels)
    assert "functions of x1, x2" in str(by_levels)
    assert str(tanks.interval()).startswith("bounds of A")
    assert "\\le A \\le" in by_levels._repr_latex_()


# -- the LPV example of the interval observer ---------------------------------------


@pytest.fixture(scope="module")
def lpv():
    return quasi_lpv(plants.interval_example())


@pytest.fixture(scope="module")
def structure():
    data = json.loads((REFERENCE / "interval_observer.json").read_text())["example_structure"]
    return {name: np.array(value) for name, value in data.items()}


A_PRINTED = np.array([[-1.0, 1, 0], [-1, 0, 0], [0, -1, -1]])
CONSTANT = np.array([[0, 0.5, 0.1], [0.1, 0.2, 0.4], [0.3, 0.5, 0]])


def test_lpv_example_vertices(lpv):
    form = lpv.vertices()
    assert form.exact
    assert set(form.affinity.values()) == {"syntactic"}
    expected = [
        A_PRINTED + CONSTANT + np.diag([0.1 * a, 0, 0.05 * b]) for a in (-1, 1) for b in (-1, 1)
    ]
    np.testing.assert_allclose(form.A, expected, atol=1e-15)
    np.testing.assert_array_equal(form.B, np.tile([[1.0], [0], [0]], (4, 1, 1)))
    assert lpv.constant("B_f").tolist() == [[-1], [0], [0]]
    assert (form.radius("A") < 1e-15).all()


def test_lpv_example_centred(lpv, structure):
    form = lpv.centred()
    np.testing.assert_allclose(form.A, A_PRINTED + CONSTANT, atol=1e-16)
    signs = [(a, b) for a in (-1, 1) for b in (-1, 1)]
    expected = [np.diag([0.1 * a, 0, 0.05 * b]) for a, b in signs]
    assert form.A_vertices == pytest.approx(np.array(expected), abs=1e-16)
    assert form.A_lower == pytest.approx(np.diag([-0.1, 0, -0.05]), abs=1e-14)
    # coordinates z = H'x with H = diag(-1, 1, 1), E = [-1 0], Ct2 = [0; 1] of the paper
    H = np.diag([-1.0, 1, 1])
    A = H.T @ form.A @ H
    assert A[1:, 1:] == pytest.approx(structure["A2_centred"], abs=1e-15)
    assert A[1:, :1] @ structure["E"] == pytest.approx(structure["D2_centred"], abs=1e-15)
    assert np.abs(form.A_vertices[:, 1:, :]).max() <= 0.05
    plain = H.T @ A_PRINTED @ H
    assert plain[1:, 1:] == pytest.approx(structure["A2_uncentred"], abs=1e-15)


def test_lpv_example_a_nominal_matrix_of_the_user(lpv):
    form = lpv.centred(nominal=A_PRINTED)
    assert form.A.tolist() == A_PRINTED.tolist()
    expected = [CONSTANT + np.diag([0.1 * a, 0, 0.05 * b]) for a in (-1, 1) for b in (-1, 1)]
    assert form.A_vertices == pytest.approx(np.array(expected), abs=1e-15)
    with pytest.raises(DerivationError, match="shape"):
        lpv.centred(nominal=np.eye(2))


@pytest.mark.parametrize("name", ["interval_example", "quadruple_tank", "three_tanks", "lorenz"])
def test_nominal_plus_remainder_holds_exactly(name):
    form = quasi_lpv(getattr(plants, name)())
    centred = form.centred()
    rng = np.random.default_rng(4)
    signals = [s for k in ("x", "u", "p", "rho") for s in getattr(form.model, k)]
    exact = [[sp.Rational(float(v)) for v in row] for row in centred.A]
    for _ in range(25):
        at = {
            s.symbol: sp.Rational(int(rng.integers(1, 1000)), 1000)
            * (sp.Rational(s.upper) - sp.Rational(s.lower))
            + sp.Rational(s.lower)
            for s in signals
        }
        A = form.A.xreplace(at)
        for i, row in enumerate(exact):
            for j, nominal in enumerate(row):
                rest = (A[i, j] - nominal).evalf(40)
                assert sp.Rational(centred.A_lower[i, j]) <= rest
                assert rest <= sp.Rational(centred.A_upper[i, j])


def test_a_remainder_that_is_too_small_is_seen(lpv):
    centred = lpv.centred()
    shrunk = centred.A_upper * (1 - 1e-6)
    rho1 = lpv.model.rho[0].symbol
    value = lpv.A.subs({rho1: 1, lpv.model.rho[1].symbol: 1})[0, 0]
    rest = value - sp.Rational(centred.A[0, 0])
    assert rest <= sp.Rational(centred.A_upper[0, 0])
    assert rest > sp.Rational(shrunk[0, 0])


def test_centred_and_polytopic_forms_read_well(lpv):
    assert "4 vertices (exact) over rho1; rho2" in str(lpv.vertices())
    assert "<table>" in lpv.vertices()._repr_html_()
    assert "2 varying entries" in str(lpv.centred())
