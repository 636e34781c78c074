"""Which faults can be followed, in words and numbers."""

import pytest
import sympy as sp

import obsynth as ob
from obsynth.derive.structure.following import follow


def blind():
    """Two faults that act alike, and one that comes without a rate."""
    plant = ob.Plant("blind")
    (x,) = plant.states("x", range=(-5, 5))
    (z,) = plant.states("z", range=(-5, 5))
    g, f, jump = plant.faults(
        "g f jump", range=[(-0.1, 0.1), (-1, 1), (-1, 1)], rate=[0.01, 0.05, None]
    )
    (w,) = plant.disturbances("w", bound=0.05)
    plant.dynamics([x * sp.Rational(9, 10) + f + g, z / 2 + x * z / 9 + jump], Ts=1)
    plant.outputs([x + w, z])
    return plant


def test_of_two_faults_that_act_alike_the_smaller_is_not_followed():
    """Mutant: the larger one, which leaves wider bounds."""
    found = follow(blind())
    assert found.extended.followed == ("f",)
    assert set(found.reasons) == {"g", "jump"}
    assert "do not tell it from f" in found.reasons["g"]
    text = str(ob.analyse(blind()))
    assert "f followed as a state" in text and "jump not followed: it has no rate" in text


def test_a_state_that_nothing_shows_is_refused_and_reported():
    plant = ob.Plant("hidden")
    x, z = plant.states("x z", range=(-5, 5))
    plant.dynamics([x / 2 + x**2 / 99, z * sp.Rational(11, 10)], Ts=1)
    plant.outputs([x])
    with pytest.raises(ob.StructureError, match=r"a mode 1\.1 of z does not decay"):
        follow(plant)
    report = ob.analyse(plant)
    assert not report.passed and "mode 1.1 of z" in report["general class"].text


def test_a_plant_of_the_general_class_alone_passes_without_a_split():
    report = ob.analyse(ob.plants.cruise_control().discretise("euler", Ts=sp.Rational(1, 10)))
    assert report.passed
    assert report["general class"].passed is True and report["split"].passed is None
