"""Declaring a plant: what is kept, and every refusal."""

import math
import pickle
from fractions import Fraction

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.symbolic import Plant, PlantError, Role, Signal, TextError


def tank():
    plant = Plant("tank")
    plant.states("h1:3", range=[(1, 9), (2, 8)], unit="cm")
    plant.inputs("v1:3", range=(0, 5), nominal=[1, 2], unit=["V", "A"])
    return plant


def complete():
    plant = tank()
    plant.dynamics(["v1 - sqrt(h1)", "v2 - sqrt(h2)"])
    plant.outputs(["h1", "h2"])
    return plant


# -- what is kept -----------------------------------------------------------------------


def test_names_are_as_in_sympy_symbols():
    plant = Plant("names")
    assert [str(s) for s in plant.states("h1:5")] == ["h1", "h2", "h3", "h4"]
    assert [str(s) for s in plant.inputs("a b, c")] == ["a", "b", "c"]
    assert [str(s) for s in plant.unknown_inputs(["d", "e1:3"])] == ["d", "e1", "e2"]
    (single,) = plant.disturbances("w")
    assert single.is_real is True
    assert single.is_positive is None, "positivity comes from the box, never from the symbol"


def test_every_role_has_its_kind():
    plant = tank()
    plant.unknown_inputs("d")
    plant.actuator_faults("fa", of="v2", rate=0.1)
    plant.process_faults("fp", range=(0, 1))
    plant.faults("leak")
    plant.params("a", sp.Rational(1, 3))
    plant.params("b", 2.0, tolerance=0.05)
    plant.params("c", range=(1, 3), constant=False)
    plant.scheduling("load", range=(0, 5), measured=False)
    plant.disturbances("w1:3", bound=[0.1, 0.2])
    plant.disturbances("e")
    plant.sensor_faults("fs", of="y1", constant=True)
    assert plant.names("f") == ("fa", "fp", "leak", "fs"), "all faults, as declared"
    assert plant.names("p") == ("b", "c")
    assert [s.name for s in plant.constants] == ["a"]
    assert plant.constant_values == {sp.Symbol("a", real=True): sp.Rational(1, 3)}
    np.testing.assert_array_equal(plant.box("p"), [[1.9, 2.1], [1.0, 3.0]])
    np.testing.assert_array_equal(plant.box("x"), [[1, 9], [2, 8]])
    np.testing.assert_array_equal(plant.box("w"), [[-0.1, 0.1], [-0.2, 0.2], [-math.inf, math.inf]])
    assert plant.box("d").shape == (1, 2)
    assert Plant("empty").box("u").shape == (0, 2)
    assert plant.rho[0].measured is False
    assert plant.f[3].constant is True
    assert plant.f[0].unit == "A", "a fault has the unit of what it adds to"
    assert [s.nominal for s in plant.u] == [1.0, 2.0]
    assert plant.p[0].nominal == 2.0
    assert plant.p[1].constant is False


def test_actuator_and_sensor_faults_are_inserted():
    plant = Plant("faults")
    (x,) = plant.states("x")
    (v,) = plant.inputs("v")
    (fa,) = plant.actuator_faults("fa", of=v)
    plant.dynamics([v**2 - x])
    plant.outputs([x + v, x], names="flow level", unit=["cm^3", "cm"])
    (fs,) = plant.sensor_faults("fs", of="level")
    assert plant.rhs == sp.Matrix([(v + fa) ** 2 - x])
    assert plant.output == sp.Matrix([x + v + fa, x + fs]), "what the actuator does is measured"
    assert plant.equations == ((v**2 - x,), (v + x, x))
    assert plant.f[1].unit == "cm"
    assert plant.output_names == ("flow", "level")
    rhs, y = plant.function()(1.0, 2.0, [], [0.5, 0.25], [], [], [])
    assert float(rhs) == 5.25
    np.testing.assert_array_equal(np.array(y).ravel(), [3.5, 1.25])


