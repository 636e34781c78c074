"""Structural conditions on plants with known answers."""

import numpy as np
import pytest
import sympy as sp

from obsynth.derive import StructureError, analyse, jacobian_bounds, split
from obsynth.derive.structure.conditions import (
    augmented_pair,
    detectability,
    unknown_input_condition,
)
from obsynth.derive.structure.zeros import invariant_zeros, separable_faults
from obsynth.symbolic import Plant
from obsynth.symbolic.plants import quadruple_tank


def linear_plant(A, D=None, F=None, C=None, Ts=1.0, sensor=()):
    """x+ = A x + D d + F f, y = C x: for tests with answers by hand."""
    n = len(A)
    plant = Plant("linear")
    x = sp.Matrix(plant.states(f"x1:{n + 1}", range=(-1, 1)))
    plant.inputs("u", nominal=0)
    rows = sp.Matrix(A) * x
    if D is not None:
        rows += sp.Matrix(D) * sp.Matrix(plant.unknown_inputs(f"d1:{np.shape(D)[1] + 1}"))
    if F is not None:
        rows += sp.Matrix(F) * sp.Matrix(plant.process_faults(f"f1:{np.shape(F)[1] + 1}", rate=1))
    plant.dynamics(list(rows), Ts=Ts)
    names = plant.outputs(list(sp.Matrix(C if C is not None else sp.eye(n)) * x))
    if sensor:
        plant.sensor_faults([f"s{k + 1}" for k in sensor], of=[names[k] for k in sensor], rate=1)
    return split(plant)


def condition_error(parts):
    with pytest.raises(StructureError) as caught:
        unknown_input_condition(parts)
    return caught.value


# -- unknown inputs --------------------------------------------------------------------------------


def test_two_unknown_inputs_with_two_outputs():
    parts = linear_plant(np.eye(3) / 2, D=[[1, 0], [1, 1], [0, 0]], C=[[1, 0, 0], [0, 1, 0]])
    found = unknown_input_condition(parts)
    np.testing.assert_allclose(found.T @ parts.D, 0.0, atol=1e-15)
    np.testing.assert_allclose(found.T, np.diag([0.0, 0.0, 1.0]), atol=1e-15)
    assert found.rank == 2


def test_parallel_unknown_inputs_cannot_be_told_apart():
    error = condition_error(linear_plant(np.eye(2) / 2, D=[[1, 2], [1, 2]]))
    assert (error.rank_D, error.q) == (1, 2)
    assert error.symbols == ("d1", "d2")


def test_unknown_input_that_enters_nothing_is_named():
    error = condition_error(linear_plant(np.eye(2) / 2, D=[[1, 0], [1, 0]]))
    assert error.symbols == ("d2",)


def test_more_unknown_inputs_than_outputs():
    error = condition_error(linear_plant(np.eye(2) / 2, D=np.eye(2), C=[[1, 0]]))
    assert "at least 2 outputs" in str(error)
    assert error.states == ("x2",)


def test_badly_scaled_columns_keep_their_rank():
    parts = linear_plant(np.eye(2) / 2, D=[[1e-9, 0], [0, 1e6]])
    assert unknown_input_condition(parts).rank == 2


def test_without_unknown_inputs_nothing_is_removed():
    found = unknown_input_condition(linear_plant(np.eye(2) / 2))
    np.testing.assert_array_equal(found.T, np.eye(2))
    assert not found.E.any()


# -- detectability ---------------------------------------------------------------------------------


def detect(parts):
    return detectability(parts, jacobian_bounds(parts))


@pytest.mark.parametrize(
    ("mode", "Ts", "visible"),
    [
        (1.1, 1.0, False),
        (1.0, 1.0, False),
        (0.9, 1.0, True),
        (0.1, None, False),
        (-0.1, None, True),
    ],
)
def test_a_hidden_mode_must_decay(mode, Ts, visible):
    parts = linear_plant([[0.5 if Ts else -0.5, 0], [0, mode]], C=[[1, 0]], Ts=Ts)
    if visible:
        assert detect(parts).hidden_modes == (complex(mode),)
        return
    with pytest.raises(StructureError, match="the state x2 cannot be detected") as caught:
        detect(parts)
    assert caught.value.mode.real == pytest.approx(mode)


def test_rotating_mode_is_found():
    c, s = np.cos(0.3), np.sin(0.3)
    A = np.block([[np.array([[c, -s], [s, c]]), np.zeros((2, 1))], [np.zeros((1, 2)), 0.5]])
    with pytest.raises(StructureError) as caught:
        detect(linear_plant(A, C=[[0, 0, 1]]))
    assert set(caught.value.symbols) == {"x1", "x2"}
    assert abs(caught.value.mode) == pytest.approx(1.0)


