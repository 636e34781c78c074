"""Every plant of the zoo: complete, the same in SymPy and CasADi, kept as text, and physical."""

import inspect
import json
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic import Plant, PlantError, plants
from obsynth.symbolic.sxmodel import ParityError
from zoo import GALLERY, ZOO

KINDS = ("x", "u", "d", "f", "w", "p", "rho")


ALL = {**ZOO, **GALLERY}


@pytest.fixture(params=ALL)
def plant(request):
    return ALL[request.param]()


def points(plant, count, seed=0):
    """Points of the box by kind; signals without bounds in (-1, 1)."""
    rng = np.random.default_rng(seed)
    found = {}
    for kind in KINDS:
        box = plant.box(kind)
        low, high = (np.where(np.isfinite(box[:, k]), box[:, k], 2 * k - 1) for k in (0, 1))
        found[kind] = rng.uniform(low, high, (count, len(box)))
    return found


def with_values(plant, expression):
    return sp.sympify(expression).subs(plant.constant_values)


def at(plant, expression, **signals):
    """Value of an expression where the named signals have values and all others are zero."""
    values = {
        s.symbol: sp.sympify(signals.pop(s.name, 0)) for s in plant.signals if s.value is None
    }
    assert not signals
    return with_values(plant, expression).subs(values)


def derivatives(plant, x, u=()):
    """Right-hand side of a continuous plant without scheduling, at undisturbed points."""
    sx = plant.sx()
    rest = [np.zeros(getattr(sx, kind).numel()) for kind in ("d", "f", "w", "p", "rho")]
    return np.array(plant.function()(x, u, *rest)[0]).ravel()


def test_every_constructor_is_in_the_zoo():
    covered = {name.split(" ")[0] for name in ALL}
    assert covered == set(plants.__all__) - {"planar_arm_terms"}
    assert list(plants.__all__) == sorted(plants.__all__)


@pytest.mark.parametrize("name", plants.__all__)
def test_constructors_name_their_source_and_show_an_example(name):
    text = inspect.getdoc(getattr(plants, name)) or ""
    written = (Path(plants.__file__).parent / f"{name}.toml").is_file()
    assert written or ">>> " in text
    assert name == "planar_arm_terms" or "bias" in name or "References\n" in text


def test_plants_are_complete(plant):
    assert plant.check() is plant
    assert len(plant.x) == plant.rhs.rows > 0
    assert plant.output.rows == len(plant.output_names) > 0
    for kind in ("x", "u", "rho"):
        assert np.isfinite(plant.box(kind)).all(), f"{kind} of {plant.name} without range"
    assert all(np.isfinite([s.lower, s.upper]).all() or s.rate is not None for s in plant.f)
    nominal = [(s.lower, s.nominal, s.upper) for s in (*plant.x, *plant.u) if s.nominal is not None]
    assert all(low <= value <= high for low, value, high in nominal)
    known = {s.symbol for s in plant.signals}
    used = plant.rhs.free_symbols | plant.output.free_symbols
    assert used == known, f"declared and used signals differ: {used ^ known}"


def test_every_constant_is_exact(plant):
    assert not [s for s, v in plant.constant_values.items() if sp.sympify(v).has(sp.Float)]


def test_sympy_and_casadi_agree(plant):
    symbols = [s.symbol for kind in KINDS for s in getattr(plant, kind)]
    rows = [with_values(plant, e) for e in [*plant.rhs, *plant.output]]
    direct = sp.lambdify(symbols, rows, "numpy")
    function = plant.function()
    sample = points(plant, 30, seed=1)
    for k in range(30):
        blocks = [sample[kind][k] for kind in KINDS]
        left = np.concatenate([np.array(part).ravel() for part in function(*blocks)])
        right = np.array(direct(*np.concatenate(blocks)), dtype=float)
        np.testing.assert_allclose(left, right, rtol=1e-12, atol=1e-12)


