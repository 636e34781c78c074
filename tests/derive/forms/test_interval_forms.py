"""Elementwise and centred forms: every way of bounding, and the LPV example of the papers."""

import json
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import DerivationError, UnboundedError
from obsynth.derive.forms.quasi_lpv.elementwise import bound_elements
from obsynth.derive.forms.quasi_lpv.form import quasi_lpv
from obsynth.derive.forms.scheduling import Known, readings
from obsynth.symbolic import Plant, plants

REFERENCE = Path(__file__).parents[2] / "reference"


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
    "entry",
    [
        "x1*x2",
        "x1 + x2**2",
        "x2**3 - x2**2*3 + x1",
        "x1*sin(3*x3)",
        "x1*x3*k",
        "x1**2 + 1",
        "exp(x3)*x1 - k",
    ],
)
def test_every_way_of_bounding_holds_pointwise(mixed, entry):
    symbols = {s.name: s.symbol for s in (*mixed.x, *mixed.p)}
    expression = sp.sympify(entry, locals=symbols)
    x1 = mixed.x[0].symbol
    ends = bound_elements({(0, 0): expression}, mixed, [Known(x1, (x1, x1))])[0, 0]
    order = [symbols[n] for n in ("x1", "x2", "x3", "k")]
    value = sp.lambdify(order, expression)
    low, high = (sp.lambdify(order[:1], end) for end in ends)
    rng = np.random.default_rng(2)
    box = [(-2, 3), (1, 2), (-1, 1), (0.5, 1.5)]
    for point in rng.uniform(*zip(*box, strict=True), (500, 4)):
        assert low(point[0]) - 1e-12 <= value(*point) <= high(point[0]) + 1e-12


def test_outputs_are_read_with_their_scale_and_noise(mixed):
    (reading,) = readings(mixed)
    assert (reading.output, reading.scale) == ("y1", -2)
    assert [(str(w), factor) for w, factor in reading.noise] == [("w1", 1), ("w2", -3)]


def test_an_unknown_signal_without_a_range_is_named():
    plant = Plant("no range")
    x, z = plant.states("x z", range=[(0, 1), (-np.inf, np.inf)])
    plant.dynamics([x * z, -z])
    plant.outputs([x])
    with pytest.raises(UnboundedError, match="z, which has no range"):
        bound_elements({(0, 0): x * z}, plant, [Known(x, (x, x))])


def test_constant_bounds_hold_and_read_well():
    found = quasi_lpv(plants.three_tanks()).interval()
    # x1 = 0.44, x2 = 0.16 and x3 = 0.24, the flows over the section of a tank
    least = -(0.2**-0.5 + 0.08**-0.5) * 1.329e-4 / 0.0154
    assert found.A_min[2, 2] == pytest.approx(least, rel=1e-5)
    assert found.A_min[2, 2] <= least * (1 - 1e-15)
    assert str(found).startswith("bounds of A\n  a11 in [")


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
