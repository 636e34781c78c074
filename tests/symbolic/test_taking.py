"""Front doors refuse what they do not take, and tuples of symbols are no expressions."""

import operator

import pytest
import sympy as sp

import obsynth as ob
from obsynth.symbolic.taking import takes


@pytest.mark.parametrize(
    "mistake",
    [
        operator.neg,
        lambda h: 2 * h,
        lambda h: h * 2,
        lambda h: 1 - h,
        lambda h: h - 1,
        lambda h: 1 + h,
        lambda h: h + 1,
        lambda h: h / 2,
        lambda h: 2 / h,
        lambda h: h**2,
        lambda h: sp.Symbol("v") - h,
        lambda h: sp.Symbol("v") * h,
    ],
)
def test_a_forgotten_unpacking_is_told(mistake):
    h = ob.Plant("tank").states("h", range=(1, 2))
    with pytest.raises(ob.ObsynthError, match=r"take it apart where it is declared, \(h,\) ="):
        mistake(h)


def test_tuples_of_symbols_are_tuples():
    plant = ob.Plant("tanks")
    x, u = plant.states("x1:3", range=(0, 1)), plant.inputs("u", range=(0, 1))
    assert x + u == (*x, *u) and type(x + u) is tuple
    assert sp.Matrix(x).shape == (2, 1) and isinstance(x, tuple) and len(x) == 2


CAR = ob.plants.cruise_control


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ob.plot_run(CAR()), r"plot_run takes run as a Run \(what ob.simulate returns\)"),
        (lambda: ob.plot_run([1]), "it was given a list of int"),
        (lambda: ob.coverage_table([1]), r"takes runs as a mapping \(by label\); .* list of int"),
        (lambda: ob.simulate(1, 2, 3), "simulate takes model as a Plant"),
        (lambda: ob.generate_c(CAR(), "x"), r"observer as an Observer \(what a method's design"),
        (lambda: ob.FaultDetector(CAR()), "FaultDetector takes observer as an Observer"),
        (lambda: ob.estimate(CAR(), None), "estimate takes observer as an Observer"),
        (lambda: ob.least_bounds(CAR(), 3), r"record as a Record \(what ob.read_record returns\)"),
        (lambda: ob.choose("car"), "choose takes model as a Plant .* it was given a str"),
    ],
)
def test_arguments_of_another_kind_are_refused(call, message):
    with pytest.raises(ob.ObsynthError, match=message):
        call()


def test_a_function_stays_what_it_is():
    @takes(run="Run")
    def shown(run, scale=1):
        """Show it."""
        return scale

    assert (shown.__doc__, shown.__name__, shown(None, scale=3)) == ("Show it.", "shown", 3)
