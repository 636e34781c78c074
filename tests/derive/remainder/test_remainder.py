"""Discretisation remainders: never exceeded, close to what is attained, and mutants that fail."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import StructureError, UnboundedError
from obsynth.derive.errors import DerivationError
from obsynth.derive.intervals.program import Program, evaluate
from obsynth.derive.remainder import certify, flow
from obsynth.derive.remainder.certify import discretisation_remainder
from obsynth.derive.remainder.flow import FlowError, flow_box
from obsynth.derive.remainder.result import Remainder
from obsynth.derive.remainder.system import step_derivatives, system, time_derivatives
from obsynth.derive.remainder.trees import difference_term, trees
from obsynth.symbolic import Plant, plants
from obsynth.symbolic.discretise import step_formula

TANK = {"d": (-0.1, 0.1), "f1": (-1.0, 1.0), "f2": (-1.0, 1.0)}
CASES = {
    "tank": (plants.quadruple_tank, sp.Integer(1), TANK),
    "van der Pol": (plants.van_der_pol, sp.Rational(1, 20), {}),
    "Lorenz": (plants.lorenz, sp.Rational(1, 100), {}),
    "CSTR": (plants.exothermic_cstr, sp.Rational(1, 100), {}),
}
# Guaranteed width over attained width that is promised, by method.
FACTOR = {"euler": 1.1, "rk4": 6.0}


def assumed(plant, given):
    """Ranges for signals that were declared without one."""
    kinds = ("u", "d", "f", "w")
    names = {s.name for kind in kinds for s in getattr(plant, kind) if not s.bounded}
    return {name: given.get(name, (-0.1, 0.1)) for name in names}


def certified(name, method, **options):
    build, Ts, given = CASES[name]
    plant = build()
    return discretisation_remainder(plant, method, Ts, ranges=assumed(plant, given), **options)


def local_errors(found: Remainder, count, seed=0, corners=True):
    """Solution minus step from random points, by 8 steps of the eighth-order formula of Gragg.

    Extrapolation of the modified midpoint rule shares no code with what is tested.
    """
    dynamics = system(found.plant, found.assumed)
    n = len(dynamics.names)
    rng = np.random.default_rng(seed)
    share = rng.random((count, len(dynamics.lower)))
    if corners:
        share[: count // 3] = np.round(share[: count // 3])
        share[count // 3 : count // 2] = np.where(
            rng.random((count // 2 - count // 3, share.shape[1])) < 0.5,
            np.round(share[count // 3 : count // 2]),
            share[count // 3 : count // 2],
        )
    points = (dynamics.lower + share * (dynamics.upper - dynamics.lower)).T
    constants = [0.5 * (a + b) for a, b in dynamics.constant_box]
    rates = ca.Function("f", [dynamics.x, dynamics.v, dynamics.constants], [dynamics.rhs])
    held = np.tile(np.array(constants)[:, None], (1, count))

    def f(x):
        return np.array(rates(x, points[n:], held))

    def extrapolated(x, h):
        table = []
        for k, parts in enumerate((2, 4, 6, 8)):
            small = h / parts
            before, now = x, x + small * f(x)
            for _ in range(parts - 1):
                before, now = now, before + 2 * small * f(now)
            row = [0.5 * (now + before + small * f(now))]
            for j in range(k):
                ratio = (parts / (2 * (k - j))) ** 2
                row.append(row[j] + (row[j] - table[k - 1][j]) / (ratio - 1))
            table.append(row)
        return table[-1][-1]

    x0, Ts = points[:n], found.Ts
    x = x0
    for _ in range(8):
        x = extrapolated(x, Ts / 8)
    if found.method == "euler":
        step = x0 + Ts * f(x0)
    else:
        k1 = f(x0)
        k2 = f(x0 + Ts / 2 * k1)
        k3 = f(x0 + Ts / 2 * k2)
        k4 = f(x0 + Ts * k3)
        step = x0 + Ts / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    # what doubles lose in a difference of two numbers of this size
    noise = 256 * 2.3e-16 * (np.abs(x0).max(axis=1) + Ts * np.abs(f(x0)).max(axis=1))
    return x - step, noise


def exceeded(found, errors, noise):
    low = (errors < (found.lower - noise)[:, None]).sum()
    high = (errors > (found.upper + noise)[:, None]).sum()
    return int(low + high)


SLOW = ("tank", "CSTR")


# -- soundness and tightness -----------------------------------------------------------------------


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.long if n in SLOW else ()) for n in CASES]
)
def test_never_exceeded_from_thousands_of_points(name, method):
    found = certified(name, method)
    errors, noise = local_errors(found, 3000)
    assert exceeded(found, errors, noise) == 0
    assert (found.attained_lower >= found.lower).all()
    assert (found.attained_upper <= found.upper).all()
    assert (found.excess <= FACTOR[method]).all()


@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", ["van der Pol", pytest.param("CSTR", marks=pytest.mark.long)])
def test_attained_values_are_what_integration_finds(name, method):
    found = certified(name, method)
    errors, noise = local_errors(found, 3000, seed=1)
    real = errors.max(axis=1) - errors.min(axis=1)
    claimed = found.attained_upper - found.attained_lower
    assert (real <= (found.upper - found.lower) + 2 * noise).all()
    assert (claimed <= 1.3 * real + 4 * noise).all()


@pytest.mark.long
@pytest.mark.parametrize("method", ["euler", "rk4"])
@pytest.mark.parametrize("name", list(CASES))
def test_never_exceeded_from_a_hundred_thousand_points(name, method):
    found = certified(name, method)
    for seed in range(10):
        errors, noise = local_errors(found, 10_000, seed=seed)
        assert exceeded(found, errors, noise) == 0


@pytest.mark.long
def test_higher_effort_is_no_looser():
    fast, normal = certified("Lorenz", "rk4"), certified("Lorenz", "rk4", effort="normal")
    assert (normal.upper - normal.lower <= (fast.upper - fast.lower) * 1.001).all()
    errors, noise = local_errors(normal, 4000)
    assert exceeded(normal, errors, noise) == 0


def test_linear_plant_by_hand():
    """x' = -x: the remainder of Euler is x (exp(-h) - 1 + h)."""
    plant = Plant("decay")
    (x,) = plant.states("x", range=(1, 2))
    plant.dynamics([-x])
    plant.outputs([x])
    h = 0.25
    found = discretisation_remainder(plant, "euler", sp.Rational(1, 4))
    exact = np.array([1.0, 2.0]) * (np.exp(-h) - 1 + h)
    assert found.lower[0] <= exact[0] <= found.attained_lower[0] * (1 + 1e-2)
    assert found.attained_upper[0] * (1 - 1e-12) <= exact[1] <= found.upper[0]
    assert found.upper[0] <= 1.02 * exact[1]
    rk = discretisation_remainder(plant, "rk4", sp.Rational(1, 4))
    series = sum((-h) ** k / np.prod(np.arange(1.0, k + 1)) for k in range(5))
    exact = 2.0 * (np.exp(-h) - series)
    assert rk.lower[0] <= exact <= 0.99 * rk.lower[0] * 0.99
    assert rk.order == 5


