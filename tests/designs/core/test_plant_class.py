"""Plant classes as data: what they refuse, by whose name; what is handed over beside the plant."""

import numpy as np
import pytest

import obsynth as ob
from methods import two_tanks
from obsynth.designs.core.given import PlantClass, Start, read_gains

CLASS = PlantClass(
    who="the observer",
    time="discrete",
    forbids={"rho": ": none here", "d": ": no unknown inputs"},
    finite={"x": " has no finite range"},
    needs={"w": "there is nothing to bound"},
)


def plant(**extra):
    p = ob.Plant("cart")
    x, v = p.states("x v", range=extra.get("range", (-1, 1)))
    (u,) = p.inputs("u")
    noise = 0
    if extra.get("noise", True):
        (noise,) = p.disturbances("n", bound=0.1)
    if extra.get("sensor"):
        p.sensor_faults("s", of="y1")
    if extra.get("d"):
        p.unknown_inputs("push")
    if extra.get("rho"):
        p.scheduling("r", range=(0, 1))
    p.dynamics([v, u - x])
    p.outputs([x + noise])
    return p.discretise("euler", Ts=0.1) if extra.get("discrete", True) else p


def test_a_plant_of_the_class_is_returned():
    given = plant()
    assert CLASS.check(given) is given


@pytest.mark.parametrize(
    ("change", "said", "symbols"),
    [
        ({"discrete": False}, "cart is in continuous time and the observer works in", ()),
        ({"rho": True}, "scheduling variable r: none here", ("r",)),
        ({"d": True}, "unknown input push: no unknown inputs", ("push",)),
        ({"sensor": True}, "sensor fault s: ", ("s",)),
        ({"range": None}, "state x, v has no finite range", ("x", "v")),
        ({"noise": False}, "'cart' declares no disturbance; there is nothing to bound", ()),
    ],
)
def test_what_is_outside_is_refused_by_its_names(change, said, symbols):
    with pytest.raises(ob.StructureError) as refusal:
        CLASS.check(plant(**change))
    assert said in str(refusal.value)
    assert getattr(refusal.value, "symbols", ()) == symbols
    assert refusal.value.condition


def test_continuous_methods_refuse_discrete_plants():
    with pytest.raises(ob.StructureError, match="'cart' is a discrete plant"):
        PlantClass(who="the observer", time="continuous").check(plant())


def test_gains_are_read_by_name_and_shape():
    shapes = {"K": (2, 1), "F": (0, 1)}
    found = read_gains({"K": [[1], [2]], "F": []}, shapes)
    assert found["K"].shape == (2, 1) and found["F"].shape == (0, 1)
    assert read_gains({"K": [1, 2], "F": []}, shapes)["K"].tolist() == [[1], [2]]
    assert set(read_gains({"K": np.ones((2, 1))}, shapes, optional=("F",))) == {"K"}
    for given, said in (
        ({"K": [[1], [2]]}, r"needs F; it takes K of shape \(2, 1\), F of shape \(0, 1\)"),
        ({"K": [[1], [2]], "F": [], "G": 1}, "gains has"),
        ({"K": [[1, 2]], "F": []}, r"K has shape \(1, 2\)"),
        ({"K": [[1], [np.inf]], "F": []}, r"K has shape \(2, 1\)"),
        ({"K": "k", "F": []}, "K has no array of numbers"),
    ):
        with pytest.raises(ob.ObsynthError, match=said) as refusal:
            read_gains(given, shapes)
        assert refusal.value.option == "gains"


def test_a_start_is_checked_and_may_be_unbounded():
    tanks = two_tanks()
    start = Start.read(tanks, [9, 9])
    np.testing.assert_array_equal(start.x, tanks.box("x"))
    assert start.f.shape == (0, 2)
    np.testing.assert_array_equal(Start.read(tanks, [9, 9], [(8, 9), (7, 9)]).x, [(8, 9), (7, 9)])
    assert np.isinf(Start.read(plant(range=None), [0, 0]).x).all()
    for given, said in (
        (([9],), "guess has to be 2 finite numbers"),
        (([9, 9], [(8, 9)]), "x_range has to be 2 finite pairs"),
        (([9, 9], [(9, 8), (7, 9)]), "lower <= upper"),
    ):
        with pytest.raises(ob.ObsynthError, match=said):
            Start.read(tanks, *given)
