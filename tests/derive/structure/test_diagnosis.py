"""Zeros, isolability, excitation, detectability inside a family: known answers and mutants."""

import numpy as np
import pytest
import scipy.linalg
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st

from obsynth.derive import StructureError, analyse, jacobian_bounds, split
from obsynth.derive.structure import isolability
from obsynth.derive.structure import zeros as zeros_module
from obsynth.derive.structure.conditions import pair_margin, unknown_input_condition, weakest_member
from obsynth.derive.structure.excitation import excitation
from obsynth.derive.structure.frozen import balls, precision, rank
from obsynth.derive.structure.isolability import fault_isolability
from obsynth.derive.structure.zeros import system_zeros, zeros_over_polytope
from obsynth.symbolic import Plant, plants

# -- zeros -----------------------------------------------------------------------------------------


def drops_rank(A, B, C, D, z):
    """Whether the Rosenbrock pencil has a smaller rank at z than almost everywhere."""

    def rank_at(value):
        pencil = np.block([[A - value * np.eye(len(A)), B], [C, D]])
        return np.linalg.matrix_rank(pencil, tol=1e-7 * np.linalg.norm(pencil, 2))

    return rank_at(z) < max(rank_at(0.3 + 0.7j), rank_at(-1.1 + 0.2j))


def test_zero_of_a_parallel_connection_by_hand():
    """1/(s+1) + 1/(s+2) = (2 s + 3)/((s+1)(s+2))."""
    A, B, C = np.diag([-1.0, -2.0]), np.ones((2, 1)), np.ones((1, 2))
    np.testing.assert_allclose(system_zeros(A, B, C, np.zeros((1, 1))), [-1.5])


def test_feedthrough_inverts():
    A, B, C, D = (np.array([[v]]) for v in (0.5, 1.0, 2.0, 4.0))
    np.testing.assert_allclose(system_zeros(A, B, C, D), [0.5 - 1.0 * 2.0 / 4.0])


def test_chain_of_integrators_has_no_zero():
    A = np.diag(np.ones(3), 1)
    B, C = np.eye(4)[:, 3:], np.eye(4)[:1]
    assert len(system_zeros(A, B, C, np.zeros((1, 1)))) == 0


def test_hidden_mode_is_a_zero():
    A, B, C = np.diag([0.9, 0.5]), np.array([[0.0], [1.0]]), np.array([[0.0, 1.0]])
    np.testing.assert_allclose(system_zeros(A, B, C, np.zeros((1, 1))), [0.9])
    np.testing.assert_allclose(system_zeros(A, np.zeros((2, 0)), C, np.zeros((1, 0))), [0.9])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    n=st.integers(1, 5),
    k=st.integers(0, 3),
    m=st.integers(1, 3),
    seed=st.integers(0, 10_000),
    sparse=st.booleans(),
)
def test_every_zero_lowers_the_rank(n, k, m, seed, sparse):
    rng = np.random.default_rng(seed)
    A, B = rng.normal(size=(n, n)), rng.normal(size=(n, k))
    C, D = rng.normal(size=(m, n)), rng.normal(size=(m, k))
    if sparse:
        A, B, C, D = (
            np.where(rng.random(M.shape) < 0.5, 0.0, np.round(2 * M)) for M in (A, B, C, D)
        )
    zeros = system_zeros(A, B, C, D)
    simple = [
        z for i, z in enumerate(zeros) if np.abs(np.delete(zeros, i) - z).min(initial=1) > 1e-3
    ]
    for z in simple:
        assert drops_rank(A, B, C, D, z), z


@settings(max_examples=60, deadline=None, derandomize=True)
@given(n=st.integers(1, 6), k=st.integers(1, 3), seed=st.integers(0, 10_000))
def test_square_systems_agree_with_the_generalised_eigenvalue_problem(n, k, seed):
    rng = np.random.default_rng(seed)
    A, B, C = (rng.normal(size=s) for s in ((n, n), (n, k), (k, n)))
    D = np.zeros((k, k)) if seed % 2 else rng.normal(size=(k, k))
    pencil = np.block([[A, B], [C, D]])
    unit = np.zeros_like(pencil)
    unit[:n, :n] = np.eye(n)
    known = scipy.linalg.eigvals(pencil, unit)
    known = known[np.isfinite(known) & (np.abs(known) < 1e6)]
    found = system_zeros(A, B, C, D)
    assert len(found) == (n if seed % 2 == 0 else max(n - k, 0))
    for z in found:
        assert np.abs(known - z).min() <= 1e-6 * max(1.0, abs(z))


