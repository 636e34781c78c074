"""Without options: the class is asked first, the sets follow from the declared ranges."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from methods import METHODS, simulated, vessel


@pytest.fixture(scope="module")
def observer():
    return ob.QPVObserver(Ts=0.01).design(vessel())


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("dc_motor", "unknown input load: the QPV observer does not decouple"),
        ("heat_exchanger", "input q_h multiplies states"),
        ("tanks_in_a_row", "no polynomial in h1"),
    ],
)
def test_the_class_is_refused_before_a_region_is_asked_for(name, reason):
    with pytest.raises(ob.StructureError, match=reason):
        ob.QPVObserver().design(getattr(ob.plants, name)())


def test_the_region_holds_every_declared_value(observer):
    """Attained at the corners. Mutant: an ellipsoid that the box circumscribes."""
    region, plant = observer.certificate.design.region, vessel()
    box = np.vstack([plant.box("x"), plant.box("f")])
    corners = np.array(list(itertools.product(*box.tolist())))
    assert region.value(corners) == pytest.approx(1.0)
    assert region.c.tolist() == [5.0, 0.0]


def test_the_defaults_are_options_that_could_be_given(observer):
    """Mutants: a rate of 1 for alpha_q; first errors of the whole ranges."""
    region = ob.Ellipsoid([2 * 2.0**2, 2 * 0.3**2], [5.0, 0.0])
    spelt = ob.QPVObserver(
        region=region, E_x=[1.0], initial_error=[0.2, 0.0], alpha_q=0.1, Ts=0.01
    ).design(vessel())
    assert observer.half_widths == pytest.approx(spelt.half_widths, rel=1e-6)
    assert observer.performance["alpha_q"] == spelt.performance["alpha_q"]
    assert observer.half_widths[1] < 0.15 * 0.3


def test_the_sets_of_the_defaults_hold_the_truth(observer):
    """The state begins anywhere within a tenth of its half range."""
    entry = METHODS["qpv_observer"]
    still = replace(
        entry.scenario(), faults=None, x0=[5.1], guess=[5.0], x_range=[(4.9, 5.1)], f_range=None
    )
    run = simulated(replace(entry, scenario=lambda: still), observer)
    assert min(run.coverage.values()) == 1.0
    widths = 0.5 * (run.f_upper - run.f_lower)[100:, 0]
    assert np.all(widths <= observer.half_widths[1] * (1 + 1e-9))


def test_half_of_the_pairs_may_be_given():
    """With a region both or none are needed, see `test_options_that_are_not_understood`."""
    method = ob.QPVObserver(E_x=[0.5], Ts=0.01)
    model = method.read(vessel())
    assert model.apart is not None and model.noise is not None
    errors, start = model.apart
    assert errors.data.tolist() == [0.5] and np.abs(start).max() == pytest.approx(0.2)


def test_no_bound_no_rate():
    """Without bounds of the disturbances V' < w'w can be had. Mutant: alpha_q all the same."""
    plant = vessel()
    loose = ob.Plant("loose")
    (x,) = loose.states("x", range=(3, 7))
    (u,) = loose.inputs("u", range=(0, 20))
    (f,) = loose.process_faults("f", range=(-0.3, 0.3))
    (w,) = loose.disturbances("w")
    loose.dynamics([-x + f * x + u + w])
    loose.outputs([x])
    assert ob.QPVObserver().read(loose).noise is None
    assert ob.QPVObserver(norm="hinf").read(plant).noise is None
    assert ob.QPVObserver(alpha_q=0.3).read(plant).noise.rate == 0.3


def test_a_state_without_a_range_is_named():
    p = ob.Plant("open")
    x, z = p.states("x", range=(3, 7)) + p.states("z")
    (u,) = p.inputs("u", range=(0, 20))
    (f,) = p.process_faults("f", range=(-0.3, 0.3))
    p.dynamics([-x + f * x + u, x - 2 * z])
    p.outputs([x, z])
    with pytest.raises(ob.StructureError, match=r"^z has no range, .* give region=") as refusal:
        ob.QPVObserver().design(p)
    assert refusal.value.symbols == ("z",)