# -- mutants ---------------------------------------------------------------------------------------


def growing():
    """x' = x^2 grows fastest at the edge from which it leaves the box."""
    plant = Plant("growing")
    (x,) = plant.states("x", range=(1, 2))
    plant.dynamics([x**2])
    plant.outputs([x])
    return plant


def grown(method="euler"):
    found = discretisation_remainder(growing(), method, sp.Rational(1, 20))
    return exceeded(found, *local_errors(found, 300))


def test_growing_plant_is_enclosed():
    assert grown("euler") == 0
    assert grown("rk4") == 0


def test_box_that_is_not_inflated_fails(monkeypatch):
    def still(dynamics, step):
        n = len(dynamics.names)
        return dynamics.lower[:n], dynamics.upper[:n]

    monkeypatch.setattr(certify, "flow_box", still)
    assert grown("euler") > 0


@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_wrong_power_of_the_step_fails(monkeypatch, method):
    """Ts in place of Ts^2 for a step of more than one second, one power too many below."""
    whole = certify.step_factor
    monkeypatch.setattr(certify, "step_factor", lambda Ts, k, *parts: whole(Ts, k + 1, *parts))
    assert grown(method) > 0


def test_Ts_in_place_of_its_square_fails(monkeypatch):
    plant = Plant("slow")
    (x,) = plant.states("x", range=(1, 2))
    plant.dynamics([-x / 10])
    plant.outputs([x])

    def check():
        found = discretisation_remainder(plant, "euler", 4)
        return exceeded(found, *local_errors(found, 300))

    assert check() == 0
    whole = certify.step_factor
    monkeypatch.setattr(certify, "step_factor", lambda Ts, k, *parts: whole(Ts, k - 1, *parts))
    # a factorial less makes up for a power of 4 less only in part
    assert check() > 0


def test_a_tree_left_out_fails(monkeypatch):
    whole = certify.difference_term

    def short(x, rhs, method, order):
        return ca.SX.zeros(rhs.numel()) if order == 2 else whole(x, rhs, method, order)

    monkeypatch.setattr(certify, "difference_term", short)
    assert grown("euler") > 0


