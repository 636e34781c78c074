"""The horizon follows from what the bounds take to settle, and half widths hold for old copies."""

from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.guard import MOST_CALLS


@pytest.fixture(scope="module", params=["ellipsoid", "peak"])
def observer(request):
    model = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    return ob.BoundedErrorUIO(gamma=0.005, bounds=request.param, form="corrected").design(model)


def steady_run(observer, steps):
    """March the plant where it rests, with held noise, and return half widths and ages."""
    model = observer.model
    at = ob.equilibrium(model, u=[10, 10])
    rest = [np.zeros(len(model.names(kind))) for kind in ("d", "f", "p", "rho")]
    w = model.box("w")[:, 1]
    y = model.function()(at.x, at.u, rest[0], rest[1], w, *rest[2:])[1]
    memory, widths, ages = observer.memory0(at.x), [], []
    place = observer.memory_layout["age"].start
    for _ in range(steps):
        told = [np.array(v).ravel() for v in observer.step(memory, at.u, y)]
        memory, half = told[0], [told[4] - told[3], told[6] - told[5]]
        widths.append(0.5 * np.concatenate(half))
        ages.append(memory[place])
    return np.array(widths), np.array(ages)


@pytest.mark.long
def test_half_widths_hold_when_a_copy_has_taken_over(observer):
    """Mutants: the estimate taken to lie inside of its box; begun two calls early."""
    contract, design = observer.certificate.contract, observer.certificate.design
    N = contract.guard(design).horizon
    widths, ages = steady_run(observer, 3 * N + 10)
    assert ages.max() == 2 * N - 1
    taken = np.flatnonzero(ages == N)
    assert taken.size >= 2
    assert np.all(widths[N:] <= observer.half_widths)
    core = observer.performance["core_half_widths"]
    assert np.all(observer.half_widths <= 1.0100001 * core)


def test_a_shorter_horizon_widens_what_is_promised(observer):
    design, contract = observer.certificate.design, observer.certificate.contract
    N = contract.guard(design).horizon
    sums = []
    for horizon in (N, N // 4, 3):
        chosen = replace(design, options={**design.options, "horizon": horizon})
        sums.append(contract.guard(chosen).widths(observer.performance["core_half_widths"]).sum())
    assert sums[0] < sums[1] < sums[2]


def test_what_could_not_begin_anew_is_not_given_up():
    """Without the inversion nothing bounds a fault that declares no range."""
    model = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    observer = ob.BoundedErrorUIO(gamma=0.005, cuts=()).design(model)
    guard = observer.certificate.contract.guard(observer.certificate.design)
    assert guard.horizon == MOST_CALLS
    widths, _ = steady_run(observer, 1000)
    assert np.isfinite(widths).all()
