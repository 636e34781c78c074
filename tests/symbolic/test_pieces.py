"""Tables, saturations and delays: what they are, what is derived of them, how text says them."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.symbolic import read_text
from obsynth.symbolic.plant_file import PlantText

KNOTS, VALUES = [0, 1, 2, 3, 4], [0, 1.5, 2, 1, 3]


def filling():
    plant = ob.Plant("table")
    (x,), (u,) = plant.states("x", range=(0.2, 3.5)), plant.inputs("u", range=(0, 1), nominal=0.5)
    plant.dynamics([u - ob.lookup(x, KNOTS, VALUES)])
    plant.outputs([ob.sat(x, 1, "3/2")])
    return plant


def test_a_table_is_its_values_and_lines_between_them():
    step = filling().function()
    none = [np.zeros(0)] * 5
    for x in np.linspace(-1, 5, 61):
        rate, y = step([x], [0.0], *none)
        assert -float(rate) == pytest.approx(np.interp(x, KNOTS, VALUES), abs=1e-12)
        assert float(y) == np.clip(x, 1, 1.5)


def test_bounds_of_slopes_are_those_of_the_pieces_in_the_range():
    """The slopes are 3/2, 1/2, -1, 2. Mutant: a piece that ends one knot early."""
    assert str(ob.jacobian_bounds(filling())).splitlines()[1].startswith("  m11 in [-2, 1]")


def test_text_says_the_same():
    (x,) = filling().x
    names = {"x": x.symbol}
    table = ob.lookup(x.symbol, ["0", "1/3", 1], [0, 0.1, 2])
    assert read_text("lookup(x, 0, 0, 1/3, 0.1, 1, 2)", names) == table
    assert read_text("lookup(x, [0, 1/3, 1], [0, 0.1, 2])", names) == table
    assert read_text("sat(x, 0, 1)", names) == sp.Min(1, sp.Max(0, x.symbol))
    assert ob.Plant.from_dict(filling().to_dict()).rhs == filling().rhs


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda x: ob.lookup(x, [0, 2, 1], [1, 2, 3]), "lookup of x: the knots 2, 1 do not incr"),
        (lambda x: ob.lookup(x, [0, 1], [1, 2, 3]), "2 knots and 3 values; give as many of both"),
        (lambda x: ob.lookup(x, [0, np.nan], [1, 2]), "lookup of x: nan is no finite number"),
        (lambda x: ob.sat(x, 2, 1), r"sat\(x, 2, 1\): give the lower limit first"),
        (lambda x: read_text("1 + lookup(x, 0, 1, 0, 2)", {"x": x}), "the knots 0, 0 do not"),
        (lambda x: read_text("lookup(x, 0, 1)", {"x": x}), "x: 1 knots and 1 values; give as many"),
        (lambda x: read_text("lookup(x, [0, 1], 2)", {"x": x}), r"write lookup\(x, \[knot, knot"),
        (
            lambda x: read_text("lookup(x, [0, 1, [2])", {"x": x}),
            r"unexpected '\[', at position 17",
        ),
        (lambda x: read_text("lookup(x, [0, 1)", {"x": x}), r"'\[0, 1\)' is not closed"),
        (lambda x: read_text("sat(x, [0, 1])", {"x": x}), r"unexpected '\['"),
        (lambda x: ob.delayed(filling(), "q", 1), r"takes a state or an input \(x, u\), not 'q'"),
        (lambda x: ob.delayed(filling(), "u", 0), "u is delayed by 0; give a number of steps"),
    ],
)
def test_what_is_no_table_is_refused(call, message):
    with pytest.raises(ob.PlantError, match=message):
        call(sp.Symbol("x", real=True))


def test_a_delayed_input_arrives_after_its_steps():
    plant = ob.Plant("pipe")
    (T,), (v,) = plant.states("T", range=(-9, 9)), plant.inputs("v", range=(0, 5), unit="V")
    late, rows = ob.delayed(plant, v, 3)
    plant.dynamics([late, *rows], Ts=1)
    plant.outputs([T])
    given = np.arange(1.0, 7.0)
    states = plant.function().mapaccum(6)(np.zeros(4), given, *[np.zeros((0, 6))] * 5)[0]
    np.testing.assert_array_equal(np.array(states)[0], [0, 0, 0, 1, 2, 3])
    assert [(s.lower, s.upper, s.unit) for s in plant.x[1:]] == [(0.0, 5.0, "V")] * 3


PIPE = """
name = "pipe"
Ts = 1
[states]
T = { range = [-9, 9] }
[inputs]
v = { range = [0, 5], unit = "V" }
[definitions]
pumped = "delayed(v, 3)"
[dynamics]
T = "pumped + delayed(v, 5)/9"
[outputs]
y = "delayed(T, 2)"
"""


def test_text_delays_signals_in_dynamics_and_outputs():
    """One chain a signal, as long as is asked for. Mutant: a chain that begins anew is longer."""
    plant = PlantText(PIPE, "pipe.toml").plant()
    assert plant.names("x") == ("T", *(f"v_late{k}" for k in range(1, 6)), "T_late1", "T_late2")
    assert [str(row) for row in plant.rhs] == [
        "v_late3 + v_late5/9",
        *("v", "v_late1", "v_late2", "v_late3", "v_late4"),
        *("T", "T_late1"),
    ]
    given = np.arange(1.0, 9.0)
    states, seen = plant.function().mapaccum(8)(np.zeros(8), given, *[np.zeros((0, 8))] * 5)
    np.testing.assert_allclose(np.array(states)[0] * 9, [0, 0, 0, 9, 18, 28, 38, 48])
    np.testing.assert_array_equal(np.array(seen)[0, 3:], np.array(states)[0, :5])


@pytest.mark.parametrize(
    ("what", "into", "message"),
    [
        (
            "Ts = 1",
            "",
            r"line 9, column 11: delayed\(v, 3\) counts steps, and these .* Ts = \.\.\.",
        ),
        ("delayed(T, 2)", "delayed(T, 1/2)", "line 13, column 6: T is delayed by 1/2; give a num"),
        ("delayed(T, 2)", "delayed(2*T, 2)", r"delayed takes a state or an input .*, not 2\*T"),
        ("delayed(T, 2)", "v_late9", "the symbol v_late9 is not declared"),
    ],
)
def test_delays_that_text_cannot_have_are_refused(what, into, message):
    with pytest.raises(ob.PlantError, match=message):
        PlantText(PIPE.replace(what, into), "pipe.toml").plant()
