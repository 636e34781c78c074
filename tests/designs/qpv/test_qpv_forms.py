"""The error dynamics, the relaxation for outputs that vary, polytopes, actuator and slow faults."""

import itertools

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

import obsynth as ob
from obsynth.designs.qpv.error_matrix import (
    ErrorSets,
    entering,
    extreme_points,
    psi_family,
    psi_kept,
)
from obsynth.designs.qpv.model import read_form
from obsynth.designs.qpv.sets import box, cross, hull

REGION = ob.Ellipsoid([1.0, 0.1], [5.0, 0.0])


def varying(process=True, rate=None):
    """x' = -x + f x + u + w, measured with a gain that is scheduled: C varies."""
    made = ob.Plant("varying output")
    (x,) = made.states("x", range=(3, 7), nominal=5)
    (u,) = made.inputs("u", range=(0, 20), nominal=5)
    (theta,) = made.scheduling("theta", range=(0, 1))
    (w,) = made.disturbances("w", bound=0.1)
    if process:
        (f,) = made.process_faults("f", range=(-0.3, 0.3), rate=rate)
        made.dynamics([-(1 + theta) * x + f * x + u + w])
    else:
        (f,) = made.actuator_faults("f", of=u, range=(-0.3, 0.3), rate=rate)
        made.dynamics([-(1 + theta) * x + u + w])
    made.outputs([(1 + theta / 2) * x + sp.Rational(1, 10) * w])
    return made


def small(**changes):
    return ob.QPVObserver(
        **{"region": REGION, "eta": 0.4, "performance_output": [[0, 1]], **changes}
    )


@settings(derandomize=True, max_examples=40, deadline=None)
@given(
    st.sampled_from(["upper", "symmetric"]),
    st.lists(st.floats(-2, 2), min_size=12, max_size=12),
    st.lists(st.floats(0, 1), min_size=2, max_size=2),
)
def test_psi_is_the_difference_of_the_quadratic_terms(form, numbers, theta):
    """(10), (30): N(x) x - N(xhat) xhat = Psi(x, e) e, at any point of the polytopes."""
    form_of = read_form(ob.plants.qpv_example(), form)
    N = form_of.vertices().N
    x, e = np.array(numbers[:6]), np.array(numbers[6:])

    def quadratic(v):
        return np.einsum("a,iab,b->i", v, N[0], v)

    symmetric = N[0] + np.swapaxes(N[0], -1, -2)
    psi = np.einsum("a,iab->ib", x, symmetric) - np.einsum("a,iab->ib", e, N[0])
    np.testing.assert_allclose(psi @ e, quadratic(x) - quadratic(x - e), atol=1e-12)
    state, error = entering(N)
    sets = ErrorSets(
        np.zeros(6),
        box(2 * np.ones(6)),
        box(2 * np.ones(6)),
        np.zeros((1, 6)),
        state,
        error,
    )
    row = np.concatenate([x[list(state)], e[list(error)]])[None]
    assert psi_family(N[0], sets, rows=row).contains(psi[None])
    # mutant: the sign of the error's part
    wrong = np.einsum("a,iab->ib", x, symmetric) + np.einsum("a,iab->ib", e, N[0])
    if np.abs(np.einsum("a,iab->ib", e, N[0]) @ e).max() > 1e-6:
        assert np.abs(wrong @ e - (quadratic(x) - quadratic(x - e))).max() > 1e-7


