"""Process engineering: a heat exchanger, a stirred tank with three reactions, tanks in a row."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def heat_exchanger() -> Plant:
    """Return a counter-flow heat exchanger of two cells a side; its outlets are measured.

    Returns
    -------
    Plant
        Continuous; hot temperatures Th1, Th2 and cold ones Tc1, Tc2 in degC, flows q_h, q_c in L/s
        that enter at 80 and 15 degC. The hot outlet Th2 and the cold one Tc1 are measured with
        noise, the second reading has the sensor fault s. Meant to be sampled every 0.2 s.

    References
    ----------
    Energy balances of ideally mixed cells; V = 5 L and UA / (rho c) = .3 L/s are numbers of this
    example.

    Examples
    --------
    >>> heat_exchanger().names("f"), heat_exchanger().output_names
    (('s',), ('y1', 'y2'))
    """
    R = sp.Rational
    plant = Plant("heat exchanger")
    h1, h2, c1, c2 = plant.states(
        "Th1 Th2 Tc1 Tc2",
        range=[(40, 90), (40, 90), (10, 60), (10, 60)],
        nominal=[70, 60, 40, 30],
        unit="degC",
    )
    q_h, q_c = plant.inputs("q_h q_c", range=(R(1, 2), 2), nominal=1, unit="L/s")
    w = plant.disturbances("w1:3", bound=R(1, 20), unit="degC")
    V, UA = 5, R(3, 10)
    plant.dynamics(
        [
            q_h / V * (80 - h1) - UA * (h1 - c1) / V,
            q_h / V * (h1 - h2) - UA * (h2 - c2) / V,
            q_c / V * (c2 - c1) + UA * (h1 - c1) / V,
            q_c / V * (15 - c2) + UA * (h2 - c2) / V,
        ]
    )
    plant.outputs([h2 + w[0], c1 + w[1]], unit="degC")
    plant.sensor_faults("s", of="y2", range=(-5, 5), rate=R(1, 100))
    return plant


def klatt_engell_reactor() -> Plant:
    """Return the stirred tank with van de Vusse's reactions and a cooling jacket, per hour.

    Returns
    -------
    Plant
        Continuous, time in hours as in the source; concentrations C_a, C_b in mol/L, temperatures
        T_R, T_K in degC, the flow F in 1/h, the cooling Q in kJ/h with an additive fault f. C_b and
        both temperatures are measured with noise. Meant to be sampled every 0.001 h.

    References
    ----------
    Klatt, Engell: Gain-scheduling trajectory control of a continuous stirred tank reactor,
    Computers and Chemical Engineering 22, 1998; with the numbers of the CSTR example of do-mpc.

    Examples
    --------
    >>> klatt_engell_reactor().rhs[3].expand().coeff(sp.Symbol("f", real=True))
    1/10
    """
    R = sp.Rational
    plant = Plant("Klatt-Engell reactor")
    C_a, C_b = plant.states(
        "C_a C_b", range=(R(1, 10), 2), nominal=[R(8, 10), R(1, 2)], unit="mol/L"
    )
    T_R, T_K = plant.states("T_R T_K", range=(100, 140), nominal=[134, 130], unit="degC")
    F, Q = plant.inputs(
        "F Q", range=[(5, 100), (-8500, 0)], nominal=[15, -2000], unit=["1/h", "kJ/h"]
    )
    plant.actuator_faults("f", of=Q, range=(-2000, 2000), rate=2000)
    w = plant.disturbances("w1:4", bound=[R(1, 100), R(1, 10), R(1, 10)])
    kelvin = T_R + R(27315, 100)
    k1 = 1287 * 10**9 * sp.exp(-R(97583, 10) / kelvin)
    k3 = 9043 * 10**6 * sp.exp(-8560 / kelvin)
    density, heat, heat_jacket = R(9342, 10000), R(301, 100), 2
    area, volume, mass, transfer = R(215, 1000), R(1001, 100), 5, 4032
    reaction = (k1 * C_a * R(42, 10) - 11 * k1 * C_b - R(4185, 100) * k3 * C_a**2) / (
        density * heat
    )
    across = transfer * area * (T_K - T_R)
    plant.dynamics(
        [
            F * (R(51, 10) - C_a) - k1 * C_a - k3 * C_a**2,
            -F * C_b + k1 * C_a - k1 * C_b,
            -reaction + F * (130 - T_R) + across / (density * heat * volume),
            (Q - across) / (mass * heat_jacket),
        ]
    )
    plant.outputs([C_b + w[0], T_R + w[1], T_K + w[2]], unit=["mol/L", "degC", "degC"])
    return plant


def tanks_in_a_row(n: int = 3) -> Plant:
    """Return n tanks that flow into each other, a pump that feeds the first one with a fault.

    h1' = v - .35 sqrt(h1), hi' = .35 (sqrt(h_(i-1)) - sqrt(hi)).

    Parameters
    ----------
    n : int
        Number of tanks; the Jacobian varies over a box of 2^n vertices.

    Returns
    -------
    Plant
        Continuous; levels h1 ... hn in cm, all measured with noise, the pump v. Meant to be sampled
        every 0.5 s.

    References
    ----------
    Torricelli's law, as in Johansson: The quadruple-tank process, IEEE Trans. Control Systems
    Technology 8, 2000; any number of tanks for what grows with it.

    Examples
    --------
    >>> tanks_in_a_row(2).rhs[1]
    7*sqrt(h1)/20 - 7*sqrt(h2)/20
    """
    R = sp.Rational
    plant = Plant(f"{n} tanks in a row")
    h = plant.states(f"h1:{n + 1}", range=(2, 20), nominal=8, unit="cm")
    (v,) = plant.inputs("v", range=(0, 2), nominal=1)
    plant.actuator_faults("f", of=v, range=(R(-1, 2), R(1, 2)), rate=R(1, 100))
    w = plant.disturbances(f"w1:{n + 1}", bound=R(1, 20), unit="cm")
    flows = [R(35, 100) * sp.sqrt(level) for level in h]
    plant.dynamics([(v if i == 0 else flows[i - 1]) - flows[i] for i in range(n)])
    plant.outputs([level + noise for level, noise in zip(h, w, strict=True)], unit="cm")
    return plant
