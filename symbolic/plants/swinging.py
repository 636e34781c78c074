"""Mechanics that swings: a cart with a pole, a robot joint with a spring, a forced oscillator."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def cart_pole() -> Plant:
    """Return a cart with a pole that stands upright at theta = 0; the force has a fault.

    Returns
    -------
    Plant
        Continuous; the position x in m, v in m/s, theta in rad and omega in rad/s are measured with
        noise, the force F is in N. Meant to be sampled every 0.01 s.

    References
    ----------
    Barto, Sutton, Anderson: Neuronlike adaptive elements that can solve difficult learning control
    problems, IEEE Trans. SMC 13, 1983, without friction, in the form of Florian, 2007
    (M = 1 kg, m = .1 kg, l = .5 m, g = 9.81 m/s^2).

    Examples
    --------
    >>> plant = cart_pole()
    >>> plant.rhs[3].subs({s.symbol: 0 for s in (*plant.x, *plant.f)}).simplify()
    -60*F/41
    """
    R = sp.Rational
    plant = Plant("cart pole")
    x, v, theta, omega = plant.states(
        "x v theta omega",
        range=[(-1, 1), (-3, 3), (R(-1, 2), R(1, 2)), (-3, 3)],
        nominal=0,
        unit=["m", "m/s", "rad", "rad/s"],
    )
    (F,) = plant.inputs("F", range=(-10, 10), nominal=0, unit="N")
    plant.actuator_faults("f", of=F, range=(-3, 3), rate=2)
    w = plant.disturbances("w1:5", bound=[R(1, 1000), R(1, 100), R(1, 1000), R(1, 100)])
    M, m, length, g = 1, R(1, 10), R(1, 2), R(981, 100)
    sine, cosine = sp.sin(theta), sp.cos(theta)
    push = (-F - m * length * omega**2 * sine) / (M + m)
    turn = (g * sine + cosine * push) / (length * (R(4, 3) - m * cosine**2 / (M + m)))
    plant.dynamics([v, (F + m * length * (omega**2 * sine - turn * cosine)) / (M + m), omega, turn])
    plant.outputs([x + w[0], v + w[1], theta + w[2], omega + w[3]])
    return plant


def flexible_joint() -> Plant:
    """Return a link that a motor turns through a spring; only the motor is measured.

    Returns
    -------
    Plant
        Continuous; angles th_m, th_l in rad and speeds w_m, w_l in rad/s of motor and link; the
        input u has an additive fault. Meant to be sampled every 0.01 s.

    References
    ----------
    Raghavan, Hedrick: Observer design for a class of nonlinear systems, Int. J. Control 59, 1994,
    the example of Spong's model with 48.6, 1.25, 21.6, 19.5 and 3.33.

    Examples
    --------
    >>> flexible_joint().rhs[3]
    -39*th_l/2 + 39*th_m/2 - 333*sin(th_l)/100
    """
    R = sp.Rational
    plant = Plant("flexible joint robot")
    motor, w_m, link, w_l = plant.states(
        "th_m w_m th_l w_l",
        range=[(-3, 3), (-10, 10), (-3, 3), (-10, 10)],
        nominal=0,
        unit=["rad", "rad/s", "rad", "rad/s"],
    )
    (u,) = plant.inputs("u", range=(-3, 3), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=1)
    w = plant.disturbances("w1:3", bound=[R(2, 1000), R(2, 100)])
    plant.dynamics(
        [
            w_m,
            R(486, 10) * (link - motor) - R(125, 100) * w_m + R(216, 10) * u,
            w_l,
            -R(195, 10) * (link - motor) - R(333, 100) * sp.sin(link),
        ]
    )
    plant.outputs([motor + w[0], w_m + w[1]])
    return plant


def forced_oscillator() -> Plant:
    """Return a van der Pol oscillator whose position and speed are measured; its force has a fault.

    Returns
    -------
    Plant
        Continuous, without units: x' = v, v' = (1 - x^2) v - x + u + f. Meant to be sampled every
        0.01.

    References
    ----------
    van der Pol: On relaxation oscillations, Philosophical Magazine 2(11), 1926; `van_der_pol` is
    the same equation with one reading and another box.

    Examples
    --------
    >>> forced_oscillator().rhs[1]
    f + u + v*(1 - x**2) - x
    """
    R = sp.Rational
    plant = Plant("forced oscillator")
    x, v = plant.states("x v", range=[(R(-5, 2), R(5, 2)), (-4, 4)], nominal=0)
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=R(1, 2))
    w = plant.disturbances("w1:3", bound=[R(5, 1000), R(2, 100)])
    plant.dynamics([v, (1 - x**2) * v - x + u])
    plant.outputs([x + w[0], v + w[1]])
    return plant
