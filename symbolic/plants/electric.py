"""Electric machines and a cell: a DC motor with friction, a synchronous motor, a battery."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def dc_motor() -> Plant:
    """Return a DC motor with smooth Stribeck friction, an unknown load and a fault of its voltage.

    L i' = V - R i - K w, J w' = K i - b w - (.02 + .01 exp(-(w/2)^2)) tanh(2 w) - load.

    Returns
    -------
    Plant
        Continuous; the current i in A and the speed w in rad/s are measured with noise, the voltage
        V is in V, the load of any size in N m. Meant to be sampled every 0.01 s.

    References
    ----------
    Control Tutorials for MATLAB and Simulink, DC motor speed (R = 1 ohm, L = .5 H, K = .01,
    J = .01 kg m^2, b = .1 N m s), with a friction of its own.

    Examples
    --------
    >>> dc_motor().rhs[0]
    2*V + 2*f - 2*i - w/50
    """
    R = sp.Rational
    plant = Plant("DC motor")
    i, w = plant.states("i w", range=[(-10, 10), (-50, 50)], nominal=0, unit=["A", "rad/s"])
    (V,) = plant.inputs("V", range=(-12, 12), nominal=0, unit="V")
    plant.actuator_faults("f", of=V, range=(-4, 4), rate=10)
    (load,) = plant.unknown_inputs("load", unit="N m")
    n = plant.disturbances("w1:3", bound=[R(2, 100), R(5, 100)], unit=["A", "rad/s"])
    resistance, L, K, J, b = 1, R(1, 2), R(1, 100), R(1, 100), R(1, 10)
    friction = (R(2, 100) + R(1, 100) * sp.exp(-((w / 2) ** 2))) * sp.tanh(w / R(1, 2))
    plant.dynamics([(V - resistance * i - K * w) / L, (K * i - b * w - friction - load) / J])
    plant.outputs([i + n[0], w + n[1]], unit=["A", "rad/s"])
    return plant


def surface_pmsm() -> Plant:
    """Return a permanent-magnet synchronous motor without saliency, in dq coordinates.

    Returns
    -------
    Plant
        Continuous; currents i_d, i_q in A and the mechanical speed w in rad/s are measured with
        noise, voltages u_d, u_q in V with a fault of u_q, a load torque of any size in N m. Meant
        to be sampled every 0.0001 s.

    References
    ----------
    Krause, Wasynczuk, Sudhoff: Analysis of Electric Machinery, the dq equations with equal
    inductances; parameters of a small servo motor (R = .3 ohm, L = 2 mH, psi = .1 V s, 4 pairs of
    poles, J = .001 kg m^2, B = .001 N m s).

    Examples
    --------
    >>> surface_pmsm().rhs[0]
    -150*i_d + 4*i_q*w + 500*u_d
    """
    R = sp.Rational
    plant = Plant("surface PMSM")
    i_d, i_q = plant.states("i_d i_q", range=(-10, 10), nominal=0, unit="A")
    (w,) = plant.states("w", range=(-300, 300), nominal=0, unit="rad/s")
    u_d, u_q = plant.inputs("u_d u_q", range=(-200, 200), nominal=0, unit="V")
    plant.actuator_faults("f", of=u_q, range=(-20, 20), rate=1000)
    (load,) = plant.unknown_inputs("T_load", unit="N m")
    n = plant.disturbances("n1:4", bound=[R(5, 100), R(5, 100), R(1, 2)])
    resistance, L, psi, pairs = R(3, 10), R(2, 1000), R(1, 10), 4
    J, B = R(1, 1000), R(1, 1000)
    plant.dynamics(
        [
            (u_d - resistance * i_d) / L + pairs * w * i_q,
            (u_q - resistance * i_q - pairs * w * psi) / L - pairs * w * i_d,
            (R(3, 2) * pairs * psi * i_q - B * w - load) / J,
        ]
    )
    plant.outputs([i_d + n[0], i_q + n[1], w + n[2]], unit=["A", "A", "rad/s"])
    return plant


def battery() -> Plant:
    """Return a lithium-ion cell with one RC pair; its voltage is a polynomial of the charge.

    soc' = -I / 7200, v1' = -v1 / (R1 C1) + I / C1; y = ocv(soc) - v1 - R0 I.

    Returns
    -------
    Plant
        Continuous; the state of charge, the voltage v1 in V over the RC pair (R1 = .015 ohm,
        C1 = 2400 F), the current I in A with an additive fault f. The terminal voltage is measured
        with noise: a nonlinear output with feedthrough of the input and the fault. Meant to be
        sampled every second.

    References
    ----------
    Plett: Battery Management Systems, Volume I, Chapter 2, the Thevenin model; a cell of 2 A h.

    Examples
    --------
    >>> battery().rhs[0]
    -I/7200 - f/7200
    """
    R = sp.Rational
    plant = Plant("battery 1RC")
    ranges = [(R(1, 10), R(95, 100)), (R(-1, 5), R(1, 5))]
    z, v1 = plant.states("soc v1", range=ranges, nominal=[R(1, 2), 0], unit=["", "V"])
    (current,) = plant.inputs("I", range=(-5, 5), nominal=0, unit="A")
    plant.actuator_faults("f", of=current, range=(-1, 1), rate=R(1, 100))
    (w,) = plant.disturbances("w", bound=R(5, 1000), unit="V")
    ocv = R(34, 10) + R(11, 10) * z - R(9, 10) * z**2 + R(6, 10) * z**3
    plant.dynamics([-current / 7200, -v1 / (R(15, 1000) * 2400) + current / 2400])
    plant.outputs([ocv - v1 - R(2, 100) * current + w], unit="V")
    return plant
