"""Equilibria, factorisation and splits beyond the quadruple tank, and what they refuse."""

import json

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import (
    DerivationError,
    Split,
    StructureError,
    equilibrium,
    fault_isolability,
    split,
)
from obsynth.derive.algebra.factorise import expand_terms, factorise
from obsynth.derive.algebra.linear_parts import prove_identity, rounded
from obsynth.derive.rigour import rational
from obsynth.symbolic import Plant
from obsynth.symbolic.scenarios.gentle import gentle

x1, x2, x3, u1 = sp.symbols("x1:4 u1", real=True)
X, U = [x1, x2, x3], [u1]


def make(dynamics, n=2, outputs=None, Ts=None, limits=(-2, 2), nominal=1):
    """A plant with one signal of every kind; equations are functions of a dict of symbols."""
    plant = Plant("test")
    signals = {
        "x": plant.states(f"x1:{n + 1}", range=limits),
        "u": plant.inputs("u", range=(-5, 5), nominal=nominal)[0],
        "d": plant.unknown_inputs("d")[0],
        "f": plant.process_faults("f")[0],
        "w": plant.disturbances("w", bound=0.1)[0],
        "p": plant.params("p", range=(0.9, 1.1))[0],
        "c": plant.params("c", sp.Rational(1, 3))[0],
    }
    plant.dynamics(dynamics(signals), Ts=Ts)
    plant.outputs(outputs(signals) if outputs else list(signals["x"]))
    return plant


# -- factorisation -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "row",
    [
        x1 * x2 + sp.sqrt(x3) - 3 * u1,
        x2 * sp.exp(x1) * u1 + u1**2 + 1,
        sp.sign(x1 - x3) * sp.sqrt(sp.Abs(x1 - x3)) + sp.sin(2 * x2),
        sp.cos(x1) + sp.tanh(x1 + x2) / (1 + x3**2),
        (x1 + x2) ** 3 / (1 + x1**2) - x1 / x2,
    ],
)
def test_factorised_rows_add_up(row):
    form = factorise(sp.Matrix([row]), X, U)
    x, u = sp.Matrix(X), sp.Matrix(U)
    whole = (form.A[0, :] * x + form.B[0, :] * u)[0] + form.offset[0]
    at = {x1: 0.7, x2: -1.3, x3: 0.4, u1: 2.1}
    assert float((whole - row).evalf(30, subs=at)) == pytest.approx(0.0, abs=1e-20)
    assert float(whole.evalf(30, subs=at)) == pytest.approx(float(row.evalf(30, subs=at)))


def test_rules_of_the_factorisation():
    rows = sp.Matrix([x1 * x2, x1 * x2, sp.sqrt(x3) + u1 * 3 + sp.sin(x1 - 2 * x2)])
    form = factorise(rows, X, U)
    # a product of states goes to the row's own state
    assert form.A[0, 0] == x2
    assert form.A[1, 1] == x1
    assert sp.simplify(form.A[2, 2] - 1 / sp.sqrt(x3)) == 0
    # an odd function of a difference gives two columns
    quotient = sp.sin(x1 - 2 * x2) / (x1 - 2 * x2)
    assert form.A[2, 0] == quotient
    assert form.A[2, 1] == -2 * quotient
    assert form.B[2, 0] == 3
    assert form.offset == sp.zeros(3, 1)


def test_what_cannot_be_factored_is_an_offset():
    form = factorise(sp.Matrix([sp.cos(x1) + 5 + sp.exp(x1 + x2)]), X, U)
    assert form.offset[0] == sp.cos(x1) + 5 + sp.exp(x1 + x2)


def test_denominators_and_functions_stay_whole():
    terms = expand_terms((x1 + x2) / (1 + x1 * (x2 + 1)) + sp.exp(x1 * (x1 + 1)))
    assert sp.exp(x1 * (x1 + 1)) in terms
    assert len(terms) == 3


# -- equilibria --------------------------------------------------------------------------------


def test_equilibrium_of_a_continuous_plant():
    point = equilibrium(make(lambda s: [s["u"] - s["x"][0] ** 3, s["x"][0] - s["x"][1]]))
    np.testing.assert_allclose(point.x, [1.0, 1.0], rtol=1e-12)
    np.testing.assert_allclose(point.p, [1.0])


