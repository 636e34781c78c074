"""Disturbances whose range is not centred on zero: what is promised, and around which value."""

import json
from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.signals import about_centre, at_centre, finite_box, noise_centre

QPV = ob.QPVObserver.CONTRACT


def vessel(low, high):
    plant = ob.Plant("vessel")
    (x,) = plant.states("x", range=(3, 7), nominal=5)
    (u,) = plant.inputs("u", range=(0, 20), nominal=7)
    (f,) = plant.process_faults("f", range=(-0.3, 0.3))
    (w,) = plant.disturbances("w", range=(low, high))
    plant.dynamics([-x + f * x + u + w / 100])
    plant.outputs([x])
    return plant


def designed(low, high, **options):
    region = ob.Ellipsoid([1.5, 0.09], [5, 0])
    method = ob.QPVObserver(
        region=region, initial_error=[0.05, 0.05], E_x=[0.3], gain_cap=50.0, Ts=0.01, **options
    )
    return method.design(vessel(low, high))


@pytest.fixture(scope="module")
def offset():
    return designed(0, 5, alpha_q=1.0)


def levels(observer, w, steps=300):
    """V at the sampling instants from e = 0, the plant and the ode integrated together."""
    h, P = 0.01, observer.gains["P"]

    def rate(z):
        x, memory = z[0], z[1:]
        moved = np.array([-x + 6.0 + w / 100])
        return np.concatenate([moved, np.array(observer.ode(memory, 6.0, [x])).ravel()])

    memory = observer.memory0([5.0], x_range=[(4.99, 5.01)], f_range=[(-0.01, 0.01)])
    z = np.concatenate([[5.0], memory])
    values = []
    for _ in range(steps):
        k1 = rate(z)
        k2 = rate(z + h / 2 * k1)
        k3 = rate(z + h / 2 * k2)
        k4 = rate(z + h * k3)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        e = np.array([z[0] - z[1], -z[2]])
        values.append(float(e @ P @ e))
    return np.array(values)


def test_the_qpv_guarantee_speaks_of_noise_about_its_middle(offset):
    """w = 0 drives the error from zero, so it is not where V decays.

    Mutant: "without disturbances" in place of the middle.
    """
    assert levels(offset, 0.0)[-1] > 1e-4
    assert levels(offset, 2.5).max() < 1e-20
    first = offset.guarantee.claims[0]
    assert first.startswith("where w = 2.5 V = e'P e decays")
    assert "where w = 2.5" in offset.certificate["decay"].statement
    assert "without disturbances" not in str(offset.guarantee)
    energy = designed(0, 5, norm="hinf")
    assert "the L2 gain from (w - 2.5) to z" in str(energy.guarantee)
    assert "|(w - 2.5)|^2" in energy.certificate["l2_gain"].statement
    assert "where w = 0 V" in designed(-5, 5).guarantee.claims[0]


@pytest.mark.parametrize(
    ("change", "claim"),
    [
        (lambda d: replace(d, reset=-d.reset), "reset"),
        (
            lambda d: replace(
                d, noise=replace(d.noise, rate=-d.noise.rate, weights=-d.noise.weights)
            ),
            "noise",
        ),
        (lambda d: replace(d, noise=None, w_centre=d.w_centre + 1.0), "model"),
    ],
)
def test_signs_of_stored_numbers_are_proved(offset, change, claim):
    """Mutants: no test of the sign of `reset`, of `rate` and `weights`; no look at `w_centre`."""
    design = change(offset.certificate.design)
    with pytest.raises(ob.CertificateError) as refusal:
        replace(offset.certificate, design=design).check()
    assert claim in {c.name for c in refusal.value.failed}


def leaking(low, high):
    plant = ob.Plant("leaking")
    (x,) = plant.states("x")
    (f,) = plant.faults("f")
    (w,) = plant.disturbances("w", range=(low, high))
    plant.dynamics([x / 2 + f + w], Ts=1)
    plant.outputs([x])
    return plant


def test_the_energy_gain_speaks_of_noise_about_its_middle():
    """A constant disturbance at its middle costs nothing, and its energy does not grow.

    Mutant: the step at w = 0, or "|w|^2" in the words.
    """
    observer = ob.HinfUIO(method="general").design(leaking(2, 3))
    scenario = ob.Scenario(
        name="quiet",
        steps=40,
        x0=[1.0],
        guess=[0.0],
        inputs=np.zeros((41, 0)),
        faults=np.full((41, 1), 0.7),
        disturbances=np.full((41, 1), 2.5),
    )
    run = ob.simulate(observer.model, observer, scenario)
    np.testing.assert_allclose(run.fhat[2:, 0], 0.7, atol=1e-9)
    text = str(observer.guarantee)
    assert "w = (w - 2.5)" in text and "fhat -> (f) where w = 2.5" in text
    assert "|(w - 2.5)|^2" in observer.certificate["lmi"].statement
    worst = ob.worst_case(observer, steps=500)
    assert 0.9 < worst.gain / worst.certified <= 1.0


def test_words_and_numbers_of_declared_ranges():
    """Mutant: a declared range beyond the size that is assumed without one is cut to it."""
    plant = ob.Plant("ranges")
    plant.states("x z v", range=[(-3e6, 5e7), None, (0, 1)])
    plant.disturbances("a b c", range=[(0, 5), None, (-3, -2)])
    centre = noise_centre(plant)
    assert about_centre(plant, centre) == "(a - 2.5, b, c + 2.5)"
    assert at_centre(plant, centre) == "a = 2.5, b = 0, c = -2.5"
    assert finite_box(plant, "x").tolist() == [[-3e6, 5e7], [-1e6, 1e6], [0, 1]]


@pytest.mark.parametrize(("low", "high"), [(-0.5, 5.0), (0.0, 5.5)])
def test_a_wider_disturbance_on_either_side_is_no_longer_covered(offset, low, high):
    """Mutants: one half of the box is not compared, or a fault with a rate is left out."""
    design = offset.certificate.design
    wider = vessel(low, high)
    claim = {c.name: c for c in QPV.claims(replace(design, plant=wider))}["noise"]
    assert not claim.holds
    moving = ob.Plant.from_dict(design.plant.to_dict())
    record = json.loads(json.dumps(moving.to_dict()))
    (fault,) = [s for s in record["signals"] if s["name"] == "f"]
    fault["rate"] = 0.1
    fast = replace(design, plant=ob.Plant.from_dict(record))
    assert not {c.name: c for c in QPV.claims(fast)}["noise"].holds