def test_more_outputs_than_inputs_have_only_common_zeros():
    """(z - .5) stands in both entries of the transfer matrix, (z - .2) in one."""
    A = np.array([[0.0, 1.0], [-0.1, 0.7]])
    B = np.array([[0.0], [1.0]])
    both = np.array([[-0.5, 1.0], [-1.0, 2.0]])
    np.testing.assert_allclose(system_zeros(A, B, both, np.zeros((2, 1))), [0.5])
    one = np.array([[-0.5, 1.0], [-0.2, 1.0]])
    assert len(system_zeros(A, B, one, np.zeros((2, 1)))) == 0


def chain_with_zeros(zeros):
    """f drives a chain of integrators; y has the zeros, and x_last+ = x_last / 2 + y."""
    numerator = np.poly(zeros)[::-1].tolist()
    count = len(numerator)
    plant = Plant("chain")
    x = plant.states(f"x1:{count + 2}", range=(-1, 1))
    (f,) = plant.process_faults("f")
    y = sum(value * symbol for value, symbol in zip(numerator, x[:-1], strict=True))
    plant.dynamics([*x[1:-1], f, x[-1] / 2 + y], Ts=1)
    plant.outputs([y, x[-1]])
    return plant


def triple_zero():
    plant = Plant("triple zero")
    x1, x2, x3, x4, x5 = plant.states("x1:6", range=(-1, 1))
    (f,) = plant.process_faults("f")
    y = x4 - 3.6 * x3 + 4.32 * x2 - 1.728 * x1
    plant.dynamics([x2, x3, x4, f, x5 / 2 + y], Ts=1)
    plant.outputs([y, x5])
    return plant


def test_analyse_agrees_with_itself_on_a_triple_zero():
    report = analyse(triple_zero())
    assert report["invariant zeros"].text == "1.2 (3 times)"
    assert report["zeros with faults"].text.startswith(
        "from f to the outputs: slowest 1.2 (3 times) at vertex 1 of 1 (does not decay)"
    )
    assert str(report).count("1.2 (3 times)") == 2


def gathered(zeros, c, multiplicity):
    """Assert that c is there with its multiplicity, to the last bits one number."""
    near = zeros[np.abs(zeros - c) < 1e-3]
    assert len(near) == multiplicity
    assert len(set(near.tolist())) == 1
    assert abs(near[0] - c) < 1e-9


@pytest.mark.parametrize("multiplicity", [1, 2, 3, 4])
@pytest.mark.parametrize("c", [1.2, 0.9, -0.5, 1.0, 0.0])
def test_a_multiple_zero_is_one_number_in_both_lines(c, multiplicity):
    report = analyse(chain_with_zeros([c] * multiplicity + [0.3]))
    parts, bounds = report.split, report.bounds
    gathered(zeros_module.invariant_zeros(parts, bounds.family.midpoint), c, multiplicity)
    found = zeros_over_polytope(parts, bounds, "all")
    gathered(found.zeros[0], c, multiplicity)
    times = f" ({multiplicity} times)" if multiplicity > 1 else ""
    if abs(c) > 0.3:
        assert found.multiplicity == multiplicity
        assert report["invariant zeros"].text.startswith(f"{c:.6g}{times}, 0.3")
        assert f"slowest {c:.6g}{times} at" in report["zeros with faults"].text


@pytest.mark.parametrize("multiplicity", [2, 3, 4])
def test_hidden_modes_with_and_without_jordan_blocks(multiplicity):
    """Multiple hidden modes, in any coordinates: defective, semisimple, and both at once."""
    rng = np.random.default_rng(multiplicity)
    k, n = multiplicity, multiplicity + 2
    for ones in (np.ones(k - 1), np.zeros(k - 1), np.arange(k - 1) % 2):
        hidden = 1.2 * np.eye(k) + np.diag(ones, 1)
        A = scipy.linalg.block_diag(hidden, [[0.5, 0.1], [-0.1, 0.5]])
        B, C = np.eye(n)[:, [-1]], np.eye(n)[[-1]]
        for turn in (np.eye(n), np.linalg.qr(rng.normal(size=(n, n)))[0]):
            A_t, B_t, C_t = turn @ A @ turn.T, turn @ B, C @ turn.T
            zeros = system_zeros(A_t, B_t, C_t, np.zeros((1, 1)))
            assert len(zeros) == k + 1
            gathered(zeros, 1.2, k)


