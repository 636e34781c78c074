"""Discretisation against values written by hand."""

import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic import Plant, PlantError
from obsynth.symbolic.discretise import runge_kutta, sampling_time
from obsynth.symbolic.plants import quadruple_tank


def plant_with_everything():
    plant = Plant("everything")
    (x,) = plant.states("x", range=(-5, 5))
    (u,) = plant.inputs("u", range=(-1, 1))
    (d,) = plant.unknown_inputs("d")
    w = plant.disturbances("w1:3", bound=1)
    plant.actuator_faults("f", of=u, rate=0.3)
    plant.process_faults("g", rate=2.0)
    plant.dynamics([-3 * x + 2 * u + 5 * d + 7 * w[0] + sp.Symbol("g")])
    plant.outputs([x + 11 * w[1]])
    plant.sensor_faults("s", of="y1", rate=1.0)
    return plant


def is_euler(model, h):
    """Say whether dynamics, D, W1 and rates carry the step, and the outputs do not."""
    x, u, d, w1, w2, f, g, s = sp.symbols("x u d w1 w2 f g s", real=True)
    by_hand = x + h * (-3 * x + 2 * (u + f) + 5 * d + 7 * w1 + g)
    rates = [float(rate * h) for rate in (0.3, 2.0, 1.0)]
    return (
        sp.expand(model.rhs[0] - by_hand) == 0
        and model.output == sp.Matrix([x + 11 * w2 + s])
        and [signal.rate for signal in model.f] == pytest.approx(rates, rel=1e-15)
    )


@pytest.mark.parametrize("step", [0.5, sp.Rational(1, 10), 2])
def test_euler_scales_dynamics_and_rates_but_no_output(step):
    model = plant_with_everything().discretise("euler", step)
    assert is_euler(model, sp.nsimplify(step))
    assert model.Ts == float(step)
    assert model.discretisation == "euler"
    assert model.continuous is not None
    assert [signal.rate for signal in model.continuous.f] == [0.3, 2.0, 1.0]


def scaled(symbol, row):
    return row.subs(symbol, symbol * sp.Rational(1, 2))


MUTANTS = {
    "W2 scaled": lambda m: m._outputs.update(
        y1=scaled(sp.Symbol("w2", real=True), m._outputs["y1"])
    ),
    "D scaled twice": lambda m: setattr(
        m, "_dynamics", (scaled(sp.Symbol("d", real=True), m.equations[0][0] + 0),)
    ),
    "rates per second": lambda m: setattr(m, "_table", m.continuous._table),
    "step forgotten": lambda m: setattr(m, "_dynamics", m.continuous.equations[0]),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_planted_errors_are_seen(mutant):
    model = plant_with_everything().discretise("euler", 0.5)
    MUTANTS[mutant](model)
    assert not is_euler(model, sp.Rational(1, 2))


def test_rk4_of_a_linear_equation_is_its_taylor_polynomial():
    plant = Plant("linear")
    (x,) = plant.states("x")
    (u,) = plant.inputs("u")
    plant.dynamics([-2 * x + u])
    plant.outputs([x])
    model = plant.discretise("rk4", sp.Rational(1, 4))
    z = sp.Rational(-1, 2)
    growth = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    assert sp.expand(model.rhs[0] - (growth * x + (growth - 1) / -2 * u)) == 0
    value = model.function()(3.0, 1.0, [], [], [], [], [])[0]
    assert float(value) == pytest.approx(float(growth * 3 + (growth - 1) / -2), rel=1e-15)


def test_rk4_in_casadi_is_rk4_in_sympy_and_in_numpy():
    plant = quadruple_tank()
    model = plant.discretise("rk4", sp.Rational(1, 2))
    x, u = np.array([120.0, 160.0, 20.0, 50.0]), np.array([9.0, 11.0])
    d, f, w = np.array([0.1]), np.array([0.2, -0.3]), np.zeros(3)
    rates = plant.function()
    by_hand = runge_kutta(lambda z: np.array(rates(z, u, d, f, w, [], [])[0]).ravel(), x, 0.5)
    casadi = np.array(model.function()(x, u, d, f, w, [], [])[0]).ravel()
    np.testing.assert_allclose(casadi, by_hand, rtol=1e-15)
    values = dict(
        zip(
            (s.symbol for s in (*plant.x, *plant.u, *plant.d, *plant.f)),
            [*x, *u, *d, *f],
            strict=True,
        )
    )
    exact = model.rhs.subs(plant.constant_values).evalf(30, subs=values)
    np.testing.assert_allclose(casadi, np.array(exact, dtype=float).ravel(), rtol=1e-14)
    euler = plant.discretise("euler", sp.Rational(1, 2)).function()(x, u, d, f, w, [], [])[0]
    assert np.max(np.abs(casadi - np.array(euler).ravel())) > 1e-4, (
        "another formula gives other values"
    )


def test_rk4_with_symbolic_constants():
    model = quadruple_tank().discretise("rk4", 1.0)
    symbolic = model.sx("symbol")
    c = [float(value) for value in model.constant_values.values()]
    x, u = [120.0, 160.0, 20.0, 50.0], [9.0, 11.0]
    one = symbolic.function()(x, u, 0, [0, 0], [0, 0, 0], [], [], c)[0]
    two = model.function()(x, u, 0, [0, 0], [0, 0, 0], [], [])[0]
    np.testing.assert_allclose(np.array(one), np.array(two), rtol=1e-14)


def test_order_of_convergence_is_four():
    plant = Plant("pendulum")
    a, b = plant.states("a b")
    plant.dynamics([b, -sp.sin(a)])
    plant.outputs([a])

    def after_one_second(steps):
        function = plant.discretise("rk4", sp.Rational(1, steps)).function()
        x = np.array([1.0, 0.0])
        for _ in range(steps):
            x = np.array(function(x, [], [], [], [], [], [])[0]).ravel()
        return x

    reference = after_one_second(256)
    errors = [np.max(np.abs(after_one_second(n) - reference)) for n in (4, 8, 16)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all((orders > 3.7) & (orders < 4.6))


def test_sampling_times():
    assert sampling_time(0.125) == sp.Rational(1, 8)
    assert isinstance(sampling_time(0.1), sp.Float), "a float means its double"
    assert sampling_time(sp.Rational(1, 10)) == sp.Rational(1, 10)
    assert quadruple_tank().discretise("euler", sp.Rational(1, 10)).Ts == 0.1


def test_a_discretised_plant_is_closed():
    model = plant_with_everything().discretise("euler", 1.0)
    with pytest.raises(PlantError, match="in use"):
        model.disturbances("late")
    with pytest.raises(PlantError, match="in use"):
        model.continuous.disturbances("late")


def test_a_plant_given_by_next_values():
    plant = Plant("map")
    (x,) = plant.states("x", range=(0, 1))
    plant.faults("f", rate=0.25)
    plant.dynamics([x / 2 + sp.Symbol("f")], Ts=0.1)
    plant.outputs([x])
    assert plant.Ts == 0.1
    assert plant.continuous is None
    assert plant.discretisation is None
    assert plant.f[0].rate == 0.25, "per step already"