def test_equilibrium_with_an_integrator_is_found():
    plant = make(lambda s: [s["u"] - s["x"][0], s["x"][0] - s["u"]], nominal=0.5)
    assert equilibrium(plant).residual < 1e-12


def test_equilibrium_under_the_nominal_unknown_input():
    """Mutant: unknown inputs are zero."""
    plant = Plant("shaft")
    (speed,) = plant.states("speed", range=(0, 10))
    (torque,) = plant.inputs("torque", nominal=1)
    (load,) = plant.unknown_inputs("load", nominal=3)
    plant.dynamics([load - torque - speed / 2])
    plant.outputs([speed])
    assert equilibrium(plant).x == pytest.approx([4.0], abs=1e-12)
    scenario = gentle(plant)
    assert np.all(scenario.unknown_inputs == 3.0) and scenario.guess == pytest.approx([5.0])


def test_equilibrium_outside_the_range_is_refused():
    plant = make(lambda s: [s["u"] - s["x"][0], -s["x"][1]], nominal=3)
    with pytest.raises(DerivationError, match=r"x1 = 3 \(range \[-2.0, 2.0\]\)") as caught:
        equilibrium(plant)
    assert caught.value.symbols == ("x1",)


def test_no_equilibrium_is_said():
    plant = make(lambda s: [s["x"][0] ** 2 + 1 + 0 * s["u"], -s["x"][1]])
    with pytest.raises(DerivationError, match="no equilibrium"):
        equilibrium(plant)


def test_a_plant_that_never_rests_is_split_at_its_nominal_point():
    """Mutant: no equilibrium, no split."""
    plant = make(lambda s: [s["x"][0] ** 2 + 1 + 0 * s["u"], -s["x"][1]])
    parts = split(plant)
    assert parts.at.x.tolist() == plant.box("x").mean(axis=1).tolist()
    assert parts.proof.holds and parts.at.residual == 1.0


@pytest.mark.parametrize("u", [[1, 2], [float("nan")], []])
def test_misshapen_inputs_are_refused(u):
    with pytest.raises(DerivationError, match="one finite number for each of u"):
        equilibrium(make(lambda s: [s["u"] - s["x"][0], -s["x"][1]]), u=u)


def test_input_without_a_value_is_named():
    plant = Plant("p")
    (x,) = plant.states("x", range=(0, 1))
    (u,) = plant.inputs("u")
    plant.dynamics([u - x])
    plant.outputs([x])
    with pytest.raises(DerivationError, match="the input u has neither"):
        equilibrium(plant)
    assert equilibrium(plant, u=0.5).x[0] == pytest.approx(0.5)


# -- splits ------------------------------------------------------------------------------------


def nonlinear(s):
    x, u, c = s["x"], s["u"], s["c"]
    return [
        -c * x[0] + sp.sin(x[1]) * s["p"] + s["d"],
        x[0] * x[1] - x[1] + u + c * s["f"] + s["w"] / 7,
    ]


@pytest.mark.parametrize("Ts", [None, 0.1])
@pytest.mark.parametrize("linear", ["frozen", "terms", "jacobian"])
def test_parts_add_up_for_a_general_plant(linear, Ts):
    plant = make(nonlinear, Ts=Ts)
    parts = split(plant, at=([0.3, -0.2], [1.0]), linear=linear)
    assert parts.proof.holds
    rng = np.random.default_rng(0)
    function, g = plant.function(), parts.g_function()
    for _ in range(10):
        x, u, d, f, w = (rng.normal(size=n) for n in (2, 1, 1, 1, 1))
        p = rng.uniform(0.9, 1.1, 1)
        whole = np.array(function(x, u, d, f, w, p, [])[0]).ravel()
        linear_part = parts.A @ x + parts.B @ u + parts.D @ d + parts.B_f @ f + parts.W1 @ w
        np.testing.assert_allclose(linear_part + np.array(g(x, u, p)).ravel(), whole, atol=1e-15)


