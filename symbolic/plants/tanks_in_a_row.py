"""Any number of tanks in a row."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def tanks_in_a_row(n: int = 3) -> Plant:
    """Return n tanks that flow into each other, a pump that feeds the first one with a fault.

    h1' = v - .35 sqrt(h1), hi' = .35 (sqrt(h_(i-1)) - sqrt(hi)).

    Parameters
    ----------
    n : int
        Number of tanks; the Jacobian varies over a box of 2^n vertices.

    Returns
    -------
    Plant
        Continuous; levels h1 ... hn in cm, all measured with noise, the pump v. Meant to be sampled
        every 0.5 s.

    References
    ----------
    Torricelli's law, as in Johansson: The quadruple-tank process, IEEE Trans. Control Systems
    Technology 8, 2000; any number of tanks for what grows with it.

    Examples
    --------
    >>> tanks_in_a_row(2).rhs[1]
    7*sqrt(h1)/20 - 7*sqrt(h2)/20
    """
    R = sp.Rational
    plant = Plant(f"{n} tanks in a row")
    h = plant.states(f"h1:{n + 1}", range=(2, 20), nominal=8, unit="cm")
    (v,) = plant.inputs("v", range=(0, 2), nominal=1)
    plant.actuator_faults("f", of=v, range=(R(-1, 2), R(1, 2)), rate=R(1, 100))
    w = plant.disturbances(f"w1:{n + 1}", bound=R(1, 20), unit="cm")
    flows = [R(35, 100) * sp.sqrt(level) for level in h]
    plant.dynamics([(v if i == 0 else flows[i - 1]) - flows[i] for i in range(n)])
    plant.outputs([level + noise for level, noise in zip(h, w, strict=True)], unit="cm")
    return plant