def test_the_conversion_check_sees_a_wrong_sign(monkeypatch):
    from obsynth.symbolic import functions

    table = dict(functions.BY_CLASS)
    wrong = functions.NamedFunction("sin", sp.sin, lambda x: -functions.BY_NAME["sin"].casadi(x))
    table[sp.sin] = wrong
    monkeypatch.setattr("obsynth.symbolic.convert.BY_CLASS", table)
    with pytest.raises(ParityError):
        plants.quadrotor().sx()


def test_plants_survive_as_text(plant):
    data = json.loads(json.dumps(plant.to_dict()))
    again = Plant.from_dict(data)
    assert again.to_dict() == data
    assert again.signals == plant.signals
    assert again.output_names == plant.output_names
    assert again.Ts == plant.Ts
    sample = points(plant, 5, seed=2)
    for k in range(5):
        blocks = [sample[kind][k] for kind in KINDS]
        for left, right in zip(plant.function()(*blocks), again.function()(*blocks), strict=True):
            np.testing.assert_allclose(np.array(left), np.array(right), rtol=1e-14, atol=1e-300)


@pytest.mark.parametrize(
    ("build", "named"),
    [
        (lambda: plants.hinf_example("printed"), "as_printed"),
        (lambda: plants.bicycle("rubber"), "pacejka"),
        (lambda: plants.planar_arm(4), "2 or 3"),
        (lambda: plants.planar_arm_bias(1), "2 to 6"),
    ],
)
def test_unknown_variants_are_refused(build, named):
    with pytest.raises(PlantError, match=named):
        build()


# -- the papers' examples -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("variant", "last"),
    [
        ("consistent", [4.727496899861398, 6.582031928531165, 9.41989618537667]),
        ("as_printed", [4.72870438644901, 6.582830032268508, 9.41213532046283]),
    ],
)
def test_hinf_example_reaches_the_state_of_the_scenario(variant, last):
    plant = plants.hinf_example(variant)
    function, x = plant.function(), np.array([3.0, 2.0, 1.0])
    for k in range(500):
        fault = 1.0 if 200 <= k <= 300 else 0.0
        x = np.array(function(x, np.sin(0.002 * np.pi * k), [], fault, [0] * 3, [], [])[0]).ravel()
    np.testing.assert_allclose(x, last, rtol=0, atol=1e-11)


def test_qpv_example_rests_at_the_centre_for_the_inputs_of_its_vertices():
    plant = plants.qpv_example()
    inputs = {
        (0, 0): [sp.Rational(145, 2), 10, 10],
        (0, 1): [sp.Rational(535, 6), 30, 10],
        (1, 0): [sp.Rational(875, 22), -30, 25],
        (1, 1): [sp.Rational(1075, 22), -10, 25],
    }
    for (t1, t2), (u1, u2, u3) in inputs.items():
        signals = {"x1": 10, "x2": 10, "x3": 10, "u1": u1, "u2": u2, "u3": u3}
        assert at(plant, plant.rhs, theta1=t1, theta2=t2, **signals) == sp.zeros(3, 1)


def test_qpv_example_has_the_vertices_of_the_paper():
    plant = plants.qpv_example()
    x = [s.symbol for s in plant.x]
    A = plant.rhs.jacobian(x)
    assert at(plant, A, theta1=1, theta2=1) == sp.Matrix(
        [[-5, 10, 4], [-1, -2, sp.Rational(7, 2)], [1, 1, -7]]
    )
    assert at(plant, A, theta1=1, f2=3) - at(plant, A, theta1=1) == sp.diag(0, 3, 0)


def test_interval_example_follows_the_reference():
    plant, function = plants.interval_example(), plants.interval_example().function()
    x = np.ones(3)
    reference = {10: [0.164445, -0.535321, 0.235520], 100: [-0.996935, 0.546263, -0.202375]}
    for k in range(101):
        if k in reference:
            np.testing.assert_allclose(x, reference[k], rtol=0, atol=1e-6)
        assert (np.abs(x) < plant.box("x")[:, 1]).all()
        u = 1.5 * x[0] + 2 * x[2]
        rho = [np.sin(0.2 * k), np.cos(0.1 * k)]
        x = np.array(function(x, u, [], np.cos(0.5 * k), [0] * 5, [], rho)[0]).ravel()