def test_pairs_of_complex_zeros_are_gathered_apart():
    turn = np.array([[0.9, 0.3], [-0.3, 0.9]])
    A = np.block([[turn, np.eye(2)], [np.zeros((2, 2)), turn]])
    zeros = system_zeros(A, np.zeros((4, 0)), np.zeros((1, 4)), np.zeros((1, 0)))
    for c in (0.9 + 0.3j, 0.9 - 0.3j):
        gathered(zeros, c, 2)


@pytest.mark.parametrize("gap", [1e-3, 1e-4, 1e-5])
def test_zeros_that_are_only_near_each_other_stay_apart(gap):
    """A slow pair of modes is no double one, however small beside the other entries."""
    parts = analyse(chain_with_zeros([0.9, 0.9 + gap])).split
    found = np.sort(zeros_module.invariant_zeros(parts, np.zeros((4, 4))).real)
    np.testing.assert_allclose(found, [0.9, 0.9 + gap], rtol=0, atol=gap / 100)
    A = np.diag([-1e-8, -3e-8, -1.0])
    slow = system_zeros(A, np.zeros((3, 0)), np.zeros((1, 3)), np.zeros((1, 0)))
    np.testing.assert_allclose(np.sort(slow.real), [-1.0, -3e-8, -1e-8], rtol=1e-9)


def test_zeros_that_are_not_gathered_fail(monkeypatch):
    """What numerical eigenvalues give: a triple zero as three numbers on a circle."""
    monkeypatch.setattr(zeros_module, "_coincide", lambda offsets: len(offsets) == 1)
    assert "times" not in str(analyse(triple_zero()))


def test_zeros_that_forget_multiplicity_fail(monkeypatch):
    """What the selection of common zeros did: three zeros within rounding count as one or none."""
    whole = zeros_module.system_zeros
    monkeypatch.setattr(zeros_module, "system_zeros", lambda *args: np.unique(whole(*args)))
    assert "1.2 (3 times)" not in str(analyse(triple_zero()))


def test_tank_zeros_agree_with_the_generalised_eigenvalue_problem(parts, bounds):
    found = zeros_over_polytope(parts, bounds, "all")
    inputs = np.hstack([parts.D, parts.B_f])
    unit = np.diag([1.0] * 4 + [0.0] * 3)
    for M, zeros in zip(bounds.vertices(), found.zeros, strict=True):
        direct = np.hstack([np.zeros((3, 1)), parts.D_f])
        known = scipy.linalg.eigvals(np.block([[parts.A + M, inputs], [parts.C, direct]]), unit)
        known = known[np.isfinite(known) & (np.abs(known) < 1e6)]
        np.testing.assert_allclose(zeros, known, rtol=1e-9)
    assert found.decays
    assert found.signals == ("d", "f1", "f2")
    # the level of the only tank that is not measured: 1 - a4 sqrt(2 g) / (2 A4 sqrt(h4)) at 100 cm
    worst = 1 - 0.051 * np.sqrt(2 * 981) / (2 * 32 * np.sqrt(100.0))
    assert found.worst.real == pytest.approx(worst, rel=1e-9)


def test_decoupled_inflow_has_no_zero_in_the_way(parts, bounds):
    """Strong detectability: zeros from d to y are what decoupling leaves hidden."""
    found = zeros_over_polytope(parts, bounds)
    assert found.worst is None
    assert found.decays
    T = unknown_input_condition(parts).T
    for M in bounds.vertices():
        assert pair_margin(T @ (parts.A + M), parts.C, True)[0] > 1e-3


def hidden_plant(mode):
    """d is seen through the difference of two states; z = mode is a zero from d to y."""
    plant = Plant("hidden")
    x = plant.states("x1:3", range=(-1, 1))
    (d,) = plant.unknown_inputs("d")
    R = sp.Rational
    plant.dynamics([R(1, 2) * x[0] + d, R(mode) * x[1] + d], Ts=1)
    plant.outputs([x[0] - 2 * x[1] / 3])
    parts = split(plant)
    return parts, jacobian_bounds(parts)


