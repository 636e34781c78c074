"""The Lorenz system."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def lorenz() -> Plant:
    """Return the Lorenz system with its classical parameters 10, 28 and 8/3.

    Returns
    -------
    Plant
        Continuous, without units or inputs; x is measured. The box, (-20, 20) x (-27, 27) x
        (0, 50), contains the attractor; the fixed points are the origin and
        (+-sqrt(72), +-sqrt(72), 27).

    References
    ----------
    Lorenz: Deterministic nonperiodic flow, J. Atmospheric Sciences 20(2), 1963, (25)-(27).

    Examples
    --------
    >>> lorenz().rhs.T
    Matrix([[sigma*(-x + y), rho*x - x*z - y, -beta*z + x*y]])
    """
    plant = Plant("Lorenz system")
    x, y, z = plant.states("x y z", range=[(-20, 20), (-27, 27), (0, 50)], nominal=[8, 8, 27])
    sigma, rho, beta = plant.params("sigma rho beta", [10, 28, sp.Rational(8, 3)])
    plant.dynamics([sigma * (y - x), x * rho - y - x * z, x * y - beta * z])
    plant.outputs([x])
    return plant