def _three_tanks_under_control(sign):
    """The controlled tanks at t = 50, Runge-Kutta; the sign of the inflow in row 2."""
    plant = plants.three_tanks()
    a20, k, area = 1.772e-4, 1.329e-3, 0.0154
    h, x = 0.05, np.array([0.5, 0.1, 0.3])

    def rho(z):
        return np.sign(z) * np.sqrt(abs(z))

    def slope(x):
        u = [max(0, -k * rho(x[0] - 0.5)), max(0, -k * rho(x[1] - 0.1) + a20 * rho(x[1]))]
        found = derivatives(plant, x, u)
        found[1] += (sign - 1) * 1.329e-4 * rho(x[2] - x[1]) / area
        return found

    for _ in range(1000):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(x + h * k3))
    return x


def test_three_tanks_follow_the_reference():
    expected = [0.49802839, 0.10644992, 0.30089414]
    np.testing.assert_allclose(_three_tanks_under_control(1), expected, rtol=0, atol=1e-6)


def test_the_reference_sees_the_sign_that_is_misprinted():
    assert abs(_three_tanks_under_control(-1)[1] - 0.10644992) > 0.005


def test_three_tanks_keep_their_water():
    plant = plants.three_tanks()
    u = [s.symbol for s in (*plant.u, *plant.f)]
    x2 = plant.x[1].symbol
    out = sp.Rational(1772, 10**7) * sp.sign(x2) * sp.sqrt(sp.Abs(x2))
    total = with_values(plant, sum(plant.rhs)) * sp.Rational(154, 10**4)
    assert sp.expand(total - (sum(u) - out)) == 0


# -- process plants -----------------------------------------------------------------------------


def test_cstr_has_three_steady_states_of_which_the_cold_one_is_stable():
    plant = plants.exothermic_cstr()
    c, T = (s.symbol for s in plant.x)
    rows = [at(plant, e, T_c=300, C_A=c, T=T) for e in plant.rhs]
    of_T = sp.solve(rows[0], c)[0]
    balance = sp.lambdify(T, rows[1].subs(c, of_T), "numpy")
    grid = np.linspace(300, 400, 2001)
    cuts = grid[:-1][np.diff(np.sign(balance(grid))) != 0]
    tangent = sp.Matrix(rows).jacobian([c, T])
    states, unstable = [], []
    for cut in cuts:
        found = sp.nsolve(rows, (c, T), (of_T.subs(T, cut), cut))
        states.append([float(v) for v in found])
        slope = np.array(tangent.subs({c: found[0], T: found[1]}), dtype=float)
        unstable.append(int((np.linalg.eigvals(slope).real > 0).sum()))
    expected = [[0.8773, 324.475], [0.4999, 350.006], [0.2088, 369.705]]
    np.testing.assert_allclose(states, expected, rtol=2e-4)
    assert unstable == [0, 1, 2]


def test_haldane_has_the_steady_states_of_the_source():
    plant = plants.haldane_bioreactor()
    X, S = (s.symbol for s in plant.x)
    rows = [sp.together(at(plant, e, D=sp.Rational(3, 10), X=X, S=S)) for e in plant.rhs]
    growth = sp.numer(sp.cancel(rows[0] / X))
    found = sorted(float(v) for v in sp.Poly(growth, S).nroots())
    assert found == pytest.approx([0.174593, 1.512243], abs=1e-6)
    biomass = [0.4 * (4 - s) for s in found]
    assert biomass == pytest.approx([1.530163, 0.995103], abs=1e-6)
    for x, s in [*zip(biomass, found, strict=True), (0.0, 4.0)]:
        assert np.abs(derivatives(plant, [x, s], [0.3])).max() < 1e-18 * 3600


