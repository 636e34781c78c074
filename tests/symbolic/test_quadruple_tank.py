"""The quadruple tank of Buciakowski et al., Section 6."""

import json
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic.plants import quadruple_tank

REFERENCE = json.loads(
    (Path(__file__).parents[1] / "reference" / "bounded_error_uio.json").read_text()
)["model"]
EQUILIBRIUM = [130.118142, 172.575320, 31.304892, 38.805004]


def rates(plant, x, u=(10.0, 10.0), d=0.0, f=(0.0, 0.0)):
    return np.array(plant.function()(x, u, d, f, [0, 0, 0], [], [])[0]).ravel()


def test_the_papers_equilibrium():
    plant = quadruple_tank()
    # The six decimals of the levels leave at most half a unit times the slope of .02.
    assert np.abs(rates(plant, EQUILIBRIUM)).max() < 1e-8
    assert np.abs(rates(plant, REFERENCE["xeq"])).max() < 1e-13
    assert np.abs(rates(plant, EQUILIBRIUM, u=(10.0, 10.01))).max() > 1e-4


def test_standard_gravity_gives_another_equilibrium():
    """The paper leaves g out; its levels belong to 981, not to 980.665."""
    plant = quadruple_tank()
    values = plant.constant_values
    values[sp.Symbol("g", real=True)] = sp.Rational(980665, 1000)
    x = dict(zip((s.symbol for s in plant.x), EQUILIBRIUM, strict=True))
    v = {s.symbol: 10 for s in plant.u}
    rest = {s.symbol: 0 for s in (*plant.d, *plant.f)}
    residual = plant.rhs.subs(values).subs({**x, **v, **rest})
    assert max(abs(float(row)) for row in residual) > 1e-5


def test_matrices_of_the_euler_model():
    model = quadruple_tank().discretise("euler", 1.0)
    sx = model.sx()
    columns = [sx.u, sx.f, sx.d]
    slopes = [ca.jacobian(sx.rhs, column) for column in columns]
    slope = ca.Function("B", [sx.x, *columns], slopes)
    by_input, by_fault, by_unknown = (np.array(m) for m in slope(EQUILIBRIUM, 10, 0, 0))
    np.testing.assert_allclose(by_input, REFERENCE["B"], rtol=1e-14)
    np.testing.assert_array_equal(by_fault, by_input)
    np.testing.assert_array_equal(by_unknown, [[0], [0], [1], [0]])
    fall = [float(sp.sqrt(2 * 981)) * a / area for a, area in ((0.071, 28), (0.051, 32))]
    h = np.array(REFERENCE["xeq"])
    frozen = 1 - np.array(fall * 2) / np.sqrt(h)
    np.testing.assert_allclose(frozen, np.diag(REFERENCE["A"]), rtol=1e-14)


def test_data():
    plant = quadruple_tank()
    values = {str(symbol): value for symbol, value in plant.constant_values.items()}
    assert all(isinstance(value, sp.Rational) for value in values.values()), "exact"
    assert values["A1"] == values["A3"] == 28
    assert values["A2"] == values["A4"] == 32
    assert values["a1"] == values["a3"] == sp.Rational(71, 1000)
    assert values["a2"] == values["a4"] == sp.Rational(51, 1000)
    assert values["k1"] == sp.Rational("3.235")
    assert values["k2"] == sp.Rational("3.32")
    assert values["gamma1"] == sp.Rational("0.565")
    assert values["gamma2"] == sp.Rational("0.47")
    assert values["g"] == 981
    np.testing.assert_array_equal(plant.box("x"), [[60, 280], [60, 280], [5, 100], [5, 100]])
    np.testing.assert_array_equal(plant.box("w"), [[-0.1, 0.1]] * 3)
    assert [s.rate for s in plant.f] == [0.05, 0.05]
    assert [s.of for s in plant.f] == ["v1", "v2"]
    assert plant.output_names == ("y1", "y2", "y3")


def test_the_equations_are_the_papers():
    plant = quadruple_tank()
    s = {str(symbol): symbol for row in plant.rhs for symbol in row.free_symbols}
    fall = [s[f"a{i}"] * sp.sqrt(2 * s["g"] * s[f"h{i}"]) for i in (1, 2, 3, 4)]
    flow = [s[f"k{i}"] * (s[f"v{i}"] + s[f"f{i}"]) for i in (1, 2)]
    share = [s["gamma1"], s["gamma2"]]
    area = [s[f"A{i}"] for i in (1, 2, 3, 4)]
    paper = [
        (-fall[0] + fall[2] + share[0] * flow[0]) / area[0],
        (-fall[1] + fall[3] + share[1] * flow[1]) / area[1],
        (-fall[2] + (1 - share[1]) * flow[1]) / area[2] + s["d"],
        (-fall[3] + (1 - share[0]) * flow[0]) / area[3],
    ]
    assert [sp.expand(row - given) for row, given in zip(plant.rhs, paper, strict=True)] == [0] * 4


@pytest.mark.parametrize("index", range(4))
def test_a_planted_error_leaves_the_equilibrium(index):
    plant = quadruple_tank()
    wrong = np.array(EQUILIBRIUM)
    wrong[index] += 0.01
    assert np.abs(rates(plant, wrong)).max() > 1e-5
