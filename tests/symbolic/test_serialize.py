"""Plants as JSON and back."""

import builtins
import copy
import json
import math

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy.parsing import sympy_parser

from obsynth.symbolic import Plant, PlantError, Role, Signal, serialize
from obsynth.symbolic.plants import quadruple_tank
from obsynth.symbolic.serialize import signal_from_dict, signal_to_dict


def rich():
    plant = Plant("rich <plant>")
    x, z = plant.states("x z", range=[(0.1, 1 / 3), (-2, 2)], unit="m", nominal=[0.2, None])
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0.1, unit="N")
    plant.unknown_inputs("d")
    k, c = plant.params("k c", [sp.Rational(1, 3), 0.1], tolerance=[0.05, None])
    (r,) = plant.scheduling("r", range=(0, 1), measured=False)
    w1, w2 = plant.disturbances("w1 w2", bound=[0.1, None])
    plant.actuator_faults("fa", of=u, rate=0.3, range=(-1, 1))
    plant.faults("fp", constant=True)
    friction = sp.Piecewise((sp.Abs(x) ** sp.Rational(3, 2), x > z), (sp.Max(x, z, 0), True))
    plant.dynamics(
        [k * friction + u + w1, sp.sin(r * z) - c * sp.exp(-x) + sp.pi * sp.Symbol("fp")]
    )
    plant.outputs([x + w2, z * 0.3], names="pos other", unit=["m", ""], range=[(-1, 0.1), None])
    plant.sensor_faults("fs", of="pos")
    return plant


def discrete():
    plant = Plant("discrete")
    (x,) = plant.states("x")
    plant.dynamics([0.5 * x], Ts=0.1)
    plant.outputs([x])
    return plant


PLANTS = {
    "rich": rich,
    "tank": quadruple_tank,
    "tank euler": lambda: quadruple_tank().discretise("euler", 1.0),
    "tank rk4": lambda: quadruple_tank().discretise("rk4", sp.Rational(1, 10)),
    "tank odd step": lambda: quadruple_tank().discretise("euler", 0.1),
    "discrete": discrete,
}


@pytest.mark.parametrize("name", PLANTS)
def test_json_round_trip_is_exact(name):
    plant = PLANTS[name]()
    stored = plant.to_dict()
    again = Plant.from_dict(json.loads(json.dumps(stored, allow_nan=False)))
    assert again.to_dict() == stored
    assert again.signals == plant.signals
    assert again.equations == plant.equations
    assert again.rhs == plant.rhs
    assert again.output == plant.output
    assert again.exact_Ts == plant.exact_Ts
    assert again.output_names == plant.output_names
    assert again.output_units == plant.output_units
    assert again.output_ranges.tolist() == plant.output_ranges.tolist()
    assert again.constant_values == plant.constant_values
    assert again.discretisation == plant.discretisation
    assert repr(again) == repr(plant)


def test_a_file_without_ranges_of_outputs_declares_none():
    """Mutants: an infinite end is written as a number; a missing one read as 0."""
    stored = rich().to_dict()
    assert [(item["lower"], item["upper"]) for item in stored["outputs"]] == [
        (-1.0, 0.1),
        (None, None),
    ]
    for item in stored["outputs"]:
        del item["lower"], item["upper"]
    assert not np.isfinite(Plant.from_dict(stored).output_ranges).any()
    stored["outputs"][1]["upper"] = 3
    np.testing.assert_array_equal(Plant.from_dict(stored).output_ranges[1], [-math.inf, 3.0])
    stored["outputs"][1]["lower"] = 3
    with pytest.raises(PlantError, match=r"output other: range \(3.0, 3.0\)"):
        Plant.from_dict(stored)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.floats(-1e300, 1e300), st.floats(0, 1e300), st.floats(1e-300, 1e300))
def test_signals_keep_every_bit(lower, width, rate):
    upper = lower + width
    symbol = sp.Symbol("f", real=True)
    signal = Signal("f", symbol, Role.PROCESS_FAULT, lower, upper, "V", lower, rate, True)
    assert signal_from_dict(json.loads(json.dumps(signal_to_dict(signal)))) == signal


