"""The parameter-varying example with process faults that becomes quadratic when augmented."""

import math

import sympy as sp

from obsynth.symbolic.plant import Plant


def qpv_example() -> Plant:
    """Return the LPV example of Rotondo, Buciakowski and Witczak, Section 5.

    Fault f_i multiplies x_i in row i. The ellipsoid (18) with Q = diag(.2, .2, .2, .1, .1, .1)
    and the centre (10, 10, 10, 0, 0, 0) gives the ranges, its bounding box.

    Returns
    -------
    Plant
        Continuous, without units; scheduling theta1, theta2 in [0, 1]. One disturbance vector
        w enters the dynamics (G) and the outputs (H) and lies within 2.5, the noise of the
        paper's simulation. The nominal inputs hold (10, 10, 10) at theta = (1/2, 1/2).

    References
    ----------
    Rotondo, Buciakowski, Witczak: Simultaneous state and process fault estimation in LPV systems
    using robust QPV observers, Section 5.

    Examples
    --------
    >>> plant = qpv_example()
    >>> plant.rhs[0].diff(sp.Symbol("f1", real=True))
    x1
    >>> plant.box("rho").tolist()
    [[0.0, 1.0], [0.0, 1.0]]
    """
    R = sp.Rational
    plant = Plant("QPV example")
    reach, fault_reach = math.sqrt(0.2), math.sqrt(0.1)
    x = plant.states("x1:4", range=(10 - reach, 10 + reach), nominal=10)
    u = plant.inputs("u1:4", range=[(20, 110), (-40, 40), (0, 35)], nominal=[1945 / 34, 0, 17.5])
    t1, t2 = plant.scheduling("theta1:3", range=(0, 1))
    f = plant.faults("f1:4", range=(-fault_reach, fault_reach))
    w = plant.disturbances("w1:4", bound=2.5)
    A = sp.Matrix(
        [
            [-4 - t1, 10, 2 + 2 * t2],
            [-1, -1 - t2, R(3, 2) + 2 * t1],
            [1, 1, -4 - 3 * t1],
        ]
    )
    B = sp.Matrix([[-R(6, 5) - t1, 0, R(7, 10)], [0, R(1, 2), 0], [0, 0, 2]])
    G, H = sp.diag(R(1, 4), R(3, 20), R(1, 4)), sp.diag(R(1, 40), R(3, 200), R(1, 40))
    state = sp.Matrix(x)
    plant.dynamics((A + sp.diag(*f)) * state + B * sp.Matrix(u) + G * sp.Matrix(w))
    plant.outputs(state + H * sp.Matrix(w))
    return plant
