"""An exothermic stirred-tank reactor with three steady states."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def exothermic_cstr() -> Plant:
    """Return the jacketed reactor with the first-order exothermic reaction A -> B.

    Balances of A and of energy with the Arrhenius rate k0 exp(-E/(R T)) C_A. For the nominal
    coolant temperature of 300 K there are three steady states (C_A, T): (0.877, 324.5), stable,
    (0.500, 350.0), a saddle, and (0.209, 369.7), unstable as well and within a limit cycle.

    Returns
    -------
    Plant
        Continuous; C_A in mol/L, T and the coolant temperature T_c in K with an additive fault
        f, an unknown feed concentration d on top of 1 mol/L, and a sensor fault s of the
        measured T. The parameters are per minute as in the source, the derivatives per second.

    References
    ----------
    Seborg, Edgar, Mellichamp, Doyle: Process Dynamics and Control, Example 2.5.

    Examples
    --------
    >>> plant = exothermic_cstr()
    >>> plant.names("d"), plant.names("f")
    (('d',), ('f', 's'))
    >>> sp.diff(plant.rhs[1], plant.u[0].symbol).subs(plant.constant_values)
    25/717
    """
    R = sp.Rational
    plant = Plant("exothermic CSTR")
    (c,) = plant.states("C_A", range=(0, 1), nominal=0.5, unit="mol/L")
    (T,) = plant.states("T", range=(300, 400), nominal=350, unit="K")
    (coolant,) = plant.inputs("T_c", range=(280, 320), nominal=300, unit="K")
    (feed,) = plant.unknown_inputs("d", unit="mol/L")
    plant.actuator_faults("f", of=coolant, range=(-10, 10))
    plant.sensor_faults("s", of="y1", range=(-5, 5))
    v = plant.disturbances("v", bound=0.1, unit="K")[0]
    (q,) = plant.params("q", 100, unit="L/min")
    (V,) = plant.params("V", 100, unit="L")
    (c_feed,) = plant.params("C_Af", 1, unit="mol/L")
    (T_feed,) = plant.params("T_f", 350, unit="K")
    (k0,) = plant.params("k0", 72 * 10**9, unit="1/min")
    (E,) = plant.params("E", 8750, unit="K")
    (heat,) = plant.params("dH", -5 * 10**4, unit="J/mol")
    (capacity,) = plant.params("rho_cp", 239, unit="J/(L K)")
    (UA,) = plant.params("UA", 5 * 10**4, unit="J/(min K)")
    rate = k0 * sp.exp(-E / T) * c
    balance = [
        q / V * (c_feed + feed - c) - rate,
        q / V * (T_feed - T) - heat / capacity * rate + UA / (V * capacity) * (coolant - T),
    ]
    plant.dynamics([row * R(1, 60) for row in balance])
    plant.outputs([T + v], unit="K")
    return plant