def test_water_tanks_rest_and_show_every_fault():
    plant = plants.water_tanks()
    rest = {"h1": 4, "h2": sp.Rational(25, 4), "u": 4}
    assert at(plant, plant.rhs, **rest) == sp.zeros(2, 1)
    quiet = at(plant, plant.output, **rest)
    rows = sp.Matrix([plant.rhs, plant.output])
    touched = {
        name: [k for k, e in enumerate(rows) if e.has(sp.Symbol(name, real=True))]
        for name in plant.names("f")
    }
    assert touched == {"fh2": [3], "ff1": [4], "fc1": [0, 1, 4], "fl2": [1], "fl3": [5], "fa": [0]}
    leaking = at(plant, plant.output, fl3=sp.Rational(1, 2), **rest)
    assert leaking[3] == quiet[3] / 2


def test_three_tanks_of_the_toolbox_have_its_matrices():
    plant = plants.three_tanks_fdt()
    x = [s.symbol for s in plant.x]
    assert with_values(plant, plant.rhs.jacobian(x)) == sp.Matrix(
        [[-1, 1, 0], [1, -2, 1], [0, 1, -2]]
    )
    faults = with_values(plant, plant.rhs.jacobian([s.symbol for s in plant.f]))
    assert faults[:, :3] == sp.Matrix([[-1, 0, 0], [1, -1, 0], [0, 1, -1]])
    assert faults[:, 3:] == sp.eye(3)


# -- electrical machines ------------------------------------------------------------------------


def test_pmsm_keeps_its_power():
    plant = plants.pmsm_dq()
    i_d, i_q, w = (s.symbol for s in plant.x)
    R, L_d, L_q, J = (sp.Symbol(n, real=True) for n in ("R", "L_d", "L_q", "J"))
    rate_d, rate_q, rate_w = plant.rhs.subs({s.symbol: 0 for s in plant.f})
    u_d, u_q = (s.symbol for s in plant.u)
    load = plant.d[0].symbol
    stored = sp.Rational(3, 2) * (L_d * i_d * rate_d + L_q * i_q * rate_q) + J * w * rate_w
    lost = sp.Rational(3, 2) * R * (i_d**2 + i_q**2) + load * w
    assert sp.expand(sp.Rational(3, 2) * (u_d * i_d + u_q * i_q) - lost - stored) == 0


def test_pmsm_gives_its_rated_torque_below_its_rated_current():
    plant = plants.pmsm_dq()
    peak = 4.3 * np.sqrt(2)
    angle = np.linspace(0, np.pi, 1801)
    torque = [
        0.015 * derivatives(plant, [peak * np.cos(a), peak * np.sin(a), 0], [0, 0])[2]
        for a in angle
    ]
    assert 14 < max(torque) < 17
    assert np.degrees(angle[int(np.argmax(torque))]) > 90


def test_induction_motor_keeps_its_power():
    plant = plants.induction_motor()
    i = sp.Matrix([s.symbol for s in plant.x[:2]])
    psi = sp.Matrix([s.symbol for s in plant.x[2:4]])
    w, load = plant.x[4].symbol, plant.d[0].symbol
    R_s, R_R, L_s, L_M, J = (sp.Symbol(n, real=True) for n in ("R_s", "R_R", "L_s", "L_M", "J"))
    u = sp.Matrix([s.symbol for s in plant.u])
    rates = plant.rhs
    rotor = psi / L_M - i
    stored = L_s * i.dot(rates[:2, 0]) + psi.dot(rates[2:4, 0]) / L_M
    lost = R_s * i.dot(i) + R_R * rotor.dot(rotor)
    electric = sp.Rational(3, 2) * (u.dot(i) - lost - stored)
    assert sp.expand(electric - (J * rates[4] + load) * w) == 0


def test_flux_of_the_induction_motor_turns_with_its_rotor():
    plant = plants.induction_motor()
    psi = np.array([0.6, -0.3])
    found = derivatives(plant, [*(psi / 0.224), *psi, 100.0], [0, 0])[2:4]
    np.testing.assert_allclose(found, 200.0 * np.array([-psi[1], psi[0]]), rtol=1e-12)


# -- mechanics ----------------------------------------------------------------------------------


def test_quadrotor_hovers():
    plant = plants.quadrotor()
    hover = sp.Rational(63765, 10**4)
    assert at(plant, plant.rhs, T=hover) == sp.zeros(12, 1)
    assert at(plant, plant.rhs, T=hover, psi=2, px=3) == sp.zeros(12, 1)


