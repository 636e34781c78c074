"""Parameters from records: intervals that hold, values, and what a record does not determine."""

import itertools

import numpy as np
import pytest

import obsynth as ob

BOX = {"a1": (0.005, 0.05), "a3": (0.005, 0.05), "b1": (0.02, 0.06), "b3": (0.02, 0.06)}
LEAST = np.array([0.001568056043987548, 0.006994620522516981])
KNOWN = {
    1.02: [
        (0.022744579, 0.024360142),
        (0.020970524, 0.022033169),
        (0.036556075, 0.038303511),
        (0.033623864, 0.036133495),
    ],
    1.2: [
        (0.018285686, 0.026901132),
        (0.016493905, 0.026087256),
        (0.032258174, 0.042198444),
        (0.027874832, 0.042064175),
    ],
}


@pytest.mark.long
@pytest.mark.parametrize("factor", sorted(KNOWN))
def test_intervals_of_the_leak_record(factor: float) -> None:
    plant = ob.plants.leaking_tanks(*(factor * LEAST))
    found = ob.identify(plant, ob.records.three_tank_leak(), BOX)
    assert np.allclose([*found.intervals.values()], KNOWN[factor], atol=1e-5)
    assert not found.directions


def _chain(w: float = 0.01) -> ob.Plant:
    """A hidden state that an input drives and that drives what is measured."""
    plant = ob.Plant("chain")
    x1, x2 = plant.states("x1 x2", range=(0, 4))
    (u,) = plant.inputs("u", range=(0, 1))
    noise = plant.disturbances("w1:4", bound=w)
    a, b, c = plant.params("a b c", [0.5, 0.8, 0.6])
    plant.dynamics([a * x1 + b * u + noise[0], c * x1 + x2 / 2 + noise[1]], Ts=1)
    plant.outputs([x2 + noise[2]])
    return plant


def _measured(plant: ob.Plant, steps: int, seed: int) -> ob.Record:
    rng = np.random.default_rng(seed)
    u = rng.uniform(0.0, 1.0, (steps, 1))
    w = rng.choice([-1.0, 1.0], (steps, 3)) * plant.w[0].upper
    x, y = np.array([1.0, 1.0]), np.empty((steps, 1))
    for k in range(steps):
        after, y[k] = (
            np.array(part).ravel() for part in plant.function()(x, u[k], 0, 0, w[k], 0, 0)
        )
        x = after
    return ob.Record(
        time=np.arange(steps, dtype=float),
        u=u,
        y=y,
        reference=np.empty((steps, 0)),
        names={"u": ("u",), "y": ("y1",), "reference": ()},
        units={"u": ("",), "y": ("",), "reference": ()},
        source="chain",
    )


def test_scale_of_a_hidden_state_is_not_determined() -> None:
    """Only b c counts: twice the one and half the other shows nowhere."""
    plant = _chain()
    found = ob.identify(
        plant, _measured(plant, 40, 0), {"a": (0.2, 0.9), "b": (0.2, 2), "c": (0.2, 2)}
    )
    (direction,) = found.directions
    assert set(direction) == {"b", "c"} and abs(direction["b"] + direction["c"]) < 1e-3
    assert np.isinf(found.deviations["b"]) and np.isinf(found.deviations["c"])
    assert 0.0 < found.deviations["a"] < 0.05
    assert "Not determined: b by" in str(found)


@pytest.mark.parametrize("seed", range(4))
def test_no_interval_without_the_truth(seed: int) -> None:
    """Noise at the vertices; a product whose corner is too small loses the truth."""
    plant = _chain()
    found = ob.identify(plant, _measured(plant, 60, seed), {"a": (0.2, 0.9), "c": (0.2, 2)})
    assert found.intervals["a"][0] <= 0.5 <= found.intervals["a"][1]
    assert found.intervals["c"][0] <= 0.6 <= found.intervals["c"][1]
    assert abs(found.values["a"] - 0.5) < 0.1 and np.ptp(found.intervals["c"]) < 1.0


def test_absolute_values_leave_an_outlier_alone() -> None:
    plant = _chain(0.002)
    record = _measured(plant, 40, 1)
    y = record.y.copy()
    y[20] += 0.3
    loose = plant.with_ranges({f"w{k}": (-0.4, 0.4) for k in (1, 2, 3)})
    spoiled = ob.Record(**{**record.__dict__, "y": y})
    off = [
        abs(ob.identify(loose, spoiled, {"a": (0.2, 0.9)}, loss=loss).values["a"] - 0.5)
        for loss in ("squares", "absolute")
    ]
    assert off[1] < off[0] and off[1] < 0.01


def test_contradicted_bounds() -> None:
    plant = _chain()
    tight = plant.with_ranges({f"w{k}": (-0.003, 0.003) for k in (1, 2, 3)})
    with pytest.raises(ob.BoundsError, match="contradicts"):
        ob.identify(tight, _measured(plant, 60, 0), {"a": (0.2, 0.9)})
    with pytest.raises(ob.BoundsError, match="'z'"):
        ob.identify(plant, _measured(plant, 60, 0), {"z": (0.2, 0.9)})
    with pytest.raises(ob.BoundsError, match="give the range"):
        ob.identify(plant, _measured(plant, 60, 0), ["a"])


def test_the_plant_holds_for_every_parameter_in_the_intervals() -> None:
    """The mean value of the mismatch over half of an interval leaves some of these outside."""
    plant = ob.plants.leaking_tanks()
    ranged = {"a1": (0.0237, 0.0227, 0.0244), "b3": (0.035, 0.0336, 0.0361)}
    found = plant.with_params(**ranged)
    carried = {s.name: (s.lower, s.upper) for s in found.w if s.name.startswith("mismatch_")}
    assert set(carried) == {"mismatch_e1", "mismatch_h2", "mismatch_e3"}
    ends = [(low, high) for _, low, high in ranged.values()]
    real_plants = [
        plant.with_params(**dict(zip(ranged, corner, strict=True))).function()
        for corner in itertools.product(*ends)
    ]
    rng, room = np.random.default_rng(0), np.inf
    for _ in range(400):
        x, u = (
            np.where(rng.random(len(box)) < 0.7, rng.choice([0, 1], len(box)), rng.random(len(box)))
            * np.ptp(box, axis=1)
            + box[:, 0]
            for box in (plant.box("x"), plant.box("u"))
        )
        given = (x, u, 0, 0, np.zeros(6), 0, 0)
        real = np.array(real_plants[rng.integers(4)](*given)[0]).ravel()
        held = (x, u, 0, 0, np.zeros(9), 0, 0)
        off = real - np.array(found.function()(*held)[0]).ravel()
        for value, (low, high) in zip(off, carried.values(), strict=True):
            assert low - 1e-15 <= value <= high + 1e-15  # what the test itself rounds
            room = min(room, (value - low) / (high - low), (high - value) / (high - low))
    assert room < 0.02


def test_other_parameters() -> None:
    plant = ob.plants.leaking_tanks()
    assert plant.with_params(a1=(0.02, 0.03)).box("p").tolist() == [[0.02, 0.03]]
    assert plant.with_params(a1=0.03).constants[0].lower == 0.03
    with pytest.raises(ob.PlantError, match="no parameter 'c'"):
        plant.with_params(c=1.0)
    with pytest.raises(ob.PlantError, match="give a value"):
        plant.with_params(a1=(0.05, 0.02, 0.03))