def test_zero_outside_the_circle_is_told():
    """1/(z - 1/2) - (2/3)/(z - m): zero at 3 m - 1."""
    for mode, zero, decays in (("3/5", 0.8, True), ("4/5", 1.4, False)):
        found = zeros_over_polytope(*hidden_plant(mode))
        assert found.worst.real == pytest.approx(zero)
        assert found.decays is decays
        assert ("does not decay" in str(found)) is not decays


# -- isolability -----------------------------------------------------------------------------------


def test_three_tanks_of_the_fault_diagnosis_toolbox():
    found = fault_isolability(plants.three_tanks_fdt())
    assert found.detectable.all()
    assert set(found.unique) == {"fV1", "fT1", "fT2"}
    assert ("fV2", "fV3", "fT3") in found.groups
    assert len(found.groups) == 4


def test_water_tanks_of_the_fault_diagnosis_toolbox():
    """The toolbox's own test: the isolability matrix is the identity."""
    found = fault_isolability(plants.water_tanks())
    assert len(found.faults) == 6
    np.testing.assert_array_equal(~found.isolable, np.eye(6, dtype=bool))


def varga():
    """Gu = [(s+1)/(s+2); (s+2)/(s+3)], Gd = [1/(s+2); 0], Gf = diag((s+1)/(s+2), 1)."""
    plant = Plant("Varga, example 5.2")
    x = plant.states("x1:3", range=(-1, 1))
    (u,) = plant.inputs("u", range=(-1, 1))
    (d,) = plant.unknown_inputs("d")
    f1, f2 = plant.faults("f1:3")
    plant.dynamics([-2 * x[0] - u + d - f1, -3 * x[1] - u])
    plant.outputs([x[0] + u + f1, x[1] + u + f2])
    return plant


def test_varga_example_without_a_solution_is_refused():
    found = fault_isolability(varga())
    assert found.detectable.tolist() == [False, True]
    found.require(detect=["f2"])
    with pytest.raises(StructureError, match="the fault f1 cannot be detected") as caught:
        found.require(detect=["f1", "f2"])
    assert caught.value.symbols == ("f1",)
    assert "does not respond to d" in str(caught.value)


def test_varga_example_is_realised_as_printed():
    """The plant in the test is the transfer matrix of the book, at a number."""
    plant = varga()
    s = sp.Rational(7, 3)
    state, u, d, f = (sp.Matrix([v.symbol for v in getattr(plant, k)]) for k in "xudf")
    A = plant.rhs.jacobian(state)
    solve = plant.output.jacobian(state) * (s * sp.eye(2) - A).inv()
    G = {
        name: solve * plant.rhs.jacobian(v) + plant.output.jacobian(v)
        for name, v in (("u", u), ("d", d), ("f", f))
    }
    assert G["u"] == sp.Matrix([(s + 1) / (s + 2), (s + 2) / (s + 3)])
    assert G["d"] == sp.Matrix([1 / (s + 2), 0])
    assert G["f"] == sp.diag((s + 1) / (s + 2), 1)


def test_pair_that_cannot_be_told_apart_is_refused():
    found = fault_isolability(plants.three_tanks_fdt())
    found.require(detect=found.faults, isolate=["fV1", "fT1"])
    with pytest.raises(StructureError, match="cannot be told from") as caught:
        found.require(isolate=["fV1", "fV3"])
    assert set(caught.value.symbols) == {"fV2", "fV3", "fT3"}
    with pytest.raises(StructureError, match="no fault of the plant"):
        found.require(detect=["fX"])


def test_tank_without_the_second_level_hides_nothing_from_single_fault_isolation(tanks):
    """f2 reaches tank 3, which is measured; only together with f1, d is the rank short."""
    found = fault_isolability(tanks(measured=(0, 1)))
    assert found.at_once == 1
    assert fault_isolability(tanks()).at_once == 2


def test_fault_in_the_direction_of_the_unknown_input_is_hidden():
    plant = Plant("parallel")
    x = plant.states("x1:3", range=(-1, 1))
    (d,) = plant.unknown_inputs("d")
    f, g = plant.faults("f g")
    plant.dynamics([-x[0] + d + 2 * f, x[0] - x[1] + g])
    plant.outputs([x[0], x[1]])
    found = fault_isolability(plant)
    assert found.detectable.tolist() == [False, True]
    assert found.groups == (("g",),)
    assert "f hidden behind d" in str(found)


