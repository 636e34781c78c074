"""Jumps of the dynamics are refused by name, kinks are bounded by both slopes."""

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.derive import StructureError, UnboundedError, jacobian_bounds
from obsynth.derive.jacobian.bounds import _jump, refuse_jumps
from obsynth.symbolic import Plant

half = sp.Rational(1, 2)


def plant_with(row, limits=(-1, 1)):
    plant = Plant("test")
    x, y = plant.states("x y", range=limits)
    plant.dynamics([row(x, y), -y])
    plant.outputs([x])
    return plant


def on(condition, value, otherwise=0):
    return sp.Piecewise((value, condition), (otherwise, True))


CONTINUOUS = {
    "kink": lambda x, y: sp.Abs(x) * y,
    "sign times itself": lambda x, y: x * sp.sign(x) * y,
    "saturation": lambda x, y: sp.Min(sp.Max(x + y, -half), half),
    "two branches": lambda x, y: sp.Piecewise((x**2, x < y), (x * y, True)),
    "dead zone": lambda x, y: sp.Piecewise((x, x < 0), (0, x <= half), (x - half, True)),
    "step inside one cell": lambda x, y: sp.floor(x / 3 + half) + y,
    "angle in the right half plane": lambda x, y: sp.atan2(y, x + 2),
    "surface outside the box": lambda x, y: sp.sign(x + 3) * y,
    "kinks along both axes": lambda x, y: sp.sign(x * y) * x * y,
    "two surfaces of one condition": lambda x, y: on(x**2 < y**2, y**2 - x**2),
    "two switches on one surface": lambda x, y: on(x > 0, x) * on(x > 0, 2, 1),
    "switches that cancel": lambda x, y: on(x > y, 1) + on(2 * y >= 2 * x, 1),
    "two cones that share a half": lambda x, y: on(y > sp.Abs(x), y - sp.Abs(x)) + on(y > x, y - x),
    "an even order": lambda x, y: on(x**2 * y > 0, y, on(y > 0, y)),
    "a switch of a switch": lambda x, y: on(x + sp.sign(x - y) * (x - y) > 4, 1),
}
JUMPS = {
    "sign": lambda x, y: sp.sign(x) + y,
    "step": lambda x, y: sp.Heaviside(x - y),
    "branches that differ": lambda x, y: sp.Piecewise((x, x < half), (x + y + 3, True)),
    "a later branch differs": lambda x, y: sp.Piecewise((x, x < 0), (0, y < 0), (y, True)),
    "a gap": lambda x, y: sp.Piecewise((x, x < half), (0, x <= half), (x - half, True)),
    "floor": lambda x, y: sp.floor(x),
    "angle over the cut": lambda x, y: sp.atan2(y, x),
    "two switches on one surface": lambda x, y: on(x > 0, 1) * on(x > 0, 2),
    "one surface, written twice": lambda x, y: on(x > y, 1) * on(2 * y < 2 * x, 2),
    "one surface inside another": lambda x, y: on(x * (y + 3) > 0, 1) * on(x > 0, 2),
    "product surface": lambda x, y: sp.sign(x * y) * x,
    "gear efficiency": lambda x, y: x * on(x * y > 0, sp.Rational(9, 10), sp.Rational(11, 10)) - y,
    "a point that is left out": lambda x, y: sp.sign(x) ** 2 * y,
    "a switch of a switch": lambda x, y: on(
        x + sp.Heaviside(y, 1) > half, x**2 - (sp.Heaviside(y, 1) - half) ** 2
    ),
    "a pole as a switch": lambda x, y: on(1 / x > -half, 1),
    "a line where the slope vanishes": lambda x, y: sp.sign(x * sp.Abs(y) - y**2) * (x - sp.Abs(y)),
    "surfaces that share a half": lambda x, y: on(y > sp.Abs(x), 1) * on(y > x, 1),
}


@pytest.mark.parametrize("name", sorted(CONTINUOUS))
def test_continuous_dynamics_pass(name):
    plant = plant_with(CONTINUOUS[name])
    found = jacobian_bounds(plant, effort="fast")
    function = plant.function()
    rng = np.random.default_rng(0)
    for a, b in rng.uniform(-1, 1, (200, 2, 2)):
        change = np.array(function(b, [], [], [], [], [], [])[0]).ravel()
        change -= np.array(function(a, [], [], [], [], [], [])[0]).ravel()
        # with M between its bounds, M (b - a) lies between these sums
        low = np.minimum(found.min * (b - a), found.max * (b - a)).sum(axis=1)
        high = np.maximum(found.min * (b - a), found.max * (b - a)).sum(axis=1)
        assert (change >= low - 1e-12).all()
        assert (change <= high + 1e-12).all()