# -- the flow --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", list(CASES))
def test_solutions_stay_in_the_flow_box(name):
    build, Ts, given = CASES[name]
    plant = build()
    dynamics = system(plant, assumed(plant, given))
    lower, upper = flow_box(dynamics, float(Ts))
    n = len(dynamics.names)
    assert (lower < dynamics.lower[:n]).all()
    assert (upper > dynamics.upper[:n]).all()
    rng = np.random.default_rng(0)
    share = np.round(rng.random((2000, len(dynamics.lower))))
    points = (dynamics.lower + share * (dynamics.upper - dynamics.lower)).T
    constants = np.array([0.5 * (a + b) for a, b in dynamics.constant_box])[:, None]
    rates = ca.Function("f", [dynamics.x, dynamics.v, dynamics.constants], [dynamics.rhs])
    x, h = points[:n], float(Ts) / 50
    for _ in range(50):
        k1 = np.array(rates(x, points[n:], np.tile(constants, (1, 2000))))
        k2 = np.array(rates(x + h / 2 * k1, points[n:], np.tile(constants, (1, 2000))))
        x = x + h * k2
        assert (x >= lower[:, None]).all()
        assert (x <= upper[:, None]).all()


def test_flow_that_points_inwards_hardly_inflates():
    plant = Plant("attracted")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([-5 * x])
    plant.outputs([x])
    lower, upper = flow_box(system(plant), 1.0)
    assert -1.0 - 1e-6 < lower[0] < -1.0
    assert 1.0 < upper[0] < 1.0 + 1e-6


def test_solution_that_leaves_the_domain_is_refused():
    plant = Plant("emptying")
    (h,) = plant.states("h", range=(0.1, 1))
    plant.dynamics([-sp.sqrt(h)])
    plant.outputs([h])
    with pytest.raises(FlowError, match="range of h") as caught:
        discretisation_remainder(plant, "euler", 1)
    assert caught.value.symbol == "h"
    assert discretisation_remainder(plant, "euler", sp.Rational(1, 10)).upper[0] > 0.0


def test_solution_that_escapes_is_refused():
    with pytest.raises(FlowError, match="shorter Ts"):
        flow_box(system(growing()), 2.0)


def test_tubes_hold_the_exact_solution():
    dynamics = system(growing())
    start = np.array([[1.0, 1.5, 2.0]])
    lower, upper = flow.flow_tubes(dynamics, start, start, np.zeros((0, 3)), 0.1)
    for s in np.linspace(0, 0.1, 11):
        exact = 1 / (1 / start - s)
        assert (lower <= exact).all()
        assert (exact <= upper).all()
    assert (upper - lower).max() < 0.8


# -- series ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Lorenz", "van der Pol", "CSTR"])
@pytest.mark.parametrize(("method", "orders"), [("euler", (2, 3, 4)), ("rk4", (5, 6))])
def test_trees_equal_the_difference_of_two_derivatives(name, method, orders):
    build, _, given = CASES[name]
    plant = build()
    dynamics = system(plant, assumed(plant, given))
    rng = np.random.default_rng(0)
    point = dynamics.lower + rng.random(len(dynamics.lower)) * (dynamics.upper - dynamics.lower)
    constants = [0.5 * (a + b) for a, b in dynamics.constant_box]
    for order in orders:
        direct = time_derivatives(dynamics, order)[-1] - ca.substitute(
            step_derivatives(dynamics, step_formula(method), order)[-1], dynamics.s, 0
        )
        term = difference_term(dynamics.x, dynamics.rhs, method, order)
        function = ca.Function("both", [dynamics.variables, dynamics.constants], [term, direct])
        a, b = (np.array(v).ravel() for v in function([*point, 0.0], constants))
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12 * np.abs(b).max())


def test_a_taylor_polynomial_leaves_out_whole_derivatives():
    build, _, given = CASES["van der Pol"]
    dynamics = system(build(), assumed(build(), given))
    for order in (3, 4):
        term = difference_term(dynamics.x, dynamics.rhs, "taylor", order)
        whole = time_derivatives(dynamics, order)[-1]
        function = ca.Function("both", [dynamics.variables, dynamics.constants], [term, whole])
        middle = [0.5 * sum(ends) for ends in dynamics.constant_box]
        values = function([*dynamics.upper, 0.0], middle)
        np.testing.assert_allclose(*(np.array(v) for v in values), rtol=1e-12)