def test_torques_aside_a_quadrotor_keeps_its_rotation():
    plant = plants.quadrotor()
    names = {s.name: s.symbol for s in plant.signals}
    rates = plant.rhs.subs({names[n]: 0 for n in ("tx", "ty", "tz", "f1", "f2", "f3")})[9:, 0]
    w = sp.Matrix([names[n] for n in "pqr"])
    inertia = sp.diag(*[names[f"I_{axis}"] for axis in "xyz"])
    assert sp.expand((w.T * inertia * rates)[0]) == 0
    assert sp.expand(((inertia * w).T * inertia * rates)[0]) == 0


def test_angles_of_the_quadrotor_turn_its_thrust():
    plant = plants.quadrotor()
    names = {s.name: s.symbol for s in plant.signals}
    phi, theta, psi = (names[n] for n in ("phi", "theta", "psi"))
    turn_x = sp.Matrix([[1, 0, 0], [0, sp.cos(phi), -sp.sin(phi)], [0, sp.sin(phi), sp.cos(phi)]])
    turn_y = sp.Matrix(
        [[sp.cos(theta), 0, sp.sin(theta)], [0, 1, 0], [-sp.sin(theta), 0, sp.cos(theta)]]
    )
    turn_z = sp.Matrix([[sp.cos(psi), -sp.sin(psi), 0], [sp.sin(psi), sp.cos(psi), 0], [0, 0, 1]])
    rotation = turn_z * turn_y * turn_x
    angles = sp.Matrix([phi, theta, psi])
    p, q, r = (names[n] for n in "pqr")
    spin = sp.Matrix([[0, -r, q], [r, 0, -p], [-q, p, 0]])
    moved = rotation.applyfunc(lambda e: (sp.Matrix([e]).jacobian(angles) * plant.rhs[6:9, 0])[0])
    thrust = plant.rhs[3:6, 0].diff(names["T"]) * names["m"]
    values = {phi: 0.4, theta: -0.3, psi: 1.1, p: 0.7, q: -0.2, r: 0.5}
    difference = np.array((moved - rotation * spin).subs(values), dtype=float)
    assert np.abs(difference).max() < 1e-14
    assert sp.expand(thrust - rotation[:, 2]) == sp.zeros(3, 1)


@pytest.mark.parametrize("gravity", [0, sp.Rational(981, 100)])
@pytest.mark.parametrize("n", [2, 3])
def test_torques_alone_change_the_energy_of_an_arm(n, gravity):
    plant = plants.planar_arm(n, gravity)
    q, dq = ([s.symbol for s in plant.x[k : k + n]] for k in (0, n))
    _, _, energy = plants.planar_arm_terms(q, dq, gravity)
    slope = sp.lambdify([*q, *dq], sp.Matrix([energy]).jacobian([*q, *dq]), "numpy")
    sample = points(plant, 40, seed=3)
    for x, u in zip(sample["x"], sample["u"], strict=True):
        change = (slope(*x) @ derivatives(plant, x, u)).item()
        assert change == pytest.approx(float(x[n:] @ u), abs=1e-12)


@pytest.mark.parametrize("n", [2, 3])
def test_forward_dynamics_invert_the_equations_of_motion(n):
    plant = plants.planar_arm(n)
    q, dq = ([s.symbol for s in plant.x[k : k + n]] for k in (0, n))
    mass, bias, _ = plants.planar_arm_terms(q, dq)
    terms = sp.lambdify([*q, *dq], [mass, bias], "numpy")
    sample = points(plant, 40, seed=4)
    for x, u in zip(sample["x"], sample["u"], strict=True):
        M, h = terms(*x)
        assert np.linalg.eigvalsh(M).min() > 0
        np.testing.assert_allclose(M @ derivatives(plant, x, u)[n:] + h.ravel(), u, atol=1e-12)