def test_dependence_that_only_exact_numbers_show():
    """Two columns that are parallel up to the rounding of doubles only."""
    plant = Plant("thirds")
    x = plant.states("x1:3", range=(-1, 1))
    f, g = plant.faults("f g")
    third, seventh = sp.Rational(1, 3), sp.Rational(1, 7)
    plant.dynamics([-x[0] + third * f + third * seventh * g, -x[1] + seventh * f + seventh**2 * g])
    plant.outputs([x[0], x[1]])
    assert fault_isolability(plant).groups == (("f", "g"),)
    numbers = [[float(third), float(third * seventh)], [float(seventh), float(seventh**2)]]
    with precision():
        exact = balls(sp.Matrix([[third, third * seventh], [seventh, seventh**2]]))
        assert rank([[exact[0, 0], exact[0, 1]], [exact[1, 0], exact[1, 1]]]) == 1
        assert rank(numbers) == 2


def test_multiplicative_faults_and_sensor_faults_count():
    plant = Plant("mixed")
    (x,) = plant.states("x", range=(1, 2))
    (u,) = plant.inputs("u", range=(1, 2))
    (f,) = plant.faults("f")
    plant.dynamics([-x + (1 - f) * u])
    plant.outputs([x])
    plant.sensor_faults("s", of="y1", rate=1)
    found = fault_isolability(plant)
    assert found.detectable.all()
    assert found.groups == (("f", "s"),)
    two = Plant("mixed, two outputs")
    (x,) = two.states("x", range=(1, 2))
    (u,) = two.inputs("u", range=(1, 2))
    (f,) = two.faults("f")
    two.dynamics([-x + (1 - f) * u])
    two.outputs([x, x**2])
    two.sensor_faults("s", of="y1", rate=1)
    assert len(fault_isolability(two).unique) == 2


def test_ranks_that_forget_the_unknown_inputs_fail(monkeypatch):
    whole = isolability.transfer

    def forgetful(frozen, at):
        q = frozen.D.cols
        return [[0 if k < q else v for k, v in enumerate(row)] for row in whole(frozen, at)]

    monkeypatch.setattr(isolability, "transfer", forgetful)
    assert fault_isolability(varga()).detectable.all()


def test_discretised_plant_says_what_the_continuous_one_says():
    plant = plants.water_tanks()
    for method in ("euler", "rk4"):
        found = fault_isolability(plant.discretise(method, Ts=1.0))
        assert len(found.unique) == 6


def test_plant_without_faults():
    found = fault_isolability(plants.lorenz())
    assert found.faults == ()
    assert str(found) == "no faults"


# -- excitation ------------------------------------------------------------------------------------


def test_additive_faults_show_at_rest():
    found = excitation(plants.quadruple_tank())
    assert (found.visible_at_rest, found.points) == (2, 1)
    assert all(not effect.depends_on for effect in found.effects)


def test_more_faults_than_outputs_need_movement():
    found = excitation(plants.water_tanks())
    assert (found.visible_at_rest, found.points) == (4, 2)
    assert "persistent excitation of order 2" in found.condition
    clogging = next(e for e in found.effects if e.fault == "fc1")
    assert clogging.depends_on == ("h1",)
    assert clogging.always


def test_linear_plant_cannot_be_excited_out_of_it():
    found = excitation(plants.three_tanks_fdt())
    assert found.points is None
    assert found.points is None
    assert found.visible_at_rest == 2


def test_effect_that_fades_inside_the_box_is_told():
    plant = Plant("gain")
    (x,) = plant.states("x", range=(-1, 1))
    (u,) = plant.inputs("u", range=(-1, 2))
    (f,) = plant.faults("f")
    plant.dynamics([-x + (1 - f) * u])
    plant.outputs([x])
    (effect,) = excitation(plant).effects
    assert not effect.always
    assert effect.at["u"] == pytest.approx(0.0, abs=1e-2)
    assert "fades at u" in str(effect)
    away = Plant("gain, away from zero")
    (x,) = away.states("x", range=(-1, 1))
    (u,) = away.inputs("u", range=(1, 2))
    (f,) = away.faults("f")
    away.dynamics([-x + (1 - f) * u])
    away.outputs([x])
    (effect,) = excitation(away).effects
    assert effect.floor == pytest.approx(1.0, rel=1e-3)
    assert effect.floor <= 1.0


