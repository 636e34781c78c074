"""Plants from CasADi expressions, SX and MX."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic import ParityError, Plant, PlantError
from obsynth.symbolic import from_casadi as module
from obsynth.symbolic.plants import quadruple_tank

BOX = [(60, 280), (60, 280), (5, 100), (5, 100)]


def tank_expressions(kind):
    """Return the quadruple tank, discretised, written anew for SX or MX."""
    h, v, d, w, f = (kind.sym(n, k) for n, k in (("h", 4), ("v", 2), ("d", 1), ("w", 3), ("f", 2)))
    a, area = [0.071, 0.051, 0.071, 0.051], [28.0, 32.0, 28.0, 32.0]
    flow = [a[i] * ca.sqrt(2 * 981.0 * h[i]) for i in range(4)]
    q1, q2 = 3.235 * (v[0] + f[0]), 3.32 * (v[1] + f[1])
    rates = [
        (flow[2] - flow[0] + 0.565 * q1) / area[0],
        (flow[3] - flow[1] + 0.47 * q2) / area[1],
        (0.53 * q2 - flow[2]) / area[2] + d,
        (0.435 * q1 - flow[3]) / area[3],
    ]
    return {"x": h, "u": v, "d": d, "w": w, "f": f}, ca.vertcat(*rates), h[:3] + w


@pytest.mark.parametrize("kind", [ca.SX, ca.MX])
def test_the_tank_written_in_casadi_is_the_tank(kind):
    columns, xdot, y = tank_expressions(kind)
    plant = Plant.from_casadi(
        "quadruple tank",
        **columns,
        xdot=xdot,
        y=y,
        range={"x": BOX, "u": (0, 20), "w": (-0.1, 0.1)},
        nominal={"u": 10},
        unit={"x": "cm", "v_0": "V"},
        rate={"f": 0.05},
        output_unit="cm",
        output_range=(0, 300),
    )
    reference = quadruple_tank()
    assert plant.names("x") == ("h_0", "h_1", "h_2", "h_3")
    assert [s.unit for s in plant.u] == ["V", ""]
    assert [s.rate for s in plant.f] == [0.05, 0.05]
    assert plant.output_units == ("cm",) * 3
    assert plant.output_ranges.tolist() == [[0, 300]] * 3
    assert all(signal.nominal == 10 for signal in plant.u)
    np.testing.assert_array_equal(plant.box("x"), reference.box("x"))
    np.testing.assert_array_equal(plant.box("w"), reference.box("w"))
    rng = np.random.default_rng(5)
    for _ in range(20):
        x, u = rng.uniform(5, 280, 4), rng.uniform(0, 20, 2)
        d, f, w = rng.normal(size=1), rng.normal(size=2), rng.normal(size=3)
        one = plant.function()(x, u, d, f, w, [], [])
        two = reference.function()(x, u, d, f, w, [], [])
        for left, right in zip(one, two, strict=True):
            np.testing.assert_allclose(np.array(left), np.array(right), rtol=1e-12, atol=1e-13)


def test_discrete_plants_and_names():
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    plant = Plant.from_casadi(
        "d", x=x, u=u, xnext=[x[1], u - x[0]], y=x[0], Ts=0.5, names={"x": "p q"}, output_names="z"
    )
    assert plant.Ts == 0.5
    assert plant.names("x") == ("p", "q")
    assert plant.output_names == ("z",)
    p, q, v = (signal.symbol for signal in (*plant.x, *plant.u))
    assert plant.rhs == sp.Matrix([q, v - p])
    assert Plant.from_casadi("d", x=x, xnext=-x, y=x).Ts == 1.0


def test_parameters_and_scheduling():
    x, k, m, r = (ca.SX.sym(name) for name in ("x", "k", "m", "r"))
    plant = Plant.from_casadi(
        "p",
        x=x,
        p=[k, m],
        rho=r,
        xdot=-k * x * r + m,
        y=x,
        value={"k": 2.0, "m": 3.0},
        tolerance={"k": 0.1},
        measured={"r": False},
        range={"rho": (0, 1)},
    )
    assert plant.names("p") == ("k",)
    assert [s.name for s in plant.constants] == ["m"]
    assert plant.rho[0].measured is False


def test_branches_return_as_piecewise():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    inner = ca.if_else(ca.logic_and(x > 0, y < 1), ca.sqrt(ca.fabs(x)), ca.fmin(x, -y))
    plant = Plant.from_casadi(
        "branches",
        x=[x, y],
        xdot=[inner, ca.logic_not(x > y) * 3 + (x != y)],
        y=ca.if_else(x == 0, 1, ca.sin(x) / x),
        range=(-2, 2),
    )
    X, Y = (signal.symbol for signal in plant.x)
    assert plant.rhs[0] == sp.Piecewise(
        (sp.sqrt(sp.Abs(X)), (X > 0) & (Y < 1)), (sp.Min(X, -Y), True)
    )
    values = plant.function()([-1.0, 0.5], [], [], [], [], [], [])
    np.testing.assert_array_equal(np.array(values[0]).ravel(), [-1.0, 4.0])


def test_a_plants_own_sx_makes_the_same_plant():
    """SymPy to SX and back again through the tape."""
    reference = quadruple_tank().discretise("euler", 1.0)
    model = reference.sx()
    kinds = {kind: getattr(model, kind) for kind in ("x", "u", "d", "f", "w")}
    again = Plant.from_casadi("again", **kinds, xnext=model.rhs, y=model.y, range=BOX)
    assert again.names("u") == ("v1", "v2")
    # Rationals have become doubles on the way; nothing else has changed.
    rng = np.random.default_rng(1)
    for _ in range(20):
        point = [rng.uniform(5, 100, model.x.numel()), *(rng.normal(size=k) for k in (2, 1, 2, 3))]
        one = again.function()(*point, [], [])[0]
        two = reference.function()(*point, [], [])[0]
        np.testing.assert_allclose(np.array(one), np.array(two), rtol=2e-15, atol=1e-15)


def test_mx_calls_are_expanded():
    z = ca.MX.sym("z", 2)
    inner = ca.Function("inner", [z], [ca.sin(z) * ca.norm_2(z)])
    plant = Plant.from_casadi("calls", x=z, xdot=inner(z), y=z[0])
    a, b = (signal.symbol for signal in plant.x)
    assert plant.rhs[0] == sp.sin(a) * sp.sqrt(a**2 + b**2)


def test_what_cannot_be_expanded_is_refused_by_name():
    z = ca.MX.sym("z")
    state = ca.MX.sym("s")
    solver = ca.integrator("hidden_solver", "cvodes", {"x": state, "ode": -state})
    wrapped = ca.Function("wrapper", [z], [solver(x0=z)["xf"]])
    with pytest.raises(PlantError, match="hidden_solver"):
        Plant.from_casadi("i", x=z, xdot=wrapped(z), y=z)
    matrix = ca.MX.sym("m", 2)
    solved = ca.solve(ca.diag(matrix) + 1, matrix, "lapackqr")
    with pytest.raises(PlantError, match="cannot be expanded"):
        Plant.from_casadi("s", x=matrix, xdot=solved, y=matrix)


def test_the_conversion_is_compared_with_the_original(monkeypatch):
    x = ca.SX.sym("x")
    true = module.from_tape

    def wrong(function, arguments, labels):
        return [row + sp.Float(1e-10) for row in true(function, arguments, labels)]

    monkeypatch.setattr(module, "from_tape", wrong)
    with pytest.raises(ParityError, match=r"dynamics row 1: .* at x = ") as caught:
        Plant.from_casadi("m", x=x, xdot=ca.sin(x), y=x)
    assert set(caught.value.point) == {"x"}


X, Y, Z = ca.SX.sym("x"), ca.SX.sym("y"), ca.MX.sym("z")
REFUSALS = {
    "neither": ({"x": X, "y": X}, "xdot= .* or xnext="),
    "both": ({"x": X, "xdot": X, "xnext": X, "y": X}, "xdot= .* or xnext="),
    "Ts of a continuous plant": ({"x": X, "xdot": X, "y": X, "Ts": 1}, "goes with xnext="),
    "free symbol": ({"x": X, "xdot": X * Y, "y": X}, "depend on y"),
    "mixed": ({"x": X, "xdot": Z, "y": X}, "SX and MX"),
    "expression as symbols": ({"x": X * 2, "xdot": X, "y": X}, "is an expression"),
    "matrix": ({"x": ca.SX.sym("A", 2, 2), "xdot": X, "y": X}, "columns of CasADi symbols"),
    "not casadi": ({"x": "h", "xdot": X, "y": X}, "columns of CasADi symbols"),
    "rows not casadi": ({"x": X, "xdot": "h", "y": X}, "column of CasADi expressions"),
    "row count": ({"x": X, "xdot": [X, X], "y": X}, "2 rows for 1 states"),
    "range of nobody": (
        {"x": X, "xdot": X, "y": X, "range": {"q": (0, 1)}},
        "neither a kind given",
    ),
    "names of nobody": ({"x": X, "xdot": X, "y": X, "names": {"u": "v"}}, "names= has 'u'"),
    "too many names": ({"x": X, "xdot": X, "y": X, "names": {"x": "a b"}}, "2 names for 1"),
    "rate of a state": ({"x": X, "xdot": X, "y": X, "rate": {"x": 1}}, "rate= means nothing for x"),
    "unknown keyword": ({"x": X, "xdot": X, "y": X, "colour": {"x": 1}}, "colour= is no keyword"),
    "name twice": ({"x": X, "u": ca.SX.sym("x"), "xdot": X, "y": X}, "taken by the state x"),
    "remainder": ({"x": X, "xdot": X, "y": ca.remainder(X, 2)}, "outputs row 1: .*remainder"),
    "fmod": ({"x": [X, Y], "xdot": [X, 1 + ca.fmod(X, Y)], "y": X}, "dynamics row 2: .*fmod"),
    "inverted range": ({"x": X, "xdot": X, "y": X, "range": (1, 0)}, "empty"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case):
    arguments, message = REFUSALS[case]
    with pytest.raises(PlantError, match=message):
        Plant.from_casadi("bad", **arguments)
