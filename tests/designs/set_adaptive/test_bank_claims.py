"""The claims of the bank: every stored number that they speak of, changed one at a time."""

from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.filter_bank.claims import claims, covers, steady_half_widths
from obsynth.designs.filter_bank.model import read
from obsynth.designs.filter_bank.record import BankDesign


@pytest.fixture(scope="module")
def stored():
    observer = ob.FilterBank().design(ob.plants.three_tanks())
    return BankDesign.from_record(observer.certificate.record)


def failed(found):
    return {claim.name for claim in found if not claim.holds}


def test_nothing_fails_of_what_was_designed(stored):
    fresh = read(stored.plant, stored.region)
    assert failed(claims(stored)) == failed(covers(stored, fresh)) == set()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("filters", lambda d: -d.filters),
        ("filters", lambda d: d.filters[::-1]),
        ("gain", lambda d: -d.gain),
        ("Ts", lambda d: -d.Ts),
        ("Ts", lambda d: 0.0),
    ],
)
def test_rates_gains_and_times_have_to_be_positive_and_those_of_the_options(stored, name, value):
    """Mutants: one of the conditions left out."""
    assert failed(claims(replace(stored, **{name: value(stored)}))) == {"filters"}


def test_an_unmeasured_state_has_to_fall_with_itself(stored):
    signs = stored.signs.x.copy()
    for i in stored.hidden:
        signs[i, i] = 1
    rising = replace(stored, signs=replace(stored.signs, x=signs))
    assert failed(claims(rising)) == {"falling"}
    assert failed(covers(rising, read(stored.plant, stored.region))) == {"monotone"}


@pytest.mark.parametrize("side", [0, 1])
def test_the_stored_noise_may_be_wider_and_not_narrower(stored, side):
    """Mutants: one side, or the sign of one, not compared."""
    fresh = read(stored.plant, stored.region)
    for step, expected in ((1e-9, set()), (-1e-9, {"structure"})):
        noise = stored.noise.copy()
        noise[0, side] += step * (1 if side else -1)
        assert failed(covers(replace(stored, noise=noise), fresh)) == expected


@pytest.mark.parametrize("name", ["outputs", "scale", "fault_rows", "gain"])
def test_what_is_stored_of_the_structure_is_that_of_the_equations(stored, name):
    value = getattr(stored, name).copy()
    value.flat[0] += 1
    fresh = read(stored.plant, stored.region)
    assert "structure" in failed(covers(replace(stored, **{name: value}), fresh))


@pytest.mark.parametrize("name", ["outputs", "fault_rows"])
@pytest.mark.parametrize("number", [-1, 3])
def test_rows_that_are_no_states_are_refused(stored, name, number):
    """Mutant: only one border tested."""
    value = getattr(stored, name).copy()
    value[0] = number
    with pytest.raises(CertificateError, match=name):
        replace(stored, **{name: value}).check()


def test_a_measured_state_may_grow_by_itself():
    """Mutant: the condition of unmeasured states held against all."""
    plant = ob.Plant("growing and shown")
    a, b = plant.states("a b", range=(0, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([a + b + f, a - b])
    plant.outputs([a])
    assert read(plant, None).hidden == [1]


def test_steady_widths_do_not_depend_on_the_sign_of_a_coupling():
    """a + a^2 and its negative drive the unmeasured state alike; mutant: one end of the slopes."""
    found = []
    for sign in (1, -1):
        plant = ob.Plant("driven")
        a, b = plant.states("a b", range=[(0, 1), (-1, 1)])
        (f,) = plant.faults("f", range=(-1, 1))
        (w,) = plant.disturbances("w", bound=0.01)
        plant.dynamics([-a + b / 5 + f, -b + sign * (a + a**2)])
        plant.outputs([a + w])
        record = ob.FilterBank().design(plant).certificate.record
        widths = steady_half_widths(BankDesign.from_record(record))
        found.append(np.concatenate([part.ravel() for part in widths]))
    assert found[0] == pytest.approx(found[1], rel=1e-12)
    assert found[0][1] > 0.03


def test_what_rounding_may_do_counts_with_the_largest_states(stored):
    """In single precision it is seen. Mutants: the smallest ones, the rounding left out."""
    single = replace(stored, options={**stored.options, "precision": "single"})
    widths = 2.0 * steady_half_widths(single)[0]
    for k, i in enumerate(stored.outputs.tolist()):
        noise = np.diff(stored.noise[k])[0] / stored.scale[k]
        rounding = 4.0 * single.rounding * np.abs(stored.region[i]).max()
        assert widths[i] == pytest.approx(noise + rounding, rel=1e-8)
        assert rounding > 1e-6 * noise
