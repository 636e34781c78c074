"""The horizon follows from what the bounds take to settle, and half widths hold for old copies."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import obsynth as ob


def slow_plant(faults=True):
    """Two slow unmeasured states, the second fed by the first; a fault without range or rate."""
    R = sp.Rational
    p = ob.Plant("slow")
    x = p.states("x1:4", range=[(-9, 9), (-5, 5), (-20, 20)])
    (rho,) = p.scheduling("rho", range=(-1, 1), measured=False)
    f = p.faults("f")[0] if faults else 0
    w = p.disturbances("w1:3", range=[(-0.005, 0.01), (-0.01, 0.01)])
    (v,) = p.disturbances("v", bound=0.01)
    slow = [R(24, 25) * x[1] + w[0], (R(23, 25) + rho / 100) * x[2] + x[1] / 10 + w[1]]
    p.dynamics([x[0] / 2 - x[1] / 4 + x[2] / 8 - 2 * f, *slow], Ts=1)
    p.outputs([x[0] + v])
    return p


@pytest.fixture(scope="module", params=["vertex", "paper"])
def observer(request):
    return ob.IntervalObserver(bound=request.param).design(slow_plant())


def steady_run(observer, steps):
    """March at rest with readings of zero, and return half widths and ages."""
    plant = observer.model
    u, y = np.zeros(len(plant.u)), np.zeros(len(plant.output_names))
    memory, widths, ages = observer.memory0(np.zeros(len(plant.x))), [], []
    place = observer.memory_layout["age"].start
    for _ in range(steps):
        told = [np.array(part).ravel() for part in observer.step(memory, u, y)]
        memory, half = told[0], [told[4] - told[3], told[6] - told[5]]
        widths.append(0.5 * np.concatenate(half))
        ages.append(memory[place])
    return np.array(widths), np.array(ages)


def guard_of(observer, **options):
    design, contract = observer.certificate.design, observer.certificate.contract
    return contract.guard(replace(design, options={**design.options, **options}))


def test_half_widths_hold_when_a_copy_has_taken_over(observer):
    """Mutants: `settling` stops at half of its calls; begins from half of the box."""
    N = guard_of(observer).horizon
    assert 150 < N < 400
    widths, ages = steady_run(observer, 3 * N + 10)
    assert np.flatnonzero(ages == N).size >= 2
    assert np.all(widths[N:] <= observer.half_widths)
    core = observer.performance["core_half_widths"]
    assert np.all(observer.half_widths <= 1.0100001 * core)


@pytest.mark.parametrize("share", [1, 5, 40])
def test_a_shorter_horizon_widens_what_is_promised(observer, share):
    """Mutants: two calls more are counted than a copy has had; the limits are promised."""
    core = observer.performance["core_half_widths"]
    N = guard_of(observer).horizon // share
    method = ob.IntervalObserver(bound=observer.record["bound"], horizon=N)
    short = method.design(slow_plant())
    widths, _ = steady_run(short, 3 * N + 10)
    assert np.all(widths[N:] <= short.half_widths)
    assert guard_of(observer, horizon=N).widths(core) == pytest.approx(short.half_widths)
    if share > 1:
        assert np.all(short.half_widths[1:] > 1.05 * core[1:])


@pytest.mark.parametrize("horizon", [1, 2, 3])
def test_the_shortest_horizons_promise_what_first_sets_hold(horizon):
    observer = ob.IntervalObserver(horizon=horizon).design(slow_plant())
    widths, _ = steady_run(observer, 20)
    assert np.all(widths[1:, :3] <= observer.half_widths[:3])


def test_the_first_width_holds_the_image_of_the_box(observer):
    """Mutant: half of the box."""
    design = observer.certificate.design
    x = np.array([1.0, 2.0, 3.0])
    first = design.first_width(x)
    ends = np.array(np.meshgrid(*[(-v, v) for v in x], indexing="ij")).reshape(3, -1)
    image = np.array(design.P) @ np.array(design.decoupled.T2, dtype=float) @ ends
    spread = image.max(axis=1) - image.min(axis=1)
    assert np.all(spread <= first) and first == pytest.approx(spread)


def test_what_could_not_begin_anew_is_not_given_up():
    """The slow states declare no range and no reading bounds them: they would be lost for good."""
    p = ob.Plant("open")
    x = p.states("x1:3", range=[(-9, 9), (-np.inf, np.inf)])
    (w,) = p.disturbances("w", bound=0.01)
    p.dynamics([x[0] / 2 + x[1] / 4, sp.Rational(9, 10) * x[1] + w], Ts=1)
    p.outputs([x[0]])
    observer = ob.IntervalObserver(cuts=()).design(p)
    assert guard_of(observer).horizon == 10**9
