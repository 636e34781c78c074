"""The quadruple-tank process with two pump faults and an unknown inflow to tank 3."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def quadruple_tank() -> Plant:
    """Return the quadruple tank of Buciakowski et al., equations (53)-(56).

    Levels h1..h4 in cm (60..280 and 5..100), pump voltages v1, v2 in V with additive
    faults f1, f2 (at most 0.05 V per second), an unknown inflow d that raises h3 (in
    cm/s), and the measured levels h1, h2, h3 with noise of at most 0.1 cm.

    Returns
    -------
    Plant
        Continuous. Every constant is an exact rational; gravity, which the paper leaves
        out, is 981 cm/s^2, the value its equilibrium belongs to.

    References
    ----------
    Buciakowski, Witczak, Puig, Rotondo, Nejjari, Korbicz: A bounded-error approach to
    simultaneous state and actuator fault estimation for a class of nonlinear systems,
    Section 6.

    Examples
    --------
    >>> plant = quadruple_tank()
    >>> plant.names("x"), plant.names("f"), plant.output_names
    (('h1', 'h2', 'h3', 'h4'), ('f1', 'f2'), ('y1', 'y2', 'y3'))
    """
    plant = Plant("quadruple tank")
    h = plant.states("h1:5", range=[(60, 280), (60, 280), (5, 100), (5, 100)], unit="cm")
    v = plant.inputs("v1:3", range=(0, 20), nominal=10, unit="V")
    (d,) = plant.unknown_inputs("d", unit="cm/s")
    plant.actuator_faults("f1:3", of=v, rate=0.05)
    w = plant.disturbances("w1:4", bound=0.1, unit="cm")
    small, large = sp.Rational(71, 1000), sp.Rational(51, 1000)
    a = plant.params("a1:5", [small, large, small, large], unit="cm^2")
    area = plant.params("A1:5", [28, 32, 28, 32], unit="cm^2")
    k = plant.params("k1:3", [sp.Rational(3235, 1000), sp.Rational(3320, 1000)], unit="cm^3/(V s)")
    split = plant.params("gamma1:3", [sp.Rational(565, 1000), sp.Rational(47, 100)])
    (g,) = plant.params("g", 981, unit="cm/s^2")
    flow = [a[i] * sp.sqrt(2 * g * h[i]) for i in range(4)]
    plant.dynamics(
        [
            (-flow[0] + flow[2] + split[0] * k[0] * v[0]) / area[0],
            (-flow[1] + flow[3] + split[1] * k[1] * v[1]) / area[1],
            (-flow[2] + (1 - split[1]) * k[1] * v[1]) / area[2] + d,
            (-flow[3] + (1 - split[0]) * k[0] * v[0]) / area[3],
        ]
    )
    plant.outputs([h[0] + w[0], h[1] + w[1], h[2] + w[2]], unit="cm")
    return plant
