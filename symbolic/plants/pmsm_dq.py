"""A permanent-magnet synchronous machine in rotor coordinates."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def pmsm_dq() -> Plant:
    """Return a salient permanent-magnet synchronous machine of 2.2 kW in dq coordinates.

    L_d i_d' = u_d - R i_d + n w L_q i_q, L_q i_q' = u_q - R i_q - n w (L_d i_d + psi),
    J w' = 3/2 n (psi + (L_d - L_q) i_d) i_q - load, with peak-valued space vectors.

    Returns
    -------
    Plant
        Continuous; currents i_d, i_q in A, mechanical speed w in rad/s, voltages u_d, u_q in V
        with additive faults, the load torque as the unknown input tau in N m; currents and
        speed are measured, the currents with sensor faults. Rated: 370 V, 4.3 A, 75 Hz, 14 N m.

    References
    ----------
    Hinkkanen et al.: motulator, motor drive and grid converter simulator in Python, the 2.2-kW
    PMSM example (n = 3, R = 3.6 ohm, L_d = 36 mH, L_q = 51 mH, psi = 0.545 V s,
    J = 0.015 kg m^2).

    Examples
    --------
    >>> pmsm_dq().rhs[2].diff(sp.Symbol("tau", real=True))
    -1/J
    """
    R = sp.Rational
    plant = Plant("PMSM in dq")
    i_d, i_q = plant.states("i_d i_q", range=(-9, 9), nominal=0, unit="A")
    (w,) = plant.states("w", range=(-320, 320), nominal=147, unit="rad/s")
    u = plant.inputs("u_d u_q", range=(-312, 312), nominal=[0, 240], unit="V")
    (load,) = plant.unknown_inputs("tau", range=(-21, 21), unit="N m")
    plant.actuator_faults("f1:3", of=u, range=(-30, 30))
    plant.sensor_faults("s1:3", of=["y1", "y2"], range=(-1, 1))
    (n,) = plant.params("n", 3)
    (resistance,) = plant.params("R", R(36, 10), unit="ohm")
    L_d, L_q = plant.params("L_d L_q", [R(36, 1000), R(51, 1000)], unit="H")
    (psi,) = plant.params("psi", R(545, 1000), unit="V s")
    (J,) = plant.params("J", R(15, 1000), unit="kg m^2")
    plant.dynamics(
        [
            (u[0] - resistance * i_d + n * w * L_q * i_q) / L_d,
            (u[1] - resistance * i_q - n * w * (L_d * i_d + psi)) / L_q,
            (R(3, 2) * n * (psi + (L_d - L_q) * i_d) * i_q - load) / J,
        ]
    )
    plant.outputs([i_d, i_q, w], unit=["A", "A", "rad/s"])
    return plant
