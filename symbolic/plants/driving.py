"""Vehicles: cruise control, a vertical take-off aircraft in its plane, the kinematic bicycle."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def cruise_control() -> Plant:
    """Return a car in fourth gear whose throttle has a fault.

    m v' = alpha T(alpha v) u - m g C_r - rho C_d A v^2 / 2 with the torque curve
    T(w) = T_m (1 - beta (w / w_m - 1)^2).

    Returns
    -------
    Plant
        Continuous; the speed v in m/s is measured, u is the throttle in [0, 1] with the additive
        fault f, w1 an acceleration in m/s^2 (slopes, wind), w2 the noise of the reading. Meant to
        be sampled every 0.1 s.

    References
    ----------
    Astrom, Murray: Feedback Systems, cruise control; `cruise-control.py` of python-control
    (m = 1600 kg, C_r = .01, C_d = .32, A = 2.4 m^2, alpha = 12, T_m = 190 N m, w_m = 420 rad/s,
    beta = .4).

    Examples
    --------
    >>> cruise_control().names("f"), cruise_control().box("x").tolist()
    (('f',), [[5.0, 40.0]])
    """
    R = sp.Rational
    plant = Plant("cruise control")
    (v,) = plant.states("v", range=(5, 40), nominal=20, unit="m/s")
    (u,) = plant.inputs("u", range=(0, 1), nominal=R(3, 10))
    plant.actuator_faults("f", of=u, range=(R(-1, 2), R(1, 2)), rate=R(1, 20))
    w = plant.disturbances("w1 w2", bound=[R(1, 5), R(1, 20)], unit=["m/s^2", "m/s"])
    mass, ratio = 1600, 12
    torque = 190 * (1 - R(2, 5) * (ratio * v / 420 - 1) ** 2)
    rolling, drag = mass * R(98, 10) * R(1, 100), R(13, 10) * R(32, 100) * R(24, 10) / 2 * v**2
    plant.dynamics([(ratio * torque * u - rolling - drag) / mass + w[0]])
    plant.outputs([v + w[1]], unit="m/s")
    return plant


def pvtol() -> Plant:
    """Return the planar vertical take-off and landing aircraft; both forces have faults.

    m x'' = F1 cos(theta) - F2 sin(theta) - c x', J theta'' = r F1,
    m y'' = F1 sin(theta) + F2 cos(theta) - m g - c y'.

    Returns
    -------
    Plant
        Continuous; positions x, y in m, theta in rad and their rates are measured with noise, the
        forces F1 (sideways) and F2 (upwards) in N. Hovering at F2 = m g is unstable. Meant to be
        sampled every 0.02 s.

    References
    ----------
    Astrom, Murray: Feedback Systems, vectored thrust aircraft; `pvtol.py` of python-control (4 kg,
    J = .0475 kg m^2, r = .25 m, g = 9.8 m/s^2, c = .05 N s/m).

    Examples
    --------
    >>> pvtol().rhs[5]
    100*F1/19 + 100*f1/19
    """
    R = sp.Rational
    plant = Plant("pvtol")
    half = R(1, 2)
    x, y, theta, vx, vy, omega = plant.states(
        "x y theta vx vy omega",
        range=[(-10, 10), (-10, 10), (-half, half), (-5, 5), (-5, 5), (-2, 2)],
        nominal=0,
        unit=["m", "m", "rad", "m/s", "m/s", "rad/s"],
    )
    forces = plant.inputs(
        "F1 F2", range=[(-4, 4), (20, R(588, 10))], nominal=[0, R(392, 10)], unit="N"
    )
    plant.actuator_faults("f1 f2", of=forces, range=[(-1, 1), (-10, 10)], rate=[1, 5])
    bounds = [R(1, 100), R(1, 100), R(5, 1000), R(2, 100), R(2, 100), R(1, 100)]
    w = plant.disturbances("w1:7", bound=bounds)
    m, J, r, g, c = 4, R(475, 10000), R(1, 4), R(98, 10), R(5, 100)
    side, up = forces
    plant.dynamics(
        [
            vx,
            vy,
            omega,
            (side * sp.cos(theta) - up * sp.sin(theta) - c * vx) / m,
            (side * sp.sin(theta) + up * sp.cos(theta) - m * g - c * vy) / m,
            r * side / J,
        ]
    )
    plant.outputs([s + noise for s, noise in zip((x, y, theta, vx, vy, omega), w, strict=True)])
    return plant


def kinematic_bicycle() -> Plant:
    """Return a car as a bicycle without slip, the rear axle as its reference.

    x' = v cos(theta), y' = v sin(theta), theta' = v tan(delta) / L, v' = a.

    Returns
    -------
    Plant
        Continuous; x, y in m, theta in rad and v in m/s are measured with noise; the acceleration
        a in m/s^2 has an additive fault, the steering angle delta is in rad. Meant to be sampled
        every 0.05 s.

    References
    ----------
    Rajamani: Vehicle Dynamics and Control, Section 2.2, with the reference at the rear axle, where
    there is no slip angle; a wheelbase of 2.7 m.

    Examples
    --------
    >>> kinematic_bicycle().rhs[2]
    10*v*tan(delta)/27
    """
    R = sp.Rational
    plant = Plant("kinematic bicycle")
    x, y, theta, v = plant.states(
        "x y theta v",
        range=[(-50, 50), (-50, 50), (R(-3, 2), R(3, 2)), (2, 20)],
        nominal=[0, 0, 0, 10],
        unit=["m", "m", "rad", "m/s"],
    )
    a, delta = plant.inputs(
        "a delta", range=[(-3, 3), (R(-2, 5), R(2, 5))], nominal=0, unit=["m/s^2", "rad"]
    )
    plant.actuator_faults("f", of=a, range=(-1, 1), rate=R(1, 2))
    w = plant.disturbances("w1:5", bound=[R(1, 10), R(1, 10), R(1, 100), R(1, 20)])
    plant.dynamics([v * sp.cos(theta), v * sp.sin(theta), v * sp.tan(delta) / R(27, 10), a])
    plant.outputs([x + w[0], y + w[1], theta + w[2], v + w[3]])
    return plant