def test_fault_hidden_by_a_differentiator():
    """With a zero at 1 a constant fault leaves no trace once the state has settled."""
    A, F = [[0.5, 0.0], [0.0, 0.5]], [[1.0], [1.0]]
    with pytest.raises(StructureError, match="the fault f1 cannot be detected"):
        detect(linear_plant(A, F=F, C=[[1, -1]]))
    assert detect(linear_plant(A, F=F, C=[[1, 0]])).margin > 0.1


def test_fault_behind_the_decoupling_is_lost():
    """A fault in the direction of the unknown input goes with it."""
    parts = linear_plant(np.eye(2) / 2, D=[[1], [0]], F=[[2], [0]])
    with pytest.raises(StructureError) as caught:
        detect(parts)
    assert caught.value.symbols == ("f1",)


def test_sensor_fault_needs_a_second_path():
    A = [[0.5, 0.1], [0.0, 0.4]]
    with pytest.raises(StructureError, match="s1"):
        # an integrator seen through a biased sensor only: the bias cannot be told from the state
        detect(linear_plant([[1.0]], C=[[1]], sensor=(0,)))
    assert detect(linear_plant(A, sensor=(0,))).margin > 0.1


def test_augmented_pair_of_the_paper(parts, bounds):
    """Equations (16)-(17): the error of a noise-free observer moves with this pair."""
    decoupling = unknown_input_condition(parts)
    matrix, outputs = augmented_pair(parts, decoupling, bounds.family.midpoint)
    T = decoupling.T
    np.testing.assert_array_equal(matrix[:4, :4], T @ (parts.A + bounds.family.midpoint))
    np.testing.assert_array_equal(matrix[:4, 4:], T @ parts.B)
    np.testing.assert_array_equal(matrix[4:], np.hstack([np.zeros((2, 4)), np.eye(2)]))
    np.testing.assert_array_equal(outputs, np.hstack([parts.C, np.zeros((3, 2))]))


def test_continuous_tanks_are_detectable_too():
    parts = split(quadruple_tank())
    assert detectability(parts, jacobian_bounds(parts)).vertices == 16


# -- faults ----------------------------------------------------------------------------------------


def test_parallel_faults_cannot_be_told_apart():
    parts = linear_plant(np.diag([0.5, 0.4]), F=[[1, 2, 0], [0, 0, 1]])
    apart, rank, signals = separable_faults(parts, np.zeros((2, 2)))
    assert apart == ("f3",)
    assert (rank, signals) == (2, 3)


def test_zeros_by_hand():
    A, F, C = [[0.5, 0.0], [0.0, 0.2]], [[1.0], [-2.0]], [[1.0, 1.0]]
    parts = linear_plant(A, F=F, C=C)
    # 1/(z - .5) - 2/(z - .2) = 0 at z = .8
    np.testing.assert_allclose(invariant_zeros(parts, np.zeros((2, 2))), [0.8], atol=1e-12)


def test_more_outputs_than_signals_have_no_zeros():
    parts = linear_plant([[0.5, 0.0], [0.0, 0.2]], F=[[1.0], [-2.0]])
    assert len(invariant_zeros(parts, np.zeros((2, 2)))) == 0


def test_a_common_zero_survives_more_outputs():
    # x3 is driven by the fault's filter only: both outputs carry the zero at .7
    A = [[0.5, 1.0, 0.0], [0.0, 0.2, 0.0], [0.0, 1.0, 0.1]]
    F = [[0.0], [1.0], [0.0]]
    parts = linear_plant(A, F=F, C=[[1, 0, 0], [0, 0, 1]])
    assert len(invariant_zeros(parts, np.zeros((3, 3)))) == 0
    shared = linear_plant([[0.5, 0.0], [-0.2, 0.5]], F=[[1.0], [1.0]], C=[[0, 1], [0, 2]])
    np.testing.assert_allclose(invariant_zeros(shared, np.zeros((2, 2))), [0.7], atol=1e-9)


# -- the report ------------------------------------------------------------------------------------


def test_report_of_an_incomplete_plant():
    report = analyse(Plant("empty"))
    assert not report.passed
    assert report["plant"].passed is False
    with pytest.raises(KeyError):
        report["zeros"]


def test_report_of_a_split_that_is_refused():
    plant = Plant("p")
    (x,) = plant.states("x", range=(0, 1))
    (d,) = plant.unknown_inputs("d")
    plant.inputs("u", nominal=0)
    plant.dynamics([-x + d**2])
    plant.outputs([x])
    report = analyse(plant)
    assert report["split"].passed is False
    assert "d" in report["split"].text
    assert report.bounds is None


def test_report_accepts_a_split(parts):
    report = analyse(parts)
    assert report.passed
    assert report.split is parts
    assert "0.99" in report["invariant zeros"].text
