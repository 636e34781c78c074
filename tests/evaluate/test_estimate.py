"""Every method over a record: the same bits as its step, a missing reading costs that reading."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from recorded import measured, start_of

import obsynth as ob
from methods import METHODS, observer_of, run_of
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS


def called(observer, record, memory):
    """What plain calls of the step return, by name."""
    rows = []
    for k in range(len(record)):
        given = [record.u[k], record.y[k]]
        if observer.step.n_in() == 4:
            given.append(record.rho[k])
        memory, *told = observer.step(memory, *given)
        rows.append([np.array(part).ravel() for part in told])
    names = (*STEP_OUTPUTS[1:], "alarm")
    return dict(zip(names, map(np.array, zip(*rows, strict=True)), strict=False))


@pytest.mark.parametrize("name", METHODS)
def test_every_method_and_detector_tells_the_bits_of_its_step(name):
    """Mutants: the memory of the call before; inputs of the instant before; no scheduling."""
    record, start = measured(name), start_of(name)
    observer = observer_of(name)
    every = [observer, ob.FaultDetector(observer)] if METHODS[name].detects else [observer]
    for one in every:
        told = ob.estimate(one, record, **start)
        expected = called(one, record, one.memory0(**start, y0=record.y[0]))
        for key, values in expected.items():
            found = getattr(told, key)
            assert np.array_equal(found, values.reshape(found.shape), equal_nan=True), key
        assert (told.alarm is None) == (one is observer)


@pytest.mark.parametrize("name", METHODS)
def test_a_missing_output_costs_that_output_only(name):
    """Sets with one reading are inside those with none, and say more wherever readings bound them.

    Mutant: all readings of the instant left out where one is missing.
    """
    record, start = measured(name), start_of(name)
    observer, m = observer_of(name), record.y.shape[1]
    if m == 1:
        pytest.skip("one output")
    told = {}
    for missing in ((), (m - 1,), range(m)):
        y = record.y[:12].copy()
        y[7] = run_of(name).y[7]
        y[10, list(missing)] = np.nan
        short = dataclasses.replace(record[:12], y=y)
        told[len(missing)] = ob.estimate(observer, short, **start)
    states = {count: one.x_upper[10] - one.x_lower[10] for count, one in told.items()}
    assert not told[0].status[10] & 32 and told[1].status[10] & 32 and told[m].status[10] & 32
    assert not told[1].status[10] & (STATUS["void"] | STATUS["non_finite_input"])
    assert np.all((told[1].x_lower >= told[m].x_lower) & (told[1].x_upper <= told[m].x_upper))
    if np.any(states[0] < states[m]):
        assert np.any(states[1] < states[m])


@pytest.mark.long
def test_a_million_samples_are_estimated_and_written_in_a_minute():
    """Under 60 s of this processor and 1 GiB. Mutant: rows kept as a list."""
    script = Path(__file__).parents[2] / "benchmarks/estimate.py"
    done = subprocess.run(
        [sys.executable, script, "million"], capture_output=True, text=True, check=True
    )
    _, seconds, mebibytes = done.stdout.split()[:3]
    assert float(seconds) < 60 and float(mebibytes) < 1024