def random_row(rng, x, y, continuous):
    """A product or sum of switches on few surfaces, some of them the same one."""
    surfaces = [x, -2 * x, y, x - y, x * y, x + half, 3 * y - x, x**2 - y**2, y * (x - half)]
    values = [sp.Integer(0), sp.Integer(1), x, y, x * y, x - y, x + y + 1]

    def factor():
        surface = surfaces[rng.integers(len(surfaces))]
        a, b = (values[rng.integers(len(values))] for _ in range(2))
        if continuous or rng.random() < 0.5:
            a = b + surface * a
        return on(surface > 0, a, b) if rng.random() < 0.7 else on(surface <= 0, b, a)

    parts = [factor() for _ in range(rng.integers(1, 4))]
    return sp.Add(*parts) if rng.random() < 0.5 else sp.Mul(*parts)


def jump_at(row, x, y):
    """The largest difference over 2e-9 across and onto lines on which switches lie."""
    function = sp.lambdify((x, y), row, "numpy")
    t = np.linspace(-0.97, 0.97, 38)
    lines = [
        (0 * t, t),
        (t, 0 * t),
        (t, t),
        (t, -t),
        (0 * t - 0.5, t),
        (0 * t + 0.5, t),
        (t, t / 3),
    ]
    worst = 0.0
    for a, b in lines:
        there = np.broadcast_to(function(a, b), t.shape)
        for da, db in ((1e-9, 0), (-1e-9, 0), (0, 1e-9), (0, -1e-9)):
            near = np.broadcast_to(function(a + da, b + db), t.shape)
            worst = max(worst, float(np.abs(near - there).max()))
    return worst


@pytest.mark.parametrize("seed", range(2))
def test_random_switches_against_dense_samples(seed):
    """Whatever jumps is refused; what is continuous by construction is not.

    Mutants: switches moved one by one (`_moved` returns the node where the rest is not a number),
    no factors of a product surface and no condition on the slope, the value on the surface (0) not
    compared, the sign without its order, inner switches not moved, denominators forgotten.
    """
    rng = np.random.default_rng(seed)
    x, y = sp.symbols("x y", real=True)
    box = {x: (-1.0, 1.0), y: (-1.0, 1.0)}
    jumps = 0
    for k in range(20):
        row = random_row(rng, x, y, continuous=k % 4 == 0)
        refused = _jump(row, box) is not None
        if jump_at(row, x, y) > 1e-6:
            jumps += 1
            assert refused, row
        elif k % 4 == 0:
            assert not refused, row
    assert jumps >= 5


def test_a_signal_that_is_held_makes_two_surfaces_one():
    """Mutant: refuse_jumps without ``held``."""
    limits = [(-1, 1), (0, 0)]
    kink = plant_with(lambda x, y: on(x + y > 0, x + y) * on(x > 0, 1, 2), limits)
    assert jacobian_bounds(kink, effort="fast").max[0, 0] == 2.0
    jump = plant_with(lambda x, y: on(x + y > 0, 1) * on(x > 0, 1), limits)
    with pytest.raises(StructureError, match="may jump where x = 0"):
        jacobian_bounds(jump)


@pytest.mark.parametrize("name", sorted(JUMPS))
def test_jumps_are_refused(name):
    with pytest.raises(StructureError, match="the row of x may jump where") as caught:
        jacobian_bounds(plant_with(JUMPS[name]))
    assert caught.value.row == "x"


def test_a_jump_is_no_jump_outside_of_its_surface():
    found = jacobian_bounds(plant_with(JUMPS["sign"], limits=(half / 2, 1)))
    np.testing.assert_array_equal(found.min, [[0.0, 1.0], [0.0, -1.0]])


