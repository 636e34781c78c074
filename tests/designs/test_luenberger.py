"""The example of the contract: what its claims rest on is looked at, not assumed."""

from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import luenberger.model as module
import obsynth as ob
from luenberger.method import Luenberger
from methods import two_tanks


def test_a_split_that_is_not_proved_is_not_taken(monkeypatch):
    """Mutant: without the proof of the split, "model" would still say that it is proved."""
    observer = Luenberger().design(two_tanks())
    real = module.split

    def doubtful(plant, **options):
        parts = real(plant, **options)
        return replace(parts, proof=replace(parts.proof, methods=("", *parts.proof.methods[1:])))

    monkeypatch.setattr(module, "split", doubtful)
    with pytest.raises(ob.StructureError, match="two tanks: the split is not proved"):
        Luenberger().design(two_tanks())
    with pytest.raises(ob.CertificateError) as refusal:
        observer.certificate.check()
    assert {claim.name for claim in refusal.value.failed} == {"derivation"}


def test_coefficients_that_doubles_do_not_hold_are_refused_by_name():
    """Mutant: the rounding of C left out, a third of a level would be another output."""
    plant = ob.Plant("tank")
    (h,) = plant.states("h", range=(1, 9))
    (v,) = plant.disturbances("v", bound=0.1)
    plant.dynamics([h / 2 + 2], Ts=1)
    plant.outputs([h / sp.Integer(3) + v])
    with pytest.raises(ob.StructureError, match=r"tank: .*rounded: C"):
        Luenberger().design(plant)


@pytest.mark.parametrize("horizon", [None, 60])
def test_half_widths_hold_when_a_copy_has_taken_over(horizon):
    """Mutant: `settling` stops at half of its calls."""
    observer = Luenberger(horizon=horizon).design(two_tanks())
    design, contract = observer.certificate.design, observer.certificate.contract
    N = contract.guard(design).horizon
    memory, widths = observer.memory0([9, 9]), []
    for _ in range(2 * N + 10):
        told = [np.array(part).ravel() for part in observer.step(memory, [3.0], [9.0])]
        memory = told[0]
        widths.append(0.5 * (told[4] - told[3]))
    assert np.all(np.array(widths)[N:] <= observer.half_widths)
    if horizon is None:
        assert 400 < N < 700
        assert np.all(observer.half_widths <= 1.0100001 * observer.performance["core_half_widths"])