def test_a_sensor_says_what_it_shows_when_healthy():
    """Mutants: discretise forgets the ranges; None becomes (0, 0)."""
    plant = complete()
    np.testing.assert_array_equal(
        plant.output_ranges, [[-math.inf, math.inf]] * len(plant.output_names)
    )
    assert Plant("empty").output_ranges.shape == (0, 2)
    plant = Plant("sensors")
    x, z = plant.states("x z", range=(0, 1))
    plant.dynamics([-x, -z])
    plant.outputs([x, z, x + z], range=[(-0.5, sp.Rational(3, 2)), None, (0, math.inf)])
    expected = [[-0.5, 1.5], [-math.inf, math.inf], [0, math.inf]]
    for model in (plant, plant.discretise("euler", 0.1), plant.discretise("rk4", 0.1)):
        np.testing.assert_array_equal(model.output_ranges, expected)
        assert model.output_ranges.dtype == np.float64
    pair = Plant("a pair")
    pair.states("x z")
    pair.dynamics(["-x", "-z"])
    pair.outputs(["x", "z"], range=np.array([0.0, 2.0]))
    np.testing.assert_array_equal(pair.output_ranges, [[0, 2], [0, 2]])
    pair.output_ranges[0, 0] = 1.0
    assert pair.output_ranges[0, 0] == 0.0, "what is returned is a copy"


def test_numbers_keep_their_meaning():
    plant = Plant("numbers")
    (x,) = plant.states("x")
    plant.params("a", Fraction(1, 3))
    plant.params("b", 0.1)
    plant.params("c", np.float64(0.25))
    plant.params("d", sp.sqrt(2))
    values = {str(k): v for k, v in plant.constant_values.items()}
    assert values["a"] == sp.Rational(1, 3)
    assert isinstance(values["b"], sp.Float)
    assert float(values["b"]) == 0.1
    assert float(values["c"]) == 0.25
    assert values["d"] == sp.sqrt(2)
    plant.dynamics([0.1 * x + sp.Rational(1, 3)])
    plant.outputs([x])
    coefficient = plant.rhs[0].coeff(x)
    assert float(coefficient) == 0.1
    assert plant.rhs[0].subs(x, 0) == sp.Rational(1, 3)


def test_users_own_symbols_are_matched_by_name():
    plant = tank()
    h1, h2, v1 = sp.symbols("h1 h2 v1")
    plant.dynamics([v1 - sp.sqrt(h1), sp.sin(h2)])
    assert plant.rhs.free_symbols <= {s.symbol for s in plant.signals}
    assert all(symbol.is_real for symbol in plant.rhs.free_symbols)


def test_rows_as_text_matrix_or_array():
    for rows in (
        ["-h1", "h2"],
        sp.Matrix(sp.symbols("h1 h2")),
        np.array(sp.symbols("h1 h2")),
        (0, 1.5),
    ):
        plant = tank()
        plant.dynamics(rows)
        assert plant.rhs.shape == (2, 1)


def test_rows_by_name_are_put_in_order():
    """Mutants: rows in the order of the mapping; names of outputs by number."""
    plant = Plant("p")
    a, b = plant.states("a b", range=(0, 1))
    with pytest.raises(PlantError, match="has rows of a, c; one each is needed of the states a, b"):
        plant.dynamics({"a": -a, "c": b})
    plant.dynamics({b: -2 * b, "a": -a})
    assert plant.outputs({"level": a + b, "other": b}) == ("level", "other")
    assert [*plant.rhs] == [-a, -2 * b] and [*plant.output] == [a + b, b]


def test_expressions_are_canonical_and_piecewise_is_closed():
    plant = Plant("p")
    (x,) = plant.states("x", range=(-1, 1))
    plant.dynamics([sp.Mul(2, x + 1, evaluate=False)])
    plant.outputs([sp.Piecewise((-x, x < 0), (x, x >= 0))])
    assert plant.rhs[0] == 2 * x + 2
    assert plant.output[0].args[-1][1] == sp.true


def test_constants_by_value_or_as_symbols():
    plant = Plant("c")
    (x,) = plant.states("x", range=(1, 2))
    (a, g) = plant.params("a g", [sp.Rational(1, 3), 981])
    plant.dynamics([a * sp.sqrt(2 * g * x)])
    plant.outputs([x])
    assert plant.sx().c.numel() == 0
    symbolic = plant.sx("symbol")
    assert [symbolic.c[k].name() for k in range(2)] == ["a", "g"]
    expected = math.sqrt(1962 * 1.5) / 3
    assert float(plant.function()(1.5, [], [], [], [], [], [])[0]) == pytest.approx(
        expected, rel=4e-16
    )
    with_c = symbolic.function()(1.5, [], [], [], [], [], [], [1 / 3, 981.0])[0]
    assert float(with_c) == pytest.approx(expected, rel=4e-16)
    assert plant.sx() is plant.sx()
    # One constant in the expression: the double nearest to sqrt(1962)/3.
    assert float(plant.function()(1.0, [], [], [], [], [], [])[0]) == float(
        (sp.sqrt(1962) / 3).evalf(40)
    )


def test_function_names_its_arguments():
    function = complete().function()
    assert function.name_in() == ["x", "u", "d", "f", "w", "p", "rho"]
    assert function.name_out() == ["rhs", "y"]