def change(path, value):
    def apply(data):
        *inner, last = path
        for key in inner:
            data = data[key]
        if value is KeyError:
            del data[last]
        else:
            data[last] = value

    return apply


BROKEN = {
    "format": (change(["format"], "obsynth plant 99"), "the format is 'obsynth plant 99'"),
    "no format": (change(["format"], KeyError), "'format' is None"),
    "no name": (change(["name"], KeyError), "'name' is None"),
    "signals no list": (change(["signals"], {}), "'signals' is {}"),
    "signal no table": (change(["signals", 0], 3), "a table with 'name'"),
    "role": (change(["signals", 0, "role"], "ghost"), "role 'ghost' is unknown"),
    "names in one": (change(["signals", 0, "name"], "x1:3"), "not the name of one signal"),
    "name twice": (change(["signals", 1, "name"], "x"), "taken by the state x"),
    "bound text": (change(["signals", 0, "lower"], "0.1"), "'lower' is '0.1', not of type float"),
    "bound inverted": (change(["signals", 0, "lower"], 5.0), "is empty"),
    "bound missing": (change(["signals", 0, "upper"], None), "not finite"),
    "rate of a state": (change(["signals", 0, "rate"], 1.0), "only faults"),
    "value text": (change(["signals", 4, "value"], "open('x')"), "position"),
    "fault of nobody": (change(["signals", 9, "of"], "v9"), "of=v9 is no input"),
    "dynamics evil": (change(["dynamics", 0], "__import__('os')"), "dynamics row 1"),
    "dynamics missing": (change(["dynamics"], ["x"]), "1 rows for 2 states"),
    "dynamics number": (change(["dynamics", 0], 3), "dynamics are texts"),
    "outputs missing": (change(["outputs"], []), "at least one measurement"),
    "output name": (change(["outputs", 0, "name"], 3), "'name' is 3"),
    "Ts": (change(["Ts"], "-1"), "not positive"),
    "Ts text": (change(["Ts"], "soon"), "soon is not declared"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_data_are_refused(case):
    breaking, message = BROKEN[case]
    data = copy.deepcopy(rich().to_dict())
    breaking(data)
    with pytest.raises(PlantError, match=message):
        Plant.from_dict(data)


@pytest.mark.parametrize("data", [None, [], "plant", {}])
def test_other_data_are_refused(data):
    with pytest.raises(PlantError, match="stored plant"):
        Plant.from_dict(data)


def test_a_discretised_plant_needs_its_method():
    data = PLANTS["tank euler"]().to_dict()
    data["discretise"]["method"] = "magic"
    with pytest.raises(PlantError, match="'magic' is unknown"):
        Plant.from_dict(data)


def test_a_discretised_plant_of_another_format_is_refused():
    data = PLANTS["tank euler"]().to_dict()
    data["format"] = "obsynth plant 2"
    with pytest.raises(PlantError, match="the format is"):
        Plant.from_dict(data)


def test_reading_evaluates_nothing(monkeypatch):
    stored = json.loads(json.dumps(rich().to_dict()))

    def forbidden(*_args, **_keywords):
        raise AssertionError("text was handed to an evaluator")

    monkeypatch.setattr(builtins, "eval", forbidden)
    monkeypatch.setattr(sympy_parser, "parse_expr", forbidden)
    monkeypatch.setattr(sympy_parser, "eval_expr", forbidden)
    assert Plant.from_dict(stored).to_dict() == stored
    with pytest.raises(AssertionError, match="evaluator"):
        sp.sympify("x + 1")


def test_what_could_not_be_read_again_is_not_stored(monkeypatch):
    plant = discrete()
    monkeypatch.setattr(serialize, "write_text", lambda row: "0.25*x")
    with pytest.raises(PlantError, match="does not survive"):
        plant.to_dict()


def test_an_incomplete_plant_is_not_stored():
    with pytest.raises(PlantError, match="no dynamics"):
        Plant("a").to_dict()
