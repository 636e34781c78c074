"""The record of the leak as it was measured, and the plant that was identified from it."""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import obsynth as ob

RECORD = ob.records.three_tank_leak()


def test_the_file_is_the_one_that_was_published_with_its_licence():
    folder = Path(ob.records.__file__).parent
    digest = hashlib.sha256((folder / "three_tank_leak.csv").read_bytes()).hexdigest()
    assert digest == "fa98a5d41ef1763d944eb948c581e54fa61247a7678ee4feafb87fbeea8271da"
    assert "Copyright (c) 2021 Lejun Hu" in (folder / "three_tank_leak.LICENSE").read_text()


def test_channels_are_in_the_signals_of_the_plant():
    """Mutants: readings at rest taken from the first sample kept; duty not scaled."""
    plant = ob.plants.leaking_tanks()
    assert RECORD.names["u"] == plant.names("u") and RECORD.names["y"] == plant.output_names
    assert RECORD.units["y"] == plant.output_units
    assert np.array_equal(RECORD.time, np.arange(36.0, 217.0))
    # y1 is .405459 V at sample 36 and .160824 V at rest; pumps at full range there, off from 105
    assert RECORD["y1"][0] == pytest.approx(0.244635, abs=2e-5)
    assert np.array_equal(RECORD["u1"][105 - 36 :], np.zeros(112))
    assert 0 < RECORD["u1"][0] <= 1
    assert RECORD["pulses"][60 - 36] == 0 and RECORD["pulses"][-1] > 3000


def test_the_plant_moves_as_three_levels_do():
    """The equations in levels, written apart. Mutants: the sign of the leak, a row of e3."""
    plant = ob.plants.leaking_tanks()
    rng = np.random.default_rng(0)
    e1, h2, e3 = x = rng.uniform(*plant.box("x").T)
    u, f, w = rng.uniform(0, 1, 2), rng.uniform(-0.05, 0.05, 1), rng.uniform(-0.006, 0.006, 6)
    moved, shown = (np.array(part) for part in plant.function()(x, u, [], f, w, [], [])[:2])
    h = np.array([h2 + e1, h2, h2 + e3])
    q1, q3 = 0.024044 * np.sqrt(e1), 0.022232 * np.sqrt(e3)
    rates = np.array([-q1 + 0.036427 * u[0], q1 + q3 - f[0], -q3 + 0.035121 * u[1]])
    after = h + rates + w[:3]
    expected = [after[0] - after[1], after[1], after[2] - after[1]]
    np.testing.assert_allclose(np.ravel(moved), expected, rtol=1e-12)
    np.testing.assert_allclose(np.ravel(shown), h + w[3:], rtol=1e-12)


def test_the_parameters_are_those_of_the_record():
    """One step of least squares, linear in the parameters and in what a pulse is worth."""
    y, u, flow = RECORD.y, RECORD.u[:-1], np.diff(RECORD["pulses"])
    s1, s3 = np.sqrt(y[:-1, 0] - y[:-1, 1]), np.sqrt(y[:-1, 2] - y[:-1, 1])
    none = np.zeros_like(s1)
    rows = np.vstack(
        [
            np.column_stack([-s1, none, u[:, 0], none, none]),
            np.column_stack([s1, s3, none, none, -flow]),
            np.column_stack([none, -s3, none, u[:, 1], none]),
        ]
    )
    found = np.linalg.lstsq(rows, np.diff(y, axis=0).T.ravel(), rcond=None)[0]
    values = ob.plants.leaking_tanks().constant_values
    given = {str(symbol): float(value) for symbol, value in values.items()}
    np.testing.assert_allclose(found[:4], [given[n] for n in ("a1", "a3", "b1", "b3")], rtol=0.035)
    assert found[4] == pytest.approx(0.000968, rel=0.01)


def test_bounds_and_rate_are_options():
    plant = ob.plants.leaking_tanks(wx=0.001, wy=0.002, rate=0.03)
    assert plant.box("w")[:, 1].tolist() == [0.001] * 3 + [0.002] * 3
    assert plant.f[0].rate == 0.03 and ob.plants.leaking_tanks().f[0].rate is None


def test_a_record_cannot_be_changed_and_refuses_what_does_not_fit():
    """Mutant: the time not compared, so that a record runs backwards."""
    assert len(RECORD) == 181
    with pytest.raises(ValueError, match="read-only"):
        RECORD.y[0] = 0
    with pytest.raises(ob.PlantError, match="the time has to increase"):
        replace(RECORD, time=RECORD.time[::-1])
    with pytest.raises(ob.PlantError, match=r"u has shape \(180, 2\); \(181, 2\) is needed"):
        replace(RECORD, u=RECORD.u[1:])
    with pytest.raises(ob.PlantError, match="no channel is called 'y4'; there are u1, u3, y1"):
        RECORD["y4"]
    with pytest.raises(ob.PlantError, match="start=216 is no sample from 0 to 215"):
        ob.records.three_tank_leak(216)