def test_rounding_of_matrices_is_bounded():
    parts = split(make(nonlinear), at=([0.3, -0.2], [1.0]))
    assert 0.0 < parts.proof.rounding["B_f"][1, 0] <= 2.0**-55
    assert 0.0 < parts.proof.rounding["W1"][1, 0] <= 2.0**-56
    assert not parts.proof.rounding["D"].any()
    exact = abs(rational(parts.B_f[1, 0]) - sp.Rational(1, 3))
    assert exact <= rational(parts.proof.rounding["B_f"][1, 0])


def test_terms_takes_what_is_linear_only():
    parts = split(make(nonlinear), at=([0.3, -0.2], [1.0]), linear="terms")
    np.testing.assert_allclose(parts.A, [[-1 / 3, 0], [0, -1]])
    np.testing.assert_array_equal(parts.B, [[0], [1]])


def test_jacobian_form_has_no_slope_at_the_point():
    parts = split(make(nonlinear), at=([0.3, -0.2], [1.0]), linear="jacobian")
    symbols = [s.symbol for s in parts.model.x]
    values = dict(zip(symbols, (0.3, -0.2), strict=True)) | {parts.model.p[0].symbol: 1}
    slope = np.array(parts.g.jacobian(symbols).evalf(20, subs=values), dtype=float)
    np.testing.assert_allclose(slope, np.zeros((2, 2)), atol=1e-15)


def test_frozen_form_at_the_origin_is_the_limit():
    parts = split(make(lambda s: [sp.sin(s["x"][0]) - s["u"], -s["x"][1]]), at=([0, 0], [0]))
    assert parts.A[0, 0] == 1.0


def test_frozen_form_without_a_limit_is_refused():
    plant = make(lambda s: [sp.sqrt(s["x"][0]) - s["u"], -s["x"][1]], limits=(0, 2))
    with pytest.raises(DerivationError, match="no finite value at the point") as caught:
        split(plant, at=([0, 0], [0]))
    assert caught.value.symbol == "x1"


def test_a_wrong_part_is_not_proved():

    plant = make(nonlinear)
    parts = split(plant, at=([0.3, -0.2], [1.0]))
    names = ("D", "B_f", "W1", "C", "W2", "D_f")
    exact = {
        "D": sp.Matrix([1, 0]),
        "B_f": sp.Matrix([0, sp.Rational(1, 3)]),
        "W1": sp.Matrix([0, sp.Rational(1, 7)]),
        "C": sp.eye(2),
        "W2": sp.zeros(2, 1),
        "D_f": sp.zeros(2, 1),
    }
    A = sp.Matrix(parts.A.tolist()).applyfunc(rational)
    B = sp.Matrix(parts.B.tolist()).applyfunc(rational)
    right = {name: rounded(exact[name]) for name in names}
    assert prove_identity(plant, A, B, parts.g, right).holds
    wrong = A.copy()
    wrong[0, 0] += sp.Rational(1, 2**60)
    assert prove_identity(plant, wrong, B, parts.g, right).methods[0] == ""
    swapped = right | {"W1": rounded(sp.Matrix([sp.Rational(1, 7), 0]))}
    assert prove_identity(plant, A, B, parts.g, swapped).methods[:2] == ("", "")


def bad_dynamics(extra, row=1):
    def rows(s):
        out = [-s["x"][0], s["u"] - s["x"][1]]
        out[row] += extra(s)
        return out

    return rows


@pytest.mark.parametrize(
    ("extra", "symbol"),
    [
        (lambda s: s["d"] ** 2, "d"),
        (lambda s: s["d"] * s["x"][0], "d"),
        (lambda s: sp.sin(s["f"]), "f"),
        (lambda s: s["f"] * s["u"], "f"),
        (lambda s: s["w"] * s["p"], "w"),
        (lambda s: s["w"] * s["d"], "d"),
    ],
)
def test_signals_that_enter_nonlinearly_are_named(extra, symbol):
    with pytest.raises(StructureError, match="has to enter linearly") as caught:
        split(make(bad_dynamics(extra)), at=([0, 0], [0]))
    assert caught.value.symbol == symbol
    assert caught.value.row == "x2"


