"""The parameter-varying example of the interval observer for actuator faults."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def interval_example() -> Plant:
    """Return the LPV example of Lamouchi, Raissi, Amairi and Aoun, (40).

    Returns
    -------
    Plant
        Discrete (Ts = 1), without units; rho1, rho2 in [-1, 1] are bounded but not measured.
        The fault f, in [-1, 1] in the paper, enters with F = -B; noise w1..w3 and v1, v2 of at
        most 0.01. The plant is unstable for u = 0; u = 3/2 y1 + 2 y2 keeps it within (-4, 4).

    References
    ----------
    Lamouchi, Raissi, Amairi, Aoun: Interval observer design for actuator fault estimation of
    linear parameter-varying systems, IFAC PapersOnLine 51-24, 2018, Section 5.

    Examples
    --------
    >>> interval_example().rhs[2]
    w3 + 3*x1/10 - x2/2 + x3*(rho2/20 - 1)
    """
    R = sp.Rational
    plant = Plant("interval observer example")
    x = plant.states("x1:4", range=(-4, 4), nominal=0)
    (u,) = plant.inputs("u", range=(-20, 20), nominal=0)
    rho = plant.scheduling("rho1:3", range=(-1, 1), measured=False)
    (f,) = plant.faults("f", range=(-1, 1))
    w = plant.disturbances("w1:4", bound=0.01)
    v = plant.disturbances("v1:3", bound=0.01)
    A = sp.Matrix([[-1, 1, 0], [-1, 0, 0], [0, -1, -1]])
    varying = sp.Matrix(
        [
            [rho[0] / 10, R(1, 2), R(1, 10)],
            [R(1, 10), R(1, 5), R(2, 5)],
            [R(3, 10), R(1, 2), rho[1] / 20],
        ]
    )
    enter = sp.Matrix([1, 0, 0])
    plant.dynamics((A + varying) * sp.Matrix(x) + enter * (u - f) + sp.Matrix(w), Ts=1)
    plant.outputs([x[0] + v[0], x[2] + v[1]])
    return plant