@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("rk4", 4)])
def test_no_difference_up_to_the_order_of_the_method(method, order):
    x = ca.SX.sym("x", 2)
    rhs = ca.vertcat(ca.sin(x[1]), x[0] * x[1])
    for k in range(1, order + 1):
        assert difference_term(x, rhs, method, k).is_zero()
    assert not difference_term(x, rhs, method, order + 1).is_zero()


def test_number_of_rooted_trees():
    assert [len(trees(k)) for k in range(1, 9)] == [1, 1, 2, 4, 9, 20, 48, 115]


# -- kinks -----------------------------------------------------------------------------------------


def test_kinks_lower_the_order():
    plant = Plant("drag")
    (v,) = plant.states("v", range=(-1, 2))
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.dynamics([u - v * sp.Abs(v)])
    plant.outputs([v])
    for method in ("euler", "rk4"):
        found = discretisation_remainder(plant, method, sp.Rational(1, 10))
        assert found.order <= 3
        assert exceeded(found, *local_errors(found, 3000)) == 0
    smooth = Plant("drag in one direction")
    (v,) = smooth.states("v", range=(1, 2))
    smooth.dynamics([-v * sp.Abs(v)])
    smooth.outputs([v])
    assert discretisation_remainder(smooth, "rk4", sp.Rational(1, 10)).order == 5


@pytest.mark.parametrize("form", [lambda v: 0.3 * v * ca.fabs(v), lambda v: ca.fabs(v) * (v * 0.3)])
def test_product_with_a_modulus_has_a_slope_without_a_jump(form):
    """0.3 v |v| has the slope 0.6 |v|; CasADi writes it with a sign."""
    v = ca.SX.sym("v")
    program = Program.from_casadi(ca.Function("slope", [v], [ca.gradient(form(v), v)]))
    assert not program.breaks(0)
    low, high = evaluate(program, np.array([[-1.0, 0.5]]), np.array([[2.0, 2.0]]))
    np.testing.assert_allclose(low, [[0.0, 0.3]], atol=1e-12)
    np.testing.assert_allclose(high, [[1.2, 1.2]], rtol=1e-12)


def test_jump_is_refused():
    plant = Plant("relay")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([-sp.sign(x)])
    plant.outputs([x])
    with pytest.raises(StructureError, match="may jump"):
        discretisation_remainder(plant, "euler", sp.Rational(1, 10))


# -- the plant that carries it ---------------------------------------------------------------------


def test_the_disturbed_plant_keeps_the_ranges_of_its_sensors():
    """Mutant: the step forgets the ranges."""
    plant = Plant("decay")
    plant.states("x", range=(0, 1))
    plant.dynamics(["-x"])
    plant.outputs(["x"], range=(-1, sp.oo))
    model = plant.discretise("euler", sp.Rational(1, 10), remainder=True)
    assert model.output_ranges.tolist() == [[-1.0, np.inf]]


def test_exact_step_gets_no_disturbance():
    plant = Plant("integrator")
    x, v = plant.states("x v", range=(-1, 1))
    (a,) = plant.inputs("a", range=(-1, 1))
    plant.dynamics([v, a])
    plant.outputs([x])
    euler = discretisation_remainder(plant, "euler", sp.Rational(1, 10))
    step = plant.discretise("euler", sp.Rational(1, 10), remainder=True)
    assert step.names("w") == ("remainder_x",)
    np.testing.assert_allclose(euler.upper, [0.005, 0.0], rtol=1e-9, atol=1e-12)


# -- refusals and reading --------------------------------------------------------------------------


def test_signal_without_a_range_is_named():
    with pytest.raises(UnboundedError, match=r"the unknown input d .* ranges=") as caught:
        discretisation_remainder(plants.quadruple_tank(), "euler", 1)
    assert caught.value.entries == ("d",)


def test_discrete_plant_is_refused():
    model = plants.quadruple_tank().discretise("euler", Ts=1.0)
    with pytest.raises(DerivationError, match="is discrete"):
        discretisation_remainder(model, "euler", 1)


@pytest.mark.parametrize("ranges", [{"nobody": (0, 1)}, {"x": (2, 1)}])
def test_ranges_that_make_no_sense(ranges):
    plant = Plant("decay")
    (x,) = plant.states("x", range=(1, 2))
    plant.dynamics([-x])
    plant.outputs([x])
    with pytest.raises(DerivationError):
        discretisation_remainder(plant, "euler", 1, ranges=ranges)


def test_remainder_can_be_read():
    found = certified("tank", "euler")
    text = str(found)
    assert "Remainder of euler, Ts = 1 s" in text
    assert "d in [-0.1, 0.1]" in text
    assert "h3" in text
    assert "<table>" in found._repr_html_()
    assert (found.radius >= np.abs(found.lower)).all()
