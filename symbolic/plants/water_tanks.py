"""Two water tanks with six faults, an example of structural diagnosis."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def water_tanks() -> Plant:
    """Return the water tanks of the Fault Diagnosis Toolbox (its reduced case).

    Water is pumped into tank 1, flows through a pipe into tank 2 and out of it; both levels
    and both flows are measured. All six faults can be told apart by structure.

    Returns
    -------
    Plant
        Continuous; levels h1, h2, the pump signal u. Faults in the order of the source: fh2
        (sensor of h2), ff1 (sensor of the flow out of tank 1), fc1 (share by which the outlet
        of tank 1 is clogged), fl2 (share leaking before tank 2), fl3 (share leaking before the
        second flow sensor), fa (actuator, an additional rate of h1).

    Notes
    -----
    The source leaves the six parameters open. Here d1 = 1/4, d2 = d3 = 1/2, d4 = 2/5 and
    d5 = d6 = 1 in cm and s, which rest at (4, 6.25) cm for u = 4 V.

    References
    ----------
    Frisk, Krysander, Jung: A toolbox for analysis and design of model based diagnosis systems
    for large scale models, IFAC World Congress, 2017; model "Water Tank Model, reduced case"
    of the Python version.

    Examples
    --------
    >>> plant = water_tanks()
    >>> plant.names("f")
    ('fh2', 'ff1', 'fc1', 'fl2', 'fl3', 'fa')
    >>> plant.output[3]
    d6*sqrt(h2)*(1 - fl3)
    """
    R = sp.Rational
    plant = Plant("water tanks")
    h1, h2 = plant.states("h1 h2", range=(1, 20), nominal=[4, 6.25], unit="cm")
    (u,) = plant.inputs("u", range=(0, 10), nominal=4, unit="V")
    plant.sensor_faults("fh2 ff1", of=["y2", "y3"], range=[(-2, 2), (-1, 1)])
    clogged, leak_2, leak_3 = plant.faults("fc1 fl2 fl3", range=(0, 0.5))
    (actuator,) = plant.faults("fa", range=(-1, 1), unit="cm/s")
    d = plant.params("d1:7", [R(1, 4), R(1, 2), R(1, 2), R(2, 5), 1, 1])
    out_1 = (1 - clogged) * sp.sqrt(h1)
    plant.dynamics(
        [
            d[0] * u - d[1] * out_1 + actuator,
            d[2] * (1 - leak_2) * out_1 - d[3] * sp.sqrt(h2),
        ]
    )
    plant.outputs([h1, h2, d[4] * out_1, d[5] * (1 - leak_3) * sp.sqrt(h2)])
    return plant