def test_gain_and_offset_need_two_points():
    """y = g u + o: a gain fault and an offset show as one number per input value."""
    plant = Plant("gain and offset")
    (x,) = plant.states("x", range=(-1, 1))
    (u,) = plant.inputs("u", range=(1, 2))
    f, o = plant.faults("f o")
    plant.dynamics([-x + (1 - f) * u + o])
    plant.outputs([x])
    found = excitation(plant)
    assert (found.visible_at_rest, found.points) == (1, 2)


def test_fault_without_any_effect_is_told():
    plant = Plant("idle")
    (x,) = plant.states("x", range=(-1, 1))
    plant.faults("f")
    plant.dynamics([-x])
    plant.outputs([x])
    found = excitation(plant)
    assert "no effect" in str(found.effects[0])
    assert found.points is None


# -- inside the family -----------------------------------------------------------------------------


def seen_through(low, high):
    """x2 reaches the output through x1 with the slope 2 x1 in [2 low, 2 high] only."""
    plant = Plant("window")
    x = plant.states("x1:3", range=[(low, high), (-1, 1)])
    R = sp.Rational
    plant.dynamics([x[0] / 2 + x[1] * x[0] / 4, R(11, 10) * x[1] - x[1] ** 3 / 100], Ts=1)
    plant.outputs([x[0]])
    parts = split(plant, at=(np.array([0.5 * (low + high), 0.0]), np.zeros(0)), linear="terms")
    return parts, jacobian_bounds(parts)


def test_hidden_member_between_good_vertices_is_found():
    parts, bounds = seen_through(-1.0, 1.0)
    decoupling_free = [pair_margin(parts.A + M, parts.C, True)[0] for M in bounds.vertices()]
    assert min(decoupling_free) > 1e-3
    with pytest.raises(StructureError, match="inside the Jacobian family") as caught:
        weakest_member(parts, bounds)
    assert abs(caught.value.mode) > 1.0
    assert pair_margin(parts.A + caught.value.matrix, parts.C, True)[0] <= 1e-9


def test_family_that_avoids_the_point_is_fine():
    found = weakest_member(*seen_through(0.5, 1.0))
    assert found.margin > 1e-3
    assert "a search and no proof" in str(found)


def test_weakest_member_is_no_better_than_random_ones(parts, bounds):
    found = weakest_member(parts, bounds)
    T = unknown_input_condition(parts)
    rng = np.random.default_rng(5)
    low, high = bounds.family.ranges.T
    n_f = parts.B_f.shape[1]
    for _ in range(50):
        M = bounds.family.at(low + rng.random(len(low)) * (high - low))
        A = np.block([[T.T @ (parts.A + M), T.T @ parts.B_f], [np.zeros((n_f, 4)), np.eye(n_f)]])
        C = np.hstack([parts.C, np.zeros((3, n_f))])
        assert pair_margin(A, C, True)[0] >= found.margin - 1e-6


# -- report ----------------------------------------------------------------------------------------


def test_report_tells_faults_zeros_and_excitation(model):
    report = analyse(model)
    assert report.passed
    assert "f1, f2 can be told" in report["single faults"].text
    assert "nothing has to move" in report["excitation"].text
    assert "none from d" in report["zeros of unknown inputs"].text
    assert "all decay" in report["zeros with faults"].text
    assert report["weakest member"].passed is None


def test_report_speaks_of_faults_without_a_split():
    """Multiplicative faults have no split, but what can be told apart is still known."""
    report = analyse(plants.water_tanks())
    assert report["split"].passed is False
    assert report["single faults"].passed
    assert "order 2" in report["excitation"].text


def test_report_fails_on_a_hidden_fault():
    report = analyse(varga())
    assert report["single faults"].passed is False
    assert "f1 hidden behind d" in str(report)
    assert "f1 hidden" in report._repr_html_()


def test_report_fails_on_a_hidden_member():
    parts, _ = seen_through(-1.0, 1.0)
    report = analyse(parts)
    assert report["detectability"].passed
    assert report["weakest member"].passed is False


def test_results_can_be_read_in_a_notebook(parts, bounds):
    assert "<table>" in fault_isolability(plants.water_tanks())._repr_html_()
    assert "<li>" in excitation(plants.water_tanks())._repr_html_()
    assert "vertex" in zeros_over_polytope(parts, bounds, "all")._repr_html_()
