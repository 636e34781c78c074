"""What a plant's remainder adds to certificate and guarantee, without a design."""

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.remainder import of_continuous, prove_remainder


@pytest.fixture(scope="module")
def step():
    plant = ob.Plant("faults of all kinds")
    plant.states("x", range=(1, 2))
    plant.inputs("u", range=(0, 1))
    plant.faults("moving", range=(0, 1), rate=0.1)
    plant.faults("still", range=(0, 1), rate=0.1, constant=True)
    plant.faults("any", range=(0, 1))
    plant.disturbances("w", bound=1)
    plant.dynamics(["-x + u + moving + still + any"])
    plant.outputs(["x + w"])
    return plant.discretise("euler", 0.1, remainder=True)


def test_what_is_held_and_what_moves_is_named(step):
    """Mutants: constant faults move; faults without a rate do; the remainder is held."""
    given = Guarantee(("a",), ("b",))
    found = of_continuous(given, step)
    assert found.claims[0] == "a" and found.assumptions[0] == "b"
    assert found.claims[1].endswith("leaves out is a disturbance (remainder_x)")
    assert found.assumptions[1:] == (
        "u, w, still, any held over every step",
        "moving within range and rate at all times, between the instants too",
    )
    plain = step.continuous.discretise("euler", 0.1)
    assert of_continuous(given, plain) is given
    assert [*prove_remainder(plain)] == []


def test_a_claim_says_which_row_fails_and_by_how_much(step):
    (claim,) = prove_remainder(step)
    assert claim.holds and claim.margin == np.inf and "Taylor" in claim.proof
    data = step.to_dict()
    data["discretise"]["remainder"]["x"][1] *= 0.5
    (claim,) = prove_remainder(ob.Plant.from_dict(data))
    assert not claim.holds and claim.margin == -np.inf
    assert "left out of x" in claim.proof


def test_a_step_that_leaves_nothing_out_says_so():
    plant = ob.Plant("integrator")
    plant.states("x", range=(-1, 1))
    plant.inputs("u", range=(0, 1))
    plant.dynamics(["u"])
    plant.outputs(["x"])
    step = plant.discretise("euler", 0.1, remainder=True)
    (claim,) = prove_remainder(step)
    assert claim.holds and "nothing is left out" in claim.statement
    assert "nothing is left out" in of_continuous(Guarantee((), ()), step).claims[0]
