"""The extended plant: what is followed, what is taken away, and what counts as a disturbance."""

import numpy as np
import pytest
import sympy as sp
from members import belongs

import obsynth as ob
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.extended import extend


def sloped():
    """A car on a slope of any steepness, with wind on a gyro of half the size."""
    plant = ob.Plant("sloped")
    v, g, z = plant.states("v g z", range=[(0, 40), (-9, 9), (-1, 1)])
    slope, wind = plant.unknown_inputs("slope wind")
    (f,) = plant.faults("f", range=(-1, 1), rate=0.1)
    w = plant.disturbances("w1 w2", bound=[0.2, 0.1])
    push = sp.sin(slope) * (1 + v / 50) + wind**3
    plant.dynamics(
        [v * sp.Rational(99, 100) + 3 * push, g / 2 + push + f * v / 40, z / 3 + v / 50], Ts=1
    )
    plant.outputs([v + w[0], g + w[1], z * v])
    return plant


def test_unknown_inputs_of_any_size_leave_through_a_constant_direction():
    """Mutant: D0 by samples alone, its rows not divided by the pivot's."""
    extended = extend(sloped())
    assert extended.free == ("slope", "wind") and extended.followed == ("f",)
    assert extended.D0.tolist() in ([[1], [sp.Rational(1, 3)], [0], [0]], [[3], [1], [0], [0]])
    # wind at 0.1 on g is told worse than 3 times that on v
    assert extended.picked == (0,)
    rows = extended.plant.rhs
    assert not any(row.free_symbols & set(sp.symbols("slope wind", real=True)) for row in rows)
    v, g, f = sp.symbols("v g f", real=True)
    assert rows[0] == 0
    wanted = g / 2 + f * v / 40 - v * sp.Rational(33, 100)
    assert sp.expand(rows[1] - wanted) == 0
    C = extended.output_slopes()
    assert (extended.T0 - sp.eye(4) + extended.L0 * C).is_zero_matrix
    assert (extended.T0 * extended.D0).is_zero_matrix


def test_rounding_of_what_takes_an_unknown_input_away_is_bounded():
    """L0 = 1/3 is no double: what is left is 1/3 - fl(1/3) of the reading."""
    plant = ob.Plant("thirds")
    x, z = plant.states("x z", range=(-5, 5))
    (d,) = plant.unknown_inputs("d")
    plant.dynamics([x / 2 + d, z / 2 + x / 4 + d], Ts=1)
    plant.outputs([3 * x, z])
    extended = extend(plant)
    exact = np.array(extended.L0.evalf(25).tolist(), dtype=float)
    size = np.array([15.0, 5.0])
    leak = extended.leak(exact, size)
    apart = sp.Rational(1, 3) - sp.Rational(1 / 3)
    if extended.picked == (0,):
        assert float(abs(apart)) * 15 <= leak[0] <= float(abs(apart)) * 15 * 1.001
    worse = extended.leak(exact * (1 + 1e-9), size)
    assert np.all(worse >= leak) and worse.max() > 4e-9


def test_a_direction_that_turns_is_refused_by_name():
    plant = ob.Plant("turning")
    x, z = plant.states("x z", range=(-5, 5))
    (d,) = plant.unknown_inputs("d")
    plant.dynamics([x / 2 + d, z / 2 + x * d], Ts=1)
    plant.outputs([x])
    with pytest.raises(StructureError, match=r"d: .*no output of constant slopes|rank"):
        extend(plant)
    other = ob.Plant("turning")
    x, z, q = other.states("x z q", range=(1, 5))
    (d,) = other.unknown_inputs("d")
    other.dynamics([x / 2 + d, z / 2 + x * d, q / 2 + sp.sqrt(x) * d + d**2], Ts=1)
    other.outputs([x, z, q])
    extended = extend(other)
    assert sp.eye(3)[:, :3] == extended.D0


def test_two_rows_in_no_constant_ratio_are_two_directions():
    plant = ob.Plant("ratio")
    x, z = plant.states("x z", range=(1, 2))
    a, b = plant.unknown_inputs("a b")
    near = 1 + x * sp.Rational(1, 10**9)
    plant.dynamics([x / 2 + a + b, z / 2 + (a + b) * near], Ts=1)
    plant.outputs([x, z])
    assert sp.eye(2) == extend(plant).D0


def test_an_unknown_input_that_no_output_shows_is_refused_with_what_helps():
    plant = ob.Plant("hidden")
    x, z = plant.states("x z", range=(-5, 5))
    (d,) = plant.unknown_inputs("d")
    plant.dynamics([x / 2 + z, z / 2 + d], Ts=1)
    plant.outputs([x])
    with pytest.raises(StructureError, match="Measure z, or declare d with range="):
        extend(plant)


def test_everything_bounded_is_a_disturbance_and_the_measured_is_known():
    plant = ob.Plant("all kinds")
    (x,) = plant.states("x", range=(-5, 5))
    (u,) = plant.inputs("u", range=(0, 1))
    (d,) = plant.unknown_inputs("d", range=(-1, 1))
    (p,) = plant.params("p", value=2, tolerance=0.1)
    seen, hidden = (
        plant.scheduling("seen", range=(0, 1))[0],
        plant.scheduling("hidden", range=(0, 1), measured=False)[0],
    )
    f, still, bias = (
        plant.faults("f", range=(-1, 1), rate=0.25)[0],
        plant.faults("still", range=(-1, 1), constant=True)[0],
        plant.faults("bias", range=(-1, 1))[0],
    )
    (w,) = plant.disturbances("w", range=(0, 1))
    plant.dynamics([x / p + u * seen + hidden * d + f + still * x / 9 + bias + w], Ts=1)
    plant.outputs([x + w])
    extended = extend(plant)
    assert extended.plant.names("x") == ("x", "f", "still")
    assert extended.plant.names("u") == ("u", "seen")
    assert extended.plant.names("w") == ("w", "p", "hidden", "d", "bias", "step_f")
    assert extended.plant.box("w")[-1].tolist() == [-0.25, 0.25]
    assert extend(plant, ["f"]).plant.names("x") == ("x", "still")


def test_a_disturbance_without_a_bound_is_refused_by_name():
    plant = ob.Plant("loose")
    (x,) = plant.states("x", range=(-5, 5))
    (f,) = plant.faults("f")
    plant.dynamics([x / 2 + f], Ts=1)
    plant.outputs([x])
    with pytest.raises(StructureError, match=r"f has no bound.*rate="):
        extend(plant)


def test_the_joint_family_holds_the_jacobian_of_rows_and_outputs_everywhere():
    """Mutant: the outputs' rows left as those at the first point."""
    extended = extend(sloped())
    bounds = ob.jacobian_bounds(extended.plant, wrt="joint", rtol=1e-3, effort="fast")
    plant = extended.plant
    symbols = [s.symbol for s in (*plant.x, *plant.w)]
    J = sp.Matrix([*plant.rhs, *plant.output]).jacobian(symbols)
    function = sp.lambdify(symbols, J, "numpy")
    rng = np.random.default_rng(1)
    box = np.vstack([plant.box("x"), plant.box("w")])
    for _ in range(200):
        point = rng.uniform(box[:, 0], box[:, 1])
        point = np.where(rng.random(len(point)) < 0.3, box[:, 0], point)
        value = np.array(function(*point), dtype=float)
        assert belongs(bounds.family, value)
        assert np.all((bounds.min <= value + 1e-12) & (value - 1e-12 <= bounds.max))
    assert bounds.family.midpoint.shape == (4 + 3, 4 + len(plant.w))
