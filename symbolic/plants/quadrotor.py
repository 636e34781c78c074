"""A quadrotor with Euler angles, four inputs and quadratic drag."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def quadrotor() -> Plant:
    """Return a rigid quadrotor with twelve states, driven by thrust and three torques.

    Newton-Euler equations with the rotation R = Rz(psi) Ry(theta) Rx(phi) from the body to the
    earth frame (z upwards): p' = v, m v' = R e3 T - m g e3 - c v|v|, Euler rates from the body
    rates, I w' = torque - w x I w.

    Returns
    -------
    Plant
        Continuous; position px, py, pz in m, velocity vx, vy, vz in m/s, roll phi, pitch theta
        and yaw psi in rad, body rates p, q, r in rad/s; thrust T in N, torques tx, ty, tz in
        N m with additive faults; a wind force of at most 0.5 N. Position, angles and rates are
        measured. Hover needs T = m g = 6.3765 N, the nominal value.

    Notes
    -----
    Mass 0.65 kg, inertia (7.5e-3, 7.5e-3, 1.3e-2) kg m^2, drag coefficient 0.1 kg/m and the
    ranges are those the speed of interval methods is compared with. The model is that of
    Bouabdallah's dissertation without hub forces and gyroscopic effects of the rotors.

    References
    ----------
    Bouabdallah: Design and control of quadrotors with application to autonomous flying, EPFL,
    2007, Chapter 2.

    Examples
    --------
    >>> plant = quadrotor()
    >>> len(plant.x), plant.names("u")
    (12, ('T', 'tx', 'ty', 'tz'))
    >>> plant.rhs[6]
    p + q*sin(phi)*tan(theta) + r*cos(phi)*tan(theta)
    """
    plant = Plant("quadrotor")
    plant.states("px py pz", range=(-5, 5), nominal=0, unit="m")
    velocity = plant.states("vx vy vz", range=(-3, 3), nominal=0, unit="m/s")
    phi, theta = plant.states("phi theta", range=(-0.7, 0.7), nominal=0, unit="rad")
    (psi,) = plant.states("psi", range=(-3.2, 3.2), nominal=0, unit="rad")
    p, q, r = plant.states("p q r", range=(-2, 2), nominal=0, unit="rad/s")
    (thrust,) = plant.inputs("T", range=(3, 10), nominal=6.3765, unit="N")
    torque = plant.inputs("tx ty tz", range=(-0.1, 0.1), nominal=0, unit="N m")
    plant.actuator_faults("f1:4", of=torque, range=(-0.05, 0.05))
    wind = plant.disturbances("w1:4", bound=0.5, unit="N")
    (mass,) = plant.params("m", sp.Rational(65, 100), unit="kg")
    inertia = [sp.Rational(75, 10**4), sp.Rational(75, 10**4), sp.Rational(13, 1000)]
    ix, iy, iz = plant.params("I_x I_y I_z", inertia, unit="kg m^2")
    (drag,) = plant.params("c", sp.Rational(1, 10), unit="kg/m")
    (g,) = plant.params("g", sp.Rational(981, 100), unit="m/s^2")
    upwards = [
        sp.cos(psi) * sp.sin(theta) * sp.cos(phi) + sp.sin(psi) * sp.sin(phi),
        sp.sin(psi) * sp.sin(theta) * sp.cos(phi) - sp.cos(psi) * sp.sin(phi),
        sp.cos(theta) * sp.cos(phi),
    ]
    turning = q * sp.sin(phi) + r * sp.cos(phi)
    acceleration = [
        (direction * thrust - drag * v * sp.Abs(v) + force) / mass
        for direction, v, force in zip(upwards, velocity, wind, strict=True)
    ]
    acceleration[2] -= g
    plant.dynamics(
        [
            *velocity,
            *acceleration,
            p + q * sp.sin(phi) * sp.tan(theta) + r * sp.cos(phi) * sp.tan(theta),
            q * sp.cos(phi) - r * sp.sin(phi),
            turning / sp.cos(theta),
            ((iy - iz) * q * r + torque[0]) / ix,
            ((iz - ix) * p * r + torque[1]) / iy,
            ((ix - iy) * p * q + torque[2]) / iz,
        ]
    )
    names = ["px", "py", "pz", "phi", "theta", "psi", "p", "q", "r"]
    units = ["m"] * 3 + ["rad"] * 3 + ["rad/s"] * 3
    measured = [plant.x[k].symbol for k in (0, 1, 2, 6, 7, 8, 9, 10, 11)]
    plant.outputs(measured, names=[f"y_{name}" for name in names], unit=units)
    return plant
