"""Plants that a paper does not have go to the observer of the general class by themselves."""

from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import motor, tank, two_tanks
from obsynth.designs.general.synthesis import _rescaled

R = sp.Rational


def row_of_tanks(n):
    plant = ob.Plant(f"{n} tanks in a row")
    h = plant.states(f"h1:{n + 1}", range=(2, 20), nominal=8)
    (v,) = plant.inputs("v", range=(0, 2), nominal=1)
    plant.actuator_faults("f", of=v, range=(-0.5, 0.5), rate=0.01)
    w = plant.disturbances(f"w1:{n + 1}", bound=0.05)
    q = [R(35, 100) * sp.sqrt(x) for x in h]
    plant.dynamics([(v if i == 0 else q[i - 1]) - q[i] for i in range(n)])
    plant.outputs([h[i] + w[i] for i in range(n)])
    return plant.discretise("euler", Ts=R(1, 2))


def test_a_plant_outside_the_papers_class_has_an_ellipsoid():
    """Mutant: its refusal is passed on."""
    observer = ob.BoundedErrorUIO().design(motor())
    assert observer.method == "general_uio"
    assert observer.record["options"]["bounds"] == "ellipsoid"
    with pytest.raises(ob.StructureError, match="b"):
        ob.BoundedErrorUIO(form="corrected").design(motor())
    with pytest.raises(ob.StructureError, match="b"):
        ob.BoundedErrorUIO(multipliers="per_component").design(motor())


def test_many_vertices_go_there_and_few_do_not():
    """Five square roots are 32 vertices. Mutant: a limit of 32."""
    observer = ob.BoundedErrorUIO().design(row_of_tanks(5))
    assert observer.method == "general_uio"
    half = np.array([*[9.0] * 5, 0.5])
    assert observer.performance["core_half_widths"][-1] / half[-1] < 0.13
    forced = ob.BoundedErrorUIO(form="general").design(two_tanks())
    assert forced.method == "general_uio" and forced.performance["gamma"] > 0.0


@pytest.mark.long
def test_an_error_that_hardly_counts_may_be_wide():
    """Four tanks, as narrow as at the vertices (7.90). Mutant: units of the peak bounds alone."""
    found = ob.BoundedErrorUIO(form="general").design(tank()).performance
    half = np.array([110, 110, 47.5, 47.5, 1, 1])
    assert (found["core_half_widths"] / half).sum() < 8.0


@pytest.mark.long
def test_sixteen_tanks():
    """65536 vertices, one block."""
    observer = ob.BoundedErrorUIO().design(row_of_tanks(16))
    assert observer.performance["core_half_widths"][-1] / 0.5 < 0.152


def test_a_plant_outside_the_papers_class_has_an_energy_gain():
    observer = ob.HinfUIO().design(motor())
    assert observer.method == "general_uio"
    assert observer.performance["attained_gain"] <= observer.performance["l2_gain"]
    with pytest.raises(ob.StructureError):
        ob.HinfUIO(form="corrected").design(motor())
    with pytest.raises(ob.StructureError):
        ob.HinfUIO(method="general").design(motor())


def test_what_neither_class_has_is_refused_as_before():
    plant = ob.Plant("noisy")
    x, z = plant.states("x z")
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("f", of=u)
    (n,) = plant.disturbances("n")
    plant.dynamics([x / 2 + z / 4 + u, z / 3], Ts=1)
    plant.outputs([x + n])
    with pytest.raises(ob.StructureError, match="n enters the output"):
        ob.HinfUIO().design(plant)
    with pytest.raises(ob.StructureError, match="disturbance n has no bound"):
        ob.BoundedErrorUIO().design(plant)


def test_a_matrix_that_is_barely_definite_gives_no_units(monkeypatch):
    """Mutant: units that are no numbers, and a problem without unknowns (ExpressionError)."""
    stated = SimpleNamespace(units=None)
    for matrix in (-np.eye(3), np.full((3, 3), np.nan)):
        assert _rescaled(None, stated, {"P": matrix}) is stated
    # an inverse that rounding has turned over
    monkeypatch.setattr(np.linalg, "inv", lambda matrix: -matrix)
    assert _rescaled(None, stated, {"P": np.eye(3)}) is stated
