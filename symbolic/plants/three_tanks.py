"""Three coupled tanks with two pump faults, the example of the set adaptive observer."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def three_tanks() -> Plant:
    """Return the three-tank system of Efimov, Raissi and Zolghadri, (19).

    A pipe carries a * rho(difference of levels) with rho(z) = sign(z) sqrt(|z|). In row 2 the
    flow a32 rho(x3 - x2) comes in, so its sign is +; (19) prints a minus that (20) does not have.

    Returns
    -------
    Plant
        Continuous; levels x1, x2, x3 in m, flows u1, u2 in m^3/s with additive faults
        theta1, theta2, the levels x1 and x2 measured with noise of at most 4.5 mm. Over the
        range of the levels both differences keep their sign.

    References
    ----------
    Efimov, Raissi, Zolghadri: Set adaptive observers for linear parameter-varying systems:
    application to fault detection, J. Dynamic Systems, Measurement, and Control, 2014, the
    example of Section 6.

    Examples
    --------
    >>> plant = three_tanks()
    >>> plant.names("f"), plant.output_names
    (('theta1', 'theta2'), ('y1', 'y2'))
    >>> low, high = plant.box("x").T
    >>> bool(low[0] > high[2]), bool(low[2] > high[1])
    (True, True)
    """
    plant = Plant("three tanks")
    x = plant.states("x1:4", range=[(0.44, 0.56), (0.04, 0.16), (0.24, 0.36)], unit="m")
    u = plant.inputs("u1:3", range=(0, 1e-3), nominal=[5.8e-5, 3.5e-6], unit="m^3/s")
    plant.actuator_faults("theta1:3", of=u, range=(-2e-4, 2e-4))
    v = plant.disturbances("v1:3", bound=4.5e-3, unit="m")
    pipe, outlet = sp.Rational(1329, 10**7), sp.Rational(1772, 10**7)
    a13, a32, a20 = plant.params("a13 a32 a20", [pipe, pipe, outlet], unit="m^(5/2)/s")
    (area,) = plant.params("S_c", sp.Rational(154, 10**4), unit="m^2")
    from_1, to_2 = a13 * _rho(x[0] - x[2]), a32 * _rho(x[2] - x[1])
    plant.dynamics(
        [
            (-from_1 + u[0]) / area,
            (to_2 - a20 * _rho(x[1]) + u[1]) / area,
            (from_1 - to_2) / area,
        ]
    )
    plant.outputs([x[0] + v[0], x[1] + v[1]], unit="m")
    return plant


def _rho(z: sp.Expr) -> sp.Expr:
    return sp.sign(z) * sp.sqrt(sp.Abs(z))