def test_two_link_terms_equal_the_textbook():
    (q1, q2), (v1, v2) = sp.symbols("q1:3"), sp.symbols("v1:3")
    g = sp.Symbol("g")
    mass, bias, _ = plants.planar_arm_terms((q1, q2), (v1, v2), g)
    c, s = sp.cos(q2), sp.sin(q2)
    assert sp.expand(mass - sp.Matrix([[3 + 2 * c, 1 + c], [1 + c, 1]])) == sp.zeros(2, 2)
    weight = g * sp.Matrix([2 * sp.sin(q1) + sp.sin(q1 + q2), sp.sin(q1 + q2)])
    coriolis = sp.Matrix([-s * (2 * v1 * v2 + v2**2), s * v1**2])
    assert sp.expand(bias - weight - coriolis) == sp.zeros(2, 1)


def test_bias_vector_is_that_of_the_arm():
    arm, alone = plants.planar_arm(3), plants.planar_arm_bias(3)
    q, dq = ([s.symbol for s in arm.x[k : k + 3]] for k in (0, 3))
    mass, _, _ = plants.planar_arm_terms(q, dq)
    M = sp.lambdify(q, mass, "numpy")
    sample = points(arm, 20, seed=5)
    for x, u in zip(sample["x"], sample["u"], strict=True):
        expected = M(*x[:3]) @ derivatives(arm, x, u)[3:]
        np.testing.assert_allclose(derivatives(alone, x, u)[3:], expected, atol=1e-12)


def test_magic_formula_starts_with_its_slope_and_peaks_at_its_friction():
    car, straight = plants.bicycle(), [20.0, 0.0, 0.0, 0.0]
    x = [s.symbol for s in car.x]
    tangent = [
        np.array(at(p, p.rhs.jacobian(x).subs(dict(zip(x, straight, strict=True)))), dtype=float)
        for p in (car, plants.bicycle("linear"))
    ]
    np.testing.assert_allclose(tangent[0], tangent[1], rtol=1e-12, atol=1e-12)
    # sliding sideways at r = delta = 0 both axles have one slip: acceleration / g is the friction
    grip = [derivatives(car, [10.0, v, 0, 0], [0, 0])[1] / 9.81 for v in np.linspace(0, 5, 2001)]
    assert min(grip) == pytest.approx(-1.0489, abs=1e-5)


def test_bicycle_drives_straight_at_any_speed():
    plant = plants.bicycle()
    for speed in (10, 23, 30):
        assert at(plant, plant.rhs, v_x=speed) == sp.zeros(4, 1)


# -- oscillators --------------------------------------------------------------------------------


def test_lorenz_fixed_points():
    plant = plants.lorenz()
    root = sp.sqrt(72)
    for x, y, z in ((0, 0, 0), (root, root, 27), (-root, -root, 27)):
        assert at(plant, plant.rhs, x=x, y=y, z=z).applyfunc(sp.expand) == sp.zeros(3, 1)


def test_lorenz_attractor_stays_in_the_box():
    plant, h = plants.lorenz(), 0.01
    x, box = np.array([1.0, 1.0, 20.0]), plants.lorenz().box("x")
    for _ in range(2000):
        k1 = derivatives(plant, x)
        k2 = derivatives(plant, x + h / 2 * k1)
        k3 = derivatives(plant, x + h / 2 * k2)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + derivatives(plant, x + h * k3))
        assert ((box[:, 0] < x) & (x < box[:, 1])).all()


def test_van_der_pol_has_its_limit_cycle():
    plant, h = plants.van_der_pol(), 0.02
    x, path = np.array([2.0, 0.0]), []
    for _ in range(2000):
        k1 = derivatives(plant, x, [0])
        k2 = derivatives(plant, x + h / 2 * k1, [0])
        k3 = derivatives(plant, x + h / 2 * k2, [0])
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + derivatives(plant, x + h * k3, [0]))
        path.append(x)
    late = np.array(path[1000:])
    assert late[:, 0].max() == pytest.approx(2.00862, abs=2e-4)
    upwards = np.flatnonzero((late[:-1, 0] < 0) & (late[1:, 0] >= 0))
    assert np.diff(upwards).mean() * h == pytest.approx(6.66329, abs=2e-2)
