"""Every plant of the zoo goes through constants, remainders and the report on its faults."""

import casadi as ca
import numpy as np
import pytest

from obsynth.derive import (
    discretisation_remainder,
    excitation,
    fault_isolability,
    lipschitz,
    majorant,
    split,
)
from obsynth.derive.remainder.system import system
from obsynth.symbolic import plants

LONG = pytest.mark.long
ZOO = {
    "exothermic_cstr": plants.exothermic_cstr,
    "haldane_bioreactor": plants.haldane_bioreactor,
    "hinf_example": plants.hinf_example,
    "induction_motor": plants.induction_motor,
    "interval_example": plants.interval_example,
    "lorenz": plants.lorenz,
    "pmsm_dq": plants.pmsm_dq,
    "qpv_example": plants.qpv_example,
    "quadruple_tank": plants.quadruple_tank,
    "three_tanks": plants.three_tanks,
    "three_tanks_fdt": plants.three_tanks_fdt,
    "van_der_pol": plants.van_der_pol,
    "water_tanks": plants.water_tanks,
}
SLOW = {
    "bicycle": plants.bicycle,
    "planar_arm": lambda: plants.planar_arm(2),
    "planar_arm_bias": plants.planar_arm_bias,
    "quadrotor": plants.quadrotor,
}
EVERY = [*ZOO, *(pytest.param(name, marks=LONG) for name in SLOW)]
STEPS = {
    "bicycle": 0.01,
    "exothermic_cstr": 0.01,
    "haldane_bioreactor": 0.05,
    "induction_motor": 1e-4,
    "lorenz": 0.01,
    "planar_arm": 0.01,
    "pmsm_dq": 1e-4,
    "quadrotor": 0.01,
    "quadruple_tank": 1.0,
    "three_tanks": 1.0,
    "three_tanks_fdt": 0.1,
    "van_der_pol": 0.05,
    "water_tanks": 0.1,
}
CONTINUOUS = [pytest.param(name, marks=LONG) if name in SLOW else name for name in STEPS]


def build(name):
    return (ZOO | SLOW)[name]()


def right_hand_side(plant):
    """f(x, v) with everything else in v, and the boxes of both."""
    sx = plant.sx()
    kinds = ("u", "d", "f", "w", "p", "rho")
    held = ca.vertcat(*(getattr(sx, kind) for kind in kinds))
    box = np.vstack([plant.box(kind) for kind in kinds])
    function = ca.Function("f", [sx.x, held], [sx.rhs])
    return function, plant.box("x"), np.where(np.isfinite(box), box, 0.0)


def inside(box, count, rng):
    share = rng.random((count, len(box)))
    share[: count // 2] = np.round(share[: count // 2])
    return box[:, 0] + share * (box[:, 1] - box[:, 0])


@pytest.mark.parametrize("name", EVERY)
def test_slopes_of_every_plant_stay_within_its_constants(name):
    plant = build(name)
    found = lipschitz(plant, rtol=1e-3, effort="fast")
    function, box_x, box_v = right_hand_side(plant)
    rng = np.random.default_rng(0)
    a, v = inside(box_x, 3000, rng), inside(box_v, 3000, rng)
    length = 10.0 ** rng.uniform(-3, 0, (3000, 1)) * (box_x[:, 1] - box_x[:, 0])
    b = np.clip(a + length * rng.normal(size=a.shape), box_x[:, 0], box_x[:, 1])
    step, change = a - b, np.array(function(a.T, v.T) - function(b.T, v.T)).T
    square, inner = (step**2).sum(axis=1), (step * change).sum(axis=1)
    noise = 1e-12 * (1.0 + np.abs(np.array(function(a.T, v.T)).T).max(axis=1) ** 2) + 1e-8 * square
    assert ((change**2).sum(axis=1) <= found.norm.upper**2 * square * (1 + 1e-9) + noise).all()
    assert (inner <= found.one_sided.upper * square + noise).all()
    ball = found.inner.beta.upper * square + found.inner.gamma * inner
    assert ((change**2).sum(axis=1) <= ball + noise * max(1.0, found.norm.upper**2)).all()
    assert found.one_sided.upper <= found.norm.upper * (1 + 1e-12)
    for value in (found.norm, found.one_sided, found.inner.beta):
        assert value.attained <= value.upper


@pytest.mark.long
@pytest.mark.parametrize("name", CONTINUOUS)
def test_one_euler_step_of_every_plant_stays_within_its_remainder(name):
    plant = build(name)
    h = STEPS[name]
    small = (-1e-4, 1e-4) if name == "three_tanks" else (-0.1, 0.1)
    free = {s.name: small for kind in "udfw" for s in getattr(plant, kind) if not s.bounded}
    found = discretisation_remainder(plant, "euler", h, ranges=free)
    dynamics = system(plant, free)
    n = len(dynamics.names)
    constants = np.array([0.5 * (a + b) for a, b in dynamics.constant_box])[:, None]
    rates = ca.Function("f", [dynamics.x, dynamics.v, dynamics.constants], [dynamics.rhs])
    box = np.column_stack([dynamics.lower, dynamics.upper])
    points = inside(box, 600, np.random.default_rng(1)).T
    start, held, constants = points[:n], points[n:], np.tile(constants, (1, 600))

    def f(x):
        return np.array(rates(x, held, constants))

    x, parts = start, 60
    for _ in range(parts):
        k1 = f(x)
        k2 = f(x + h / parts / 2 * k1)
        k3 = f(x + h / parts / 2 * k2)
        k4 = f(x + h / parts * k3)
        x = x + h / parts / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    error = x - start - h * f(start)
    noise = 1e-12 * (np.abs(start).max(axis=1) + h * np.abs(f(start)).max(axis=1))
    # sixty steps of order four are far below a millionth of the remainder of order two
    noise = (noise + 1e-6 * found.radius)[:, None]
    assert (error >= found.lower[:, None] - noise).all()
    assert (error <= found.upper[:, None] + noise).all()
    assert (x >= found.flow_lower[:, None]).all()
    assert (x <= found.flow_upper[:, None]).all()
    assert (found.attained_lower >= found.lower).all()
    assert (found.attained_upper <= found.upper).all()


@pytest.mark.parametrize("name", EVERY)
def test_faults_of_every_plant_are_reported(name):
    plant = build(name)
    found, moving = fault_isolability(plant), excitation(plant)
    assert found.faults == plant.names("f")
    assert found.at_once <= min(len(plant.output_names), len(found.faults))
    assert moving.visible_at_rest <= found.at_once
    assert len(moving.effects) == len(found.faults)
    grouped = [n for group in found.groups for n in group]
    assert sorted(grouped) == sorted(np.array(found.faults)[found.detectable].tolist())


@pytest.mark.parametrize(
    "name", ["lorenz", "pmsm_dq", "quadruple_tank", "van_der_pol", "induction_motor"]
)
def test_majorants_of_plants_hold(name):
    parts = split(build(name), linear="terms")
    found = majorant(parts, rtol=1e-6)
    g = parts.g_function()
    model = parts.model
    rng = np.random.default_rng(0)
    a, b, u = inside(model.box("x"), 2000, rng), inside(model.box("x"), 2000, rng), None
    u = inside(model.box("u"), 2000, rng)
    change = np.array(g(a.T, u.T) - g(b.T, u.T)).T
    # the rounding of A that g carries is no part of the majorant
    slack = 1e-12 * (1.0 + np.abs(change).max()) ** 2
    assert ((change**2).sum(axis=1) <= ((a - b) ** 2 @ found.diagonal) + slack).all()