def test_square_root_flow_between_tanks():
    """sign(z) sqrt|z| is continuous, its slope at z = 0 is not bounded."""

    def flow(x, y):
        return -sp.sign(x - y) * sp.sqrt(sp.Abs(x - y))

    with pytest.raises(UnboundedError, match="division by an interval that contains zero"):
        jacobian_bounds(plant_with(flow))
    apart = jacobian_bounds(plant_with(flow, limits=[(0.5, 1.0), (0.0, 0.25)]))
    assert apart.min[0, 0] == pytest.approx(-1.0, rel=1e-14)
    assert apart.max[0, 0] == pytest.approx(-0.5, rel=1e-14)
    assert str(apart.dependences[0]).startswith("m12 = -m11")


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("piecewise((sin(x)/x, x != 0), (1, True))", "sinc(x)"),
        ("piecewise((1, x == 0), (sin(x)/x, True))", "sinc(x)"),
        ("piecewise((y*sin(2*x)/x, x != 0), (2*y, True))", "2*y*sinc(2*x)"),
        ("y*piecewise(((exp(x - y) - 1)/(x - y), x != y), (1, True))", "y*phi1(x - y)"),
        ("piecewise((tanh(3*x)/(3*x), x != 0), (1, True))", "tanhc(3*x)"),
    ],
)
def test_a_quotient_with_its_limit_is_what_it_stands_for(text, meant):
    typed, named = (plant_with(lambda x, y, row=row: row) for row in (text, meant))
    assert typed.rhs == named.rhs
    found = jacobian_bounds(typed, effort="fast")
    np.testing.assert_array_equal(found.max, jacobian_bounds(named, effort="fast").max)


@pytest.mark.parametrize(
    "text",
    [
        "piecewise((sin(x)/x, x != 0), (2, True))",
        "piecewise((sin(x)/x, y != 0), (1, True))",
        "piecewise((sin(x)/x, x > 0), (1, True))",
        "piecewise(((1 - cos(x))/x, x != 0), (0, True))",
        "piecewise((x*sin(1/x), x != 0), (0, True))",
    ],
)
def test_a_quotient_that_is_not_continued_is_refused(text):
    """Mutants: `_continued` without ``same`` or without ``share``; `is_zero` that compares nan."""
    plant = plant_with(lambda x, y: text)
    assert plant.rhs[0].has(sp.Piecewise)
    with pytest.raises(StructureError, match="sinc, phi1 or tanhc"):
        jacobian_bounds(plant)


def stepped(row, method):
    plant = Plant("stepped")
    plant.states("x y", range=(-1, 1))
    plant.params("c", 1)
    plant.dynamics([row, "-y"])
    plant.outputs(["x"])
    return plant.discretise(method, sp.Rational(1, 100))


@pytest.mark.parametrize(
    "row",
    [
        "sign(x - y)*(sqrt(1/10) - sqrt(abs(x - y) + 1/10))",
        "piecewise((-x**3, x*y > 0), (-x**3 - x*y, True))",
        "-x + piecewise((y, y > 0), (y/2, True)) + max(x, y**2)",
    ],
)
@pytest.mark.parametrize("method", ["euler", "rk4"])
def test_a_step_is_as_continuous_as_its_derivatives(row, method):
    """Nested in a Runge-Kutta step their surfaces cannot be solved for a symbol."""
    refuse_jumps(stepped(row, method))


def test_a_jump_that_only_a_stage_meets_is_refused():
    """Mutants: the box of the states alone; the last stage left out; h/2 in place of h."""
    row = "c + piecewise((0, x < {}), (1, True))"
    refuse_jumps(stepped(row.format("1.0101"), "rk4"))
    refuse_jumps(stepped(row.format("1.0099"), "euler"))
    refuse_jumps(stepped("c", "rk4"))
    for at in ("0.999", "1.004", "1.0099"):
        with pytest.raises(StructureError, match=r"row of x may jump where .*x.* = 0"):
            refuse_jumps(stepped(row.format(at), "rk4"))
    with pytest.raises(StructureError, match="may jump where x - y = 0"):
        refuse_jumps(stepped("sign(x - y)", "euler"))


def test_the_bounds_of_a_step_with_a_nested_surface_hold():
    plant = stepped("sign(x - y)*(sqrt(1/10) - sqrt(abs(x - y) + 1/10))", "rk4")
    found = jacobian_bounds(plant, effort="fast")
    step = ca.Function("step", [plant.sx().x], [plant.sx().rhs])
    rng = np.random.default_rng(2)
    for _ in range(300):
        a, b = rng.uniform(-1, 1, (2, 2))
        b = a + (b - a) * 10.0 ** rng.uniform(-4, 0)
        change = np.array(step(a) - step(b)).ravel()
        ends = np.sort([found.min[0] * (a - b), found.max[0] * (a - b)], axis=0).sum(axis=1)
        assert ends[0] - 1e-12 <= change[0] <= ends[1] + 1e-12
