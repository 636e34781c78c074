"""A copy of the sets is kept until its slowest state has settled."""

import sympy as sp

import obsynth as ob


def test_a_slow_state_that_no_output_shows_is_not_begun_anew_too_early():
    """It fades by .5 % a call; mutant: prediction ends where it is cut off, at 400 calls."""
    plant = ob.Plant("slow store")
    store, flow = plant.states("store flow", range=[(-10, 10), (-5, 5)])
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    w, v = plant.disturbances("w v", bound=sp.Rational(1, 1000))
    plant.dynamics([store * sp.Rational(199, 200) + w, flow / 2 + u], Ts=1)
    plant.outputs([flow + v])
    observer = ob.SetMembershipObserver(columns=8, zonotopes=0).analyse(plant, {"L": [[0], [0.5]]})
    memory = observer.memory0([0, 0])
    for _ in range(1000):
        memory, _, _, low, high, *_ = observer.step(memory, [0], [0])
    # .07 is left of 10, and .2 of the noise
    assert float(high[0] - low[0]) < 0.7
    assert observer.certificate.design.settles > 1300
