"""A squirrel-cage induction motor in stator coordinates."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def induction_motor() -> Plant:
    """Return an induction motor of 2.2 kW by its inverse-Gamma model.

    With i and psi the complex space vectors of stator current and rotor flux (peak values,
    stator coordinates) and alpha = R_R / L_M:
    L_s i' = u - (R_s + R_R) i + (alpha - j n w) psi, psi' = R_R i - (alpha - j n w) psi,
    J w' = 3/2 n Im(i conj(psi)) - load.

    Returns
    -------
    Plant
        Continuous; currents i_a, i_b in A, rotor fluxes psi_a, psi_b in V s, mechanical speed
        w in rad/s, voltages u_a, u_b in V, the load torque as the unknown input tau in N m;
        currents (with the sensor faults f_a, f_b) and speed are measured. Rated: 400 V, 5 A,
        50 Hz, 14.6 N m.

    Notes
    -----
    Signals and faults are those of the induction machine of the Fault Diagnosis Toolbox, whose
    flux equations carry signs under which the flux does not turn with the rotor; the equations
    here are those of the second reference.

    References
    ----------
    Frisk, Krysander, Jung: A toolbox for analysis and design of model based diagnosis systems
    for large scale models, IFAC World Congress, 2017 (which signals, which faults).
    Slemon: Modelling of induction machines for electric drives, IEEE Trans. Industry
    Applications, 1989 (the model); Hinkkanen et al.: motulator, the 2.2-kW induction motor
    example (n = 2, R_s = 3.7, R_R = 2.1 ohm, L_s = 21 mH, L_M = 224 mH, J = 0.015 kg m^2).

    Examples
    --------
    >>> motor = induction_motor()
    >>> motor.names("x"), motor.names("f")
    (('i_a', 'i_b', 'psi_a', 'psi_b', 'w'), ('f_a', 'f_b'))
    """
    R = sp.Rational
    plant = Plant("induction motor")
    i_a, i_b = plant.states("i_a i_b", range=(-11, 11), nominal=0, unit="A")
    psi_a, psi_b = plant.states("psi_a psi_b", range=(-1.2, 1.2), nominal=0, unit="V s")
    (w,) = plant.states("w", range=(-170, 170), nominal=0, unit="rad/s")
    u = plant.inputs("u_a u_b", range=(-312, 312), nominal=0, unit="V")
    (load,) = plant.unknown_inputs("tau", range=(-22, 22), unit="N m")
    plant.sensor_faults("f_a f_b", of=["y1", "y2"], range=(-1, 1))
    (n,) = plant.params("n", 2)
    R_s, R_R = plant.params("R_s R_R", [R(37, 10), R(21, 10)], unit="ohm")
    L_s, L_M = plant.params("L_s L_M", [R(21, 1000), R(224, 1000)], unit="H")
    (J,) = plant.params("J", R(15, 1000), unit="kg m^2")
    alpha = R_R / L_M
    # real and imaginary part of (alpha - j n w) psi
    decay_a, decay_b = alpha * psi_a + n * w * psi_b, alpha * psi_b - n * w * psi_a
    plant.dynamics(
        [
            (u[0] - (R_s + R_R) * i_a + decay_a) / L_s,
            (u[1] - (R_s + R_R) * i_b + decay_b) / L_s,
            R_R * i_a - decay_a,
            R_R * i_b - decay_b,
            (R(3, 2) * n * (i_b * psi_a - i_a * psi_b) - load) / J,
        ]
    )
    plant.outputs([i_a, i_b, w], unit=["A", "A", "rad/s"])
    return plant
