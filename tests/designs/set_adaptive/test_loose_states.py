"""A state without a declared range that enters linearly: which methods need one, and say why."""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob


def three(**declared):
    """Two measured levels, and a third that only the second one feeds."""
    p = ob.Plant("three")
    x, z = p.states("x z", range=[(0.5, 2), (0.2, 2)])
    (e,) = p.states("e", **declared)
    (u,) = p.inputs("u", range=(0, 2))
    (f,) = p.process_faults("f", range=(-0.3, 0.3), rate=0.1)
    (w,) = p.disturbances("w", bound=0.01)
    q = sp.sqrt(x) / 5
    p.dynamics([u - q - x / 5 + f, q - z / 3, z / 5 - e / 2])
    p.outputs([x + w, z + w])
    return p


@pytest.mark.parametrize(
    ("method", "reason"),
    [
        (ob.FilterBank(), r"state e has no range, and the bank begins anew .* give region="),
        (ob.SetAdaptiveObserver(), r"state e has no range, and the bounds of A x .* range= \(in"),
    ],
)
def test_who_needs_a_range_says_why_and_what_to_do(method, reason):
    """Mutant: the bank asks for finite pairs of states that it does not name."""
    with pytest.raises(ob.StructureError, match=reason) as refusal:
        method.design(three())
    assert refusal.value.symbols == ("e",)


def test_the_region_of_the_bank_stands_for_a_range():
    """The same bank as that of a plant that declares it."""
    region = [(0.5, 2), (0.2, 2), (0, 9)]
    bank = ob.FilterBank(region=region).design(three())
    declared = ob.FilterBank().design(three(range=(0, 9)))
    assert bank.certificate.valid
    assert bank.half_widths == pytest.approx(declared.half_widths)


def test_the_region_of_a_qpv_design_stands_for_a_range():
    p = ob.Plant("vessel")
    (x,) = p.states("x", range=(3, 7))
    (z,) = p.states("z")
    (u,) = p.inputs("u", range=(0, 20))
    (theta,) = p.scheduling("theta", range=(0, 1))
    (f,) = p.process_faults("f", range=(-0.3, 0.3))
    (w,) = p.disturbances("w", bound=0.01)
    p.dynamics([-(1 + theta) * x + f * x + u + w, x - 2 * z + w])
    p.outputs([x + w, z + w])
    region = ob.Ellipsoid([1.5, 9, 0.09], [5, 2.5, 0])
    method = ob.QPVObserver(
        region=region, initial_error=[0.05] * 3, E_x=[0.3] * 2, alpha_q=1.0, gain_cap=50.0, Ts=0.01
    )
    observer = method.design(p)
    assert observer.certificate.valid and np.isfinite(observer.half_widths).all()