@pytest.mark.parametrize("kind", [box, cross])
def test_dropped_pairs_are_convex_combinations_of_kept_ones(kind):
    from scipy.optimize import linprog

    N = read_form(ob.plants.qpv_example(), "upper").vertices().N
    shape = kind(np.sqrt([0.2, 0.2, 0.2, 0.1, 0.1, 0.1]))
    state, error = entering(N)
    sets = ErrorSets(
        np.array([10.0, 10, 10, 0, 0, 0]),
        shape,
        shape,
        shape.vertices,
        state,
        error,
    )
    every = psi_family(N[0], sets).mid.reshape(-1, 36)
    kept = psi_kept(N, sets)[0].reshape(-1, 36)
    columns = np.vstack([kept.T, np.ones(len(kept))])
    for row in every[:: max(1, len(every) // 40)]:
        found = linprog(np.zeros(len(kept)), A_eq=columns, b_eq=np.append(row, 1.0))
        assert found.success
    # mutant: without one of the kept pairs some pair is no combination any more
    fewer = columns[:, 1:]
    assert not linprog(np.zeros(len(kept) - 1), A_eq=fewer, b_eq=columns[:, 0]).success


@pytest.mark.parametrize("count", [1, 2, 8])
def test_no_corner_is_lost_in_any_number_of_coordinates(count):
    """In many coordinates nothing goes but what is twice. Mutant: the first row left out."""
    corners = np.array(list(itertools.product((-1.0, 1.0), repeat=count)))
    points = np.vstack([0.5 * corners[:3], corners, corners])
    kept = points[extreme_points(points)]
    assert {tuple(row) for row in kept.tolist()} >= {tuple(row) for row in corners.tolist()}
    assert len(kept) == len(corners) + (3 if count > 7 else 0)


def test_outputs_that_vary_are_relaxed_and_hold_between_the_vertices():
    plant = varying()
    observer = small().design(plant)
    assert not small().read(plant).data.collapses
    assert "3 Polya terms" in observer.certificate["decay"].statement
    P, L = observer.gains["P"], np.stack([observer.gains["L1"], observer.gains["L2"]])
    alpha = observer.performance["decay"]
    half = np.sqrt([1.0, 0.1]) / np.sqrt(2.0) / 0.4
    worst = -np.inf
    for t in np.linspace(0, 1, 21):
        A = np.array([[-(1 + t), 0], [0, 0]])
        C = np.array([[1 + t / 2, 0]])
        gain = (1 - t) * L[0] + t * L[1]
        for sx, sf, se in itertools.product((-1, 1), repeat=3):
            psi = np.array([[sf * half[1], 5 + sx * half[0] - se * half[0]], [0, 0]])
            M = P @ (A + psi - gain @ C)
            worst = max(worst, np.linalg.eigvalsh(M + M.T + alpha * P)[-1])
    assert worst < 0
    assert observer.certificate.check().valid


def test_a_higher_order_is_never_worse():
    plant = varying()
    mu = [small(polya=s).design(plant).performance["mu"] for s in (2, 4)]
    assert mu[1] <= mu[0] * (1 + 1e-3)


def test_a_gain_cap_holds_and_costs():
    plant = varying()
    free, capped = small().design(plant), small(gain_cap=4.0).design(plant)

    def largest(observer):
        return max(np.linalg.norm(observer.gains[name], 2) for name in ("L1", "L2"))

    assert largest(capped) <= 4.0 * (1 + 1e-6) < largest(free)
    assert capped.performance["mu"] > free.performance["mu"]


@pytest.mark.long
def test_another_solver_agrees():
    plant = varying()
    problem = small().problem(plant).to_cvxpy()
    problem.solve(solver="CLARABEL")
    assert problem.value == pytest.approx(small().design(plant).performance["mu"], rel=1e-3)


def test_actuator_faults_are_states_too():
    observer = small().design(varying(process=False))
    assert observer.certificate.valid and observer.model.names("f") == ("f",)
    assert observer.performance["mu"] > 0


def test_bounded_rates_of_faults_are_disturbances_of_the_bound():
    steady = small(alpha_q=0.5).design(varying())
    moving = small(alpha_q=0.5).design(varying(rate=0.02))
    widths = [one.performance["core_half_widths"][1] for one in (moving, steady)]
    assert widths[0] > widths[1]
    assert any("|df/dt| <= 0.02/s" in text for text in moving.guarantee.assumptions)
    assert any("f do not change" in text for text in steady.guarantee.assumptions)


def test_given_vertices_of_a_box_are_the_box():
    region = REGION.half_widths
    corners = np.array(list(itertools.product((-1, 1), repeat=2))) * region
    given = small(polytope=corners, kappa=2.0**-0.5).design(varying())
    known = small(kappa=2.0**-0.5).design(varying())
    assert given.performance["mu"] == pytest.approx(known.performance["mu"], rel=1e-4)
    assert given.certificate.check().valid


def test_shapes_hold_what_they_say():
    square = hull(np.array([[1.0, 1.0], [-1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]]))
    np.testing.assert_allclose(np.sort(np.abs(square.vertices), axis=None), 1.0, atol=1e-9)
    for shape in (square, box(np.ones(2)), cross(np.ones(2)), square.scaled(2.0)):
        heights = shape.normals.mid[:, 0, :] @ shape.vertices.T
        assert heights.max() == pytest.approx(1.0)
    assert square.onto([0]).vertices.ravel().tolist() == pytest.approx([-1.0, 1.0])


def test_without_disturbances_the_sets_shrink():
    made = ob.Plant("no noise")
    (x,) = made.states("x", range=(3, 7), nominal=5)
    (u,) = made.inputs("u", range=(0, 20), nominal=5)
    (f,) = made.process_faults("f", range=(-0.3, 0.3))
    made.dynamics([-x + f * x + u])
    made.outputs([x])
    observer = small(alpha=0.5, gain_cap=20.0).design(made)
    # what is left of the error set after 20 time constants of V
    left = observer.performance["core_half_widths"] / np.sqrt(
        np.diag(np.linalg.inv(observer.gains["P"]))
    )
    np.testing.assert_allclose(left, np.exp(-10.0), rtol=0.02)
    memory = observer.memory0([5.0], x_range=[(4.9, 5.1)], f_range=[(-0.01, 0.01)])
    truth, fault = np.array([5.08]), 0.008
    widths = []
    for _ in range(round(2.0 / observer.model.Ts)):
        found = [np.array(v).ravel() for v in observer.step(memory, [5.0], truth)]
        memory, _, _, low, high, f_low, f_high, _ = found
        assert low[0] <= truth[0] <= high[0] and f_low[0] <= fault <= f_high[0]
        widths.append(f_high[0] - f_low[0])
        # x' = (fault - 1) x + 5 in closed form
        rest = 5.0 / (1.0 - fault)
        truth = rest + (truth - rest) * np.exp((fault - 1.0) * observer.model.Ts)
    assert widths[-1] < 0.9 * widths[0]


def squared():
    made = ob.Plant("squared scheduling")
    (x,) = made.states("x", range=(4, 6), nominal=5)
    (u,) = made.inputs("u", range=(0, 20), nominal=5)
    (theta,) = made.scheduling("theta", range=(-1, 2))
    (f,) = made.process_faults("f", range=(-0.1, 0.1))
    made.sensor_faults("s", of="y2", range=(-0.5, 0.5))
    (w,) = made.disturbances("w", range=(0.1, 0.3))
    made.dynamics([-(1 + theta**2) * x + f * x + u + w])
    made.outputs([x + w, x + u / 10 + 2], names=["y1", "y2"])
    return made


def test_nonlinear_scheduling_sensor_faults_feedthrough_and_noise_off_centre():
    """theta^2 schedules; y2 has feedthrough, an offset and a fault; w is not centred at zero."""
    plant = squared()
    region = ob.Ellipsoid([0.25, 0.01, 0.2], [5.0, 0.0, 0.0])
    observer = ob.QPVObserver(
        region=region,
        E_x=[1.5],
        initial_error=[0.5, 0.1, 0.5],
        alpha_q=0.4,
        gain_cap=40.0,
    ).design(plant)
    assert observer.certificate.check().valid
    memory = observer.memory0([5.0])
    u, y = np.array([5.0]), np.array([5.2, 7.5])

    def rate(theta, shift=0.0):
        return np.array(observer.ode(memory, u, y + np.array([shift, 0.0]), [theta])).ravel()[:3]

    for theta in (-1.0, 0.5, 2.0):
        share = theta**2 / 4.0
        L = (1 - share) * observer.gains["L1"] + share * observer.gains["L2"]
        np.testing.assert_allclose(rate(theta, 1.0) - rate(theta), L[:, 0], atol=1e-12)
        # the innovation vanishes for the middle of w: what is left is the plant at w = .2
        np.testing.assert_allclose(rate(theta), [-(1 + theta**2) * 5 + 5 + 0.2, 0, 0], atol=1e-12)
    rng = np.random.default_rng(2)
    steps = round(8.0 / observer.model.Ts)
    Ts = observer.model.Ts
    scenario = ob.Scenario(
        "all at once",
        steps,
        x0=[5.2],
        guess=[5.0],
        inputs=lambda k: [5.0 * (1 + (0.5 + 1.5 * np.sin(k * Ts)) ** 2) - 0.2 + np.cos(5 * k * Ts)],
        scheduling=lambda k: [0.5 + 1.5 * np.sin(k * Ts)],
        faults=np.tile([0.05, -0.3], (steps + 1, 1)),
        disturbances=rng.uniform(0.1, 0.3, (steps + 1, 1)),
        x_range=[(4.8, 5.2)],
        f_range=[(-0.1, 0.1), (-0.5, 0.5)],
    )
    run = ob.simulate(observer.model, observer, scenario, engine="joint")
    assert min(run.coverage.values()) == 1.0
    late = np.abs(run.f - run.fhat)[-len(run.t) // 4 :].max(axis=0)
    assert (late < 0.5 * observer.half_widths[1:]).all()


def test_a_form_serves_as_well_as_a_plant():
    plant = varying()
    given = small().design(ob.qpv(plant, augment="all"))
    assert given.performance["mu"] == pytest.approx(small().design(plant).performance["mu"])
    with pytest.raises(ob.StructureError, match="all 1 faults"):
        small().design(ob.qpv(varying(process=False)))


@pytest.mark.long
def test_outputs_that_vary_off_the_diagonal():
    """Expressions round differently on either side of the diagonal, which is no asymmetry.

    Mutant: vertices that are looked at without taking the symmetric part.
    """
    from obsynth.designs.qpv.synthesis import rough_objective

    stored = ob.plants.qpv_example().to_dict()
    stored["outputs"][0]["expression"] += " + 0.1*theta1*x2"
    stored["outputs"][1]["expression"] += " + 0.3*theta2*x3"
    region = ob.Ellipsoid([0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [10, 10, 10, 0, 0, 0])
    method = ob.QPVObserver(region=region, eta=0.2, kappa=0.2, polya=2)
    setting = method.setting(method.read(ob.Plant.from_dict(stored)))
    assert 1e-3 < rough_objective(setting) < 1.0