def test_a_signal_with_a_constant_slope_that_jumps_is_not_linear():
    """Both branches have the slope 1; mutant: what is left over not looked at."""

    def jump(s):
        return sp.Piecewise((s["d"] + 1, s["d"] > 0), (s["d"] - 1, True))

    plant = make(bad_dynamics(jump))
    with pytest.raises(StructureError, match="do not enter the row of x2 linearly") as caught:
        split(plant, at=([0, 0], [0]))
    assert caught.value.symbol == "d"


@pytest.mark.parametrize(
    ("output", "symbol"),
    [
        (lambda s: s["x"][0] ** 2, "x1"),
        (lambda s: s["x"][0] * s["w"], "x1"),
        (lambda s: s["x"][0] + s["u"], "u"),
        (lambda s: s["p"] * s["x"][0], "p"),
        (lambda s: s["x"][0] + s["d"], "d"),
    ],
)
def test_outputs_that_are_not_linear_are_named(output, symbol):
    plant = make(bad_dynamics(lambda s: 0), outputs=lambda s: [s["x"][1], output(s)])
    with pytest.raises(StructureError, match="y2") as caught:
        split(plant, at=([0, 0], [0]))
    assert caught.value.symbol == symbol
    assert caught.value.row == "y2"


def test_output_with_an_offset_is_refused():
    plant = make(bad_dynamics(lambda s: 0), outputs=lambda s: [s["x"][0] + 3])
    with pytest.raises(StructureError, match="y1 has the constant part 3") as caught:
        split(plant, at=([0, 0], [0]))
    assert caught.value.row == "y1"


def test_sensor_faults_have_columns_of_their_own():
    plant = Plant("p")
    x = plant.states("x1:3", range=(-1, 1))
    plant.inputs("u", nominal=0)
    plant.dynamics([-x[0] + x[1] ** 2, -x[1]])
    names = plant.outputs(list(x))
    plant.sensor_faults("s", of=[names[1]], rate=0.1)
    parts = split(plant)
    np.testing.assert_array_equal(parts.D_f, [[0.0], [1.0]])
    assert not parts.B_f.any()


@pytest.mark.parametrize("at", [3, ([1, 2, 3], [0]), ([0, 0], [float("inf")]), ("a", "b")])
def test_points_that_are_none_are_refused(at):
    with pytest.raises(DerivationError):
        split(make(bad_dynamics(lambda s: 0)), at=at)


def test_unknown_form_is_refused():
    with pytest.raises(DerivationError, match="frozen, terms, jacobian"):
        split(make(bad_dynamics(lambda s: 0)), linear="tangent")


def test_a_split_is_derived_again_from_its_file(parts):
    text = json.dumps(parts.to_dict())
    again = Split.from_dict(json.loads(text))
    for name in ("A", "B", "D", "B_f", "C", "W1", "W2"):
        np.testing.assert_array_equal(getattr(again, name), getattr(parts, name))
    assert again.proof.holds
    assert again.g == parts.g
    with pytest.raises(DerivationError, match="no stored split"):
        Split.from_dict({"linear": "frozen"})


def test_signs_of_what_sympy_does_not_know_to_be_real_are_flat():
    """SymPy leaves such derivatives undone. Mutant: they stay (ValueError, or no finite value)."""
    plant = Plant("flat")
    plant.states("x y", range=(1, 2))
    plant.faults("f", range=(-1, 1))
    row = "f - x + y*sign(sinh(x*y) + atan(x/3) + (sin(y) + 2)**(-2))"
    plant.dynamics([row, "x - y"])
    plant.outputs(["x", "y"])
    parts = split(plant, ([1.5, 1.5], []), "jacobian")
    assert parts.A.tolist() == [[-1.0, 1.0], [1.0, -1.0]]
    assert fault_isolability(plant).detectable.all()


def test_a_limit_that_sympy_does_not_find_is_refused_by_its_signal(monkeypatch):
    def unknown(*_):
        raise NotImplementedError("Don't know how to calculate the mrv")

    monkeypatch.setattr(sp, "limit", unknown)
    plant = Plant("no limit")
    plant.states("x", range=(-1, 1))
    plant.dynamics(["-sinh(x)"])
    plant.outputs(["x"])
    with pytest.raises(DerivationError, match="of x in the row of x has no finite value"):
        split(plant, ([0], []))
