"""Front doors refuse what they do not take, and tuples of symbols are no expressions."""

import math
import operator
import pickle

import numpy as np
import pandas as pd
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
        np.sqrt,
        sp.sin,
        sp.tanh,
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
    (both := list(x)).extend(u)
    grown = [*x]
    grown += u
    assert grown == both
    assert sp.Matrix(x).shape == (2, 1) and isinstance(x, tuple) and len(x) == 2


def test_functions_of_numpy_take_expressions():
    (h,) = ob.Plant("tank").states("h", range=(1, 2))
    assert np.sqrt(2 * h) == sp.sqrt(2 * h) and np.maximum(h, 0) == sp.Max(h, 0)
    assert np.arctan2(h, np.float64(2)) == sp.atan2(h, 2.0) and (np.float64(2) < h) == (h > 2.0)
    assert list(np.array([1, 2]) * h) == [h, 2 * h] and np.add.reduce([h, h]) == 2 * h
    assert list(np.sqrt([h, 1 - h])) == [sp.sqrt(h), sp.sqrt(1 - h)] and (h**3).exp == 3
    for function in (np.cbrt, lambda x: np.hypot(x, 1)):
        with pytest.raises(TypeError, match="has no form for the expression h: write it in SymPy"):
            function(h)


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (math.sqrt, r"^h is an expression and no number, .* function \(np.sqrt\) or SymPy's \(sp"),
        (lambda h: math.exp(-h / 2), "^-h/2 is an expression and no number, which math.sqrt"),
        (int, "^h is an expression and no number"),
        (lambda h: np.interp(h, [0, 1], [2, 3]), "obsynth.lookup in place of np.interp"),
        (lambda h: 1 if h > 0 else 2, r"^h > 0 is neither true .* sp.Piecewise\(\(a, h > 0\), \(b"),
        (lambda h: 1 < 2 * h < 3, "^2\\*h > 1 is neither true nor false while equations are wri"),
        (lambda h: min(h, 5), "^h > 5 is neither .* or sp.Min, sp.Max, obsynth.sat$"),
        (lambda h: np.where(h > 5, 1, 2), "if, and, min and np.where cannot choose"),
        (lambda h: float(sp.I), "^Cannot convert complex to float$"),
    ],
)
def test_an_expression_is_no_number_and_no_condition(mistake, message):
    (h,) = ob.Plant("tank").states("h", range=(1, 2))
    with pytest.raises(TypeError, match=message):
        mistake(h)


def tank(rows=lambda h, v: [v - h]):
    plant = ob.Plant("tank")
    (h,), (v,) = plant.states("h", range=(1, 9)), plant.inputs("v", range=(0, 9), nominal=2)
    plant.dynamics(rows(h, v))
    plant.outputs([h, 2 * h], names="level weight")
    return plant


@pytest.fixture(scope="module")
def observer():
    return ob.BoundedErrorUIO().design(tank().discretise("euler", Ts=0.1))