def test_plants_pickle():
    plant = complete()
    plant.sx()
    again = pickle.loads(pickle.dumps(plant))
    assert again.to_dict() == plant.to_dict()
    assert again.sx().rhs.shape == (2, 1)


@pytest.mark.parametrize("name", ["12 tanks", "été", "*", "quadruple tank"])
def test_any_name_makes_a_valid_function(name):
    plant = Plant(name)
    plant.states("x")
    plant.dynamics(["-x"])
    plant.outputs(["x"])
    assert plant.function().name().isidentifier()
    assert plant.name == name


# -- refusals ---------------------------------------------------------------------------

H = sp.symbols("h1 h2", real=True)
REFUSALS = {
    "empty name": (lambda p: Plant(" "), "non-empty"),
    "name twice in one call": (lambda p: p.inputs("a a"), "'a' is given twice"),
    "name twice": (lambda p: p.disturbances("h2"), "taken by the state h2"),
    "no name": (lambda p: p.inputs(""), "names nothing"),
    "names not text": (lambda p: p.inputs(3), "names are a string"),
    "no identifier": (lambda p: p.inputs("a-b"), "is no name"),
    "not ASCII": (lambda p: p.inputs("größe"), "is no name"),
    "reserved": (lambda p: p.inputs("sin"), "word of the equation language"),
    "reserved pi": (lambda p: p.inputs("pi"), "word of the equation language"),
    "inverted range": (lambda p: p.inputs("a", range=(2, 1)), "empty"),
    "nan range": (lambda p: p.inputs("a", range=(math.nan, 1)), "not a number"),
    "half-infinite range": (lambda p: p.inputs("a", range=(0, math.inf)), "not finite"),
    "range not a pair": (lambda p: p.inputs("a", range=(1, 2, 3)), "a pair"),
    "range a number": (lambda p: p.inputs("a", range=3), "is a pair"),
    "range of text": (lambda p: p.inputs("a", range=("0", "1")), "not a number"),
    "too few ranges": (lambda p: p.inputs("a b c", range=[(0, 1), (0, 1)]), "2 entries for 3"),
    "too many units": (lambda p: p.inputs("a", unit=["V", "A"]), "2 entries for 1"),
    "unit of two lines": (lambda p: p.inputs("a", unit="V\nGuaranteed:"), "text of one line"),
    "unit without end": (lambda p: p.inputs("a", unit="V" * 61), "at most 60 printable"),
    "name without end": (lambda p: p.inputs("a" * 101), "at most 100"),
    "plant of two lines": (lambda p: Plant("tank\n  - safe"), "a plant's name is text of one line"),
    "plant that turns round": (lambda p: Plant("a\u202eb"), "a plant's name is text of one line"),
    "plant without end": (lambda p: Plant("a" * 201), "at most 200 printable"),
    "output unit of two lines": (
        lambda p: p.outputs(["h1"], unit="cm\r"),
        "outputs: unit= is text of one line",
    ),
    "unit not text": (lambda p: p.inputs("a", unit=3), "unit= is text"),
    "nominal outside": (lambda p: p.inputs("a", range=(0, 1), nominal=2), "nominal value 2"),
    "nominal nan": (lambda p: p.inputs("a", nominal=math.nan), "nominal value nan"),
    "negative bound": (lambda p: p.disturbances("a", bound=-1), "bound=-1"),
    "infinite bound": (lambda p: p.disturbances("a", bound=math.inf), "bound=inf"),
    "bound and range": (lambda p: p.disturbances("a", bound=1, range=(0, 1)), "not both"),
    "bool as number": (lambda p: p.disturbances("a", bound=True), "not a number"),
    "complex number": (lambda p: p.disturbances("a", bound=1j), "not a number"),
    "rate zero": (lambda p: p.faults("a", rate=0), "constant=True"),
    "rate negative": (lambda p: p.faults("a", rate=-0.1), "not a finite, positive"),
    "rate nan": (lambda p: p.faults("a", rate=math.nan), "not a finite, positive"),
    "constant not bool": (lambda p: p.faults("a", constant=1), "True or False"),
    "of is no input": (lambda p: p.actuator_faults("a", of="h1"), "inputs are v1, v2"),
    "of is nothing": (lambda p: p.actuator_faults("a", of=3), "names inputs or outputs"),
    "of too many": (lambda p: p.actuator_faults("a", of="v1:3"), "1 faults .* for 2 signals"),
    "two faults of one": (lambda p: p.actuator_faults("a b", of=["v1", "v1"]), "told apart"),
    "param nothing": (lambda p: p.params("a"), "give value="),
    "param text": (lambda p: p.params("a", "1/3"), "not a number"),
    "param nan": (lambda p: p.params("a", math.nan), "not finite"),
    "param complex": (lambda p: p.params("a", sp.I), "not a finite real"),
    "param symbol": (lambda p: p.params("a", H[0]), "not a finite real"),
    "param tolerance alone": (lambda p: p.params("a", tolerance=0.1), "give value="),
    "param tolerance and range": (
        lambda p: p.params("a", 1, tolerance=0.1, range=(0, 2)),
        "without range=",
    ),
    "param tolerance negative": (lambda p: p.params("a", 1, tolerance=-0.1), "tolerance=-0.1"),
    "param infinite": (lambda p: p.params("a", range=(0, math.inf)), "has to be finite"),
    "param value outside": (lambda p: p.params("a", 5, range=(0, 1)), "nominal value 5"),
    "kind": (lambda p: p.box("q"), "kinds are x, u"),
    "rows missing": (lambda p: p.dynamics([H[0]]), r"1 rows for 2 states \(h1, h2\)"),
    "rows not a list": (lambda p: p.dynamics(H[0]), "a list of expressions"),
    "rows a text": (lambda p: p.dynamics("h1"), "a list of expressions"),
    "rows a wide matrix": (lambda p: p.dynamics(sp.Matrix([H])), "column matrix"),
    "row a matrix": (lambda p: p.dynamics([sp.eye(2), 0]), "(?s)row 1: .* is not an expression"),
    "row an object": (lambda p: p.dynamics([object(), 0]), "not an expression"),
    "row a bool": (lambda p: p.dynamics([True, 0]), "not an expression"),
    "row an equation": (lambda p: p.dynamics([0, sp.Eq(H[0], H[1])]), "row 2: .* is a condition"),
    "row a relation": (lambda p: p.dynamics([H[0] < 1, 0]), "row 1: .* is a condition"),
    "row a conjunction": (lambda p: p.dynamics([(H[0] < 1) & (H[1] < 1), 0]), "is a condition"),
    "row truth": (lambda p: p.dynamics([sp.true, 0]), "is a condition"),
    "row infinite": (lambda p: p.dynamics([sp.oo, 0]), "not a finite"),
    "row nan": (lambda p: p.dynamics([math.nan, 0]), "not a finite"),
    "row complex": (lambda p: p.dynamics([sp.I * H[0], 0]), "not a finite real"),
    "row huge": (lambda p: p.dynamics([sp.Integer(10) ** 400 * H[0], 0]), "not a finite real"),
    "row complex constant": (lambda p: p.dynamics([sp.asin(2) * H[0], 0]), "row 1: .*asin"),
    "undeclared": (
        lambda p: p.dynamics([sp.Symbol("h3"), 0]),
        "h3 is not declared .*did you mean h",
    ),
    "other assumptions": (
        lambda p: p.dynamics([sp.Symbol("h1", positive=True), 0]),
        "assumptions of its own",
    ),
    "dummy": (lambda p: p.dynamics([sp.Dummy("h1"), 0]), "row 1"),
    "unknown function": (lambda p: p.dynamics([0, sp.gamma(H[0])]), "row 2: the function gamma"),
    "own function": (lambda p: p.dynamics([sp.Function("g")(H[0]), 0]), "row 1: the function g "),
    "derivative": (
        lambda p: p.dynamics([sp.Derivative(sp.Function("g")(H[0]), H[0]), 0]),
        "row 1: the function",
    ),
    "open piecewise": (lambda p: p.dynamics([sp.Piecewise((1, H[0] < 2)), 0]), "leaves cases open"),
    "symbol as condition": (
        lambda p: p.dynamics([sp.Piecewise((1, H[0]), (2, True)), 0]),
        "used as a condition",
    ),
    "Ts zero": (lambda p: p.dynamics([0, 0], Ts=0), "Ts=0 is not positive"),
    "Ts negative": (lambda p: p.dynamics([0, 0], Ts=-0.5), "not positive"),
    "Ts nan": (lambda p: p.dynamics([0, 0], Ts=math.nan), "not finite"),
    "Ts text": (lambda p: p.dynamics([0, 0], Ts="1"), "not a number"),
    "no outputs": (lambda p: p.outputs([]), "at least one measurement"),
    "output names": (lambda p: p.outputs([H[0]], names="a b"), "1 rows and 2 names"),
    "output name taken": (lambda p: p.outputs([H[0]], names="h2"), "taken by a signal"),
    "output unit": (lambda p: p.outputs([H[0]], unit=3), "unit= is text"),
    "output range order": (lambda p: p.outputs([H[0]], range=(9, 1)), "output y1: range .9.0, 1.0"),
    "output range without room": (lambda p: p.outputs([H[0]], range=(1, 1)), "no room"),
    "output range at infinity": (
        lambda p: p.outputs([H[0]], range=(math.inf, math.inf)),
        "no room",
    ),
    "output range nan": (lambda p: p.outputs([H[0]], range=(math.nan, 1)), "no room"),
    "output range text": (lambda p: p.outputs([H[0]], range=("0", 1)), "y1: range: '0' is not a"),
    "output range no pair": (lambda p: p.outputs([H[0], H[1]], range=[(0, 1), 2]), "y2: a pair"),
    "output range half": (lambda p: p.outputs([H[0], H[1]], range=(None, 2)), "y2: a pair"),
    "output ranges": (lambda p: p.outputs([H[0]], range=[(0, 1)] * 2), "2 entries for 1 symbols"),
    "outputs of casadi": (lambda p: p.outputs([ca.SX.sym("a")]), "from_casadi"),
    "check dynamics": (lambda p: p.check(), "no dynamics"),
    "sx without outputs": (lambda p: (p.dynamics([0, 0]), p.sx()), "no outputs"),
    "constants": (lambda p: complete().sx("text"), "'value' or 'symbol'"),
    "discretise incomplete": (lambda p: p.discretise("euler", 1), "no dynamics"),
    "discretise method": (lambda p: complete().discretise("tustin", 1), "euler, rk4"),
    "discretise Ts": (lambda p: complete().discretise("euler", 0), "not positive"),
    "discretise twice": (
        lambda p: complete().discretise("euler", 1).discretise("euler", 1),
        "discrete already",
    ),
    "no states": (lambda p: Plant("a").dynamics([]), "at least one state"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals(case):
    action, message = REFUSALS[case]
    plant = tank()
    with pytest.raises(PlantError, match=message):
        action(plant)
    if case != "sx without outputs":
        assert not plant.has_dynamics
        assert plant.signals == tank().signals, "a refusal leaves the plant as it was"


def test_text_rows_say_which_row_and_where():
    with pytest.raises(TextError, match=r"dynamics row 2: .* position 5") as caught:
        tank().dynamics(["h1", "h2 + h5"])
    assert caught.value.position == 5
    with pytest.raises(PlantError) as undeclared:
        tank().dynamics([sp.Symbol("hh1"), 0])
    assert undeclared.value.declared == ("h1", "h2", "v1", "v2")
    assert undeclared.value.symbol == "hh1"


def test_order_of_declarations():
    plant = tank()
    plant.dynamics([0, 0])
    with pytest.raises(PlantError, match="before the dynamics"):
        plant.states("z")
    with pytest.raises(PlantError, match="given twice"):
        plant.dynamics([0, 0])
    plant.outputs(["h1"])
    with pytest.raises(PlantError, match="given twice"):
        plant.outputs(["h1"])
    with pytest.raises(PlantError, match="taken by the output y1"):
        plant.disturbances("y1")
    with pytest.raises(PlantError, match="outputs are y1"):
        plant.sensor_faults("s", of="y2")
    plant.actuator_faults("f", of="v1")
    assert plant.names("f") == ("f",), "what adds to inputs may come after the dynamics"
    plant.sx()
    for late in (lambda: plant.disturbances("w"), lambda: plant.sensor_faults("s", of="y1")):
        with pytest.raises(PlantError, match="in use already"):
            late()


def test_sensor_faults_may_come_before_the_outputs():
    plant = tank()
    plant.sensor_faults("s", of="y3")
    plant.dynamics([0, 0])
    with pytest.raises(PlantError, match="of=y3 is no output; outputs are y1, y2"):
        plant.outputs(["h1", "h2"])


def test_only_faults_have_a_rate():
    with pytest.raises(TypeError, match="rate"):
        tank().inputs("a", rate=0.1)
    with pytest.raises(PlantError, match="only faults have a rate"):
        Signal("a", sp.Symbol("a", real=True), Role.INPUT, rate=0.1)


def test_the_row_of_a_constant_that_vanishes_is_named():
    plant = Plant("singular")
    (x,) = plant.states("x", range=(0, 1))
    a, b = plant.params("a b", [2, 2])
    plant.dynamics([x / (a - b)])
    plant.outputs([x])
    with pytest.raises(PlantError, match="dynamics row 1"):
        plant.sx()