MISTAKES = {
    "an exponential of a tuple": (
        lambda: tank(lambda h, v: [sp.exp(ob.Plant("t").states("h"))]),
        r"dynamics row 1: a tuple of symbols \(h\) .* take it apart",
    ),
    "an array for a scalar": (
        lambda: tank(lambda h, v: [np.array([1.0, 2.0]) * h]),
        "dynamics row 1: .* one scalar to a row",
    ),
    "a state without an equation": (
        lambda: tank(lambda h, v: []),
        r"0 rows for 1 states \(h\): give one for each, in this order",
    ),
    "a range the wrong way round": (
        lambda: ob.Plant("t").states("a", range=(sp.Float(3), sp.Float(1))),
        r"state a: the range \(3.0, 1.0\) is empty; give the lower bound first",
    ),
    "a name used twice": (lambda: tank().inputs("h"), "input h: the name is taken by the state h"),
    "an equation for a right side": (
        lambda: tank(lambda h, v: [sp.Eq(h, v)]),
        "is a condition; give the right-hand side alone",
    ),
    "a misspelt option": (lambda: ob.HinfUIO(gama=1), "HinfUIO has no option 'gama'"),
    "a plant in continuous time": (
        lambda: ob.BoundedErrorUIO().design(tank()),
        r"tank is in continuous time .* call discretise\(",
    ),
    "a number for a plant": (lambda: ob.BoundedErrorUIO().design(3), "design takes model as a Pl"),
    "gains by themselves": (
        lambda: ob.BoundedErrorUIO().analyse(tank(), np.ones((2, 3))),
        r"analyse takes gains as a mapping \(by label\); it was given a ndarray",
    ),
    "an observer for a plant": (lambda: ob.split([1]), "split takes model as a Plant .* list of"),
    "a plant for a path": (lambda: ob.report(tank(), None), "path as a Path .* given a Plant"),
    "a method that is none": (
        lambda: tank().discretise("eulr", 1),
        "'eulr' is unknown; methods are euler, rk4, taylor",
    ),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_told_with_its_mend(mistake):
    call, message = MISTAKES[mistake]
    with pytest.raises(ob.ObsynthError, match=message):
        call()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([[2.0], [5.0]], r"y has 1 number for 2 outputs \(level, weight\)"),
        ([[2.0], 5.0], r"y has 1 number for 2 outputs"),
        ([[2.0], [5.0, 10.0, 1.0]], r"y has 3 numbers for 2 outputs \(level, weight\)"),
        ([[2.0, 2.0], [5.0, 10.0]], r"u has 2 numbers for 1 inputs \(v\)"),
        ([[2.0], [5.0, None]], "nan for a reading that is missing; not list"),
        ([[2.0], None], "nan for a reading that is missing; not NoneType"),
        ([[2.0], "high"], r"y is an array of numbers, .*nan for a reading .* not str 'high'"),
        (
            [[2.0], pd.Series({"weight": 10.0, "level": 5.0})],
            r"y is a Series with the labels \['weight', 'level'\].* y\[\['level', 'weight'\]\]",
        ),
        ([[2.0]], r"step takes \(memory, u, y\), each once; it was given 2 arguments"),
        ([np.array([2.0]), pd.Series([5.0, 10.0])], None),
        ([2, np.array([[5.0, 10.0]]).T], None),
        ([np.full((1, 3), 2.0), np.full((2, 3), 5.0)], None),
        ([np.full((1, 3), 2.0), np.full((3, 2), 5.0)], "y has 6 numbers for 2 outputs"),
    ],
)
def test_a_step_takes_as_many_numbers_as_there_are_signals(observer, given, message):
    """CasADi fills a vector with one number, reads labels in any order and none as zero.

    Mutants: sizes not compared; labels not looked at.
    """
    memory = observer.memory0([5.0])
    if message is None:
        assert len(observer.step(memory, *given)) == 8
        return
    with pytest.raises(ob.ObsynthError, match=message):
        observer.step(memory, *given)
    with pytest.raises(ob.ObsynthError, match=r"entries of the memory \(observer.memory0"):
        pickle.loads(pickle.dumps(observer)).step(memory[1:], [2.0], [5.0, 10.0])


def scenario(**given):
    return ob.Scenario("s", 1, **{"x0": [5.0], "guess": [5.0], "inputs": [[2.0]] * 2, **given})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda o: o.memory0(pd.Series({"level": 5.0})),
            r"'level'\].* give guess\[\['h'\]\].to_nu",
        ),
        (
            lambda o: o.memory0([5.0], x_range=pd.DataFrame({"low": [1.0], "high": [9.0]})),
            r"x_range is a DataFrame with the labels \['low', 'high'\], .* x_range\[\['h'\]\]",
        ),
        (
            lambda o: o.memory0([5.0], x_range=pd.DataFrame([[1.0, 9.0]], index=["h"])),
            r"labels \['h'\], which are not read: give x_range.loc\[\['h'\]\].to_numpy\(\)",
        ),
        (
            lambda o: scenario(x0=pd.Series({"h": 5.0})),
            r"scenario 's': x0 is a Series .* give x0\[",
        ),
        (
            lambda o: scenario(inputs=pd.DataFrame({"v": [2.0, 2.0]})),
            r"inputs is a DataFrame with the labels \['v'\].* inputs\[\['...'\]\].to_numpy",
        ),
        (
            lambda o: ob.simulate(o.model, o, pd.Series([2.0])),
            r"takes scenario as a Scenario \(made by ob.Scenario\(...\), .* given a Series",
        ),
    ],
)
def test_labels_are_not_read_in_whatever_order_they_have(observer, call, message):
    """Mutant: labels that no axis looks at."""
    with pytest.raises(ob.ObsynthError, match=message):
        call(observer)
    plain = observer.memory0(pd.Series([5.0]), x_range=pd.DataFrame([[1.0, 9.0]]))
    assert np.array_equal(plain, observer.memory0([5.0], x_range=[[1.0, 9.0]]))
    assert scenario(inputs=pd.DataFrame([[2.0], [2.0]])).inputs.shape == (2, 1)


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

    assert (shown.__doc__, shown.__name__, shown(object(), scale=3)) == ("Show it.", "shown", 3)
