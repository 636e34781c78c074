"""Three tanks with linear flows and six faults, an example of structural diagnosis."""

from obsynth.symbolic.plant import Plant


def three_tanks_fdt() -> Plant:
    """Return the three-tank system of the Fault Diagnosis Toolbox.

    Pressures p1..p3, flows q_i = (p_i - p_(i+1)) / R_i + fV_i between the tanks and
    q3 = p3 / R_3 + fV3 out of the last one, C_i p_i' = q_(i-1) - q_i up to the rate fT_i. The
    faults fV2, fV3 and fT3 cannot be told apart.

    Returns
    -------
    Plant
        Continuous and linear. The inflow q0 is the known input; p1 and the flow q2 are
        measured, the latter with fV2 in it. Faults: fV1..fV3 (valves), fT1..fT3 (tanks).

    References
    ----------
    Frisk, Bregon, Aslund, Krysander, Pulido, Biswas: Diagnosability analysis considering causal
    interpretations for differential constraints, IEEE Trans. Systems, Man and Cybernetics A
    42(5), 2012; the three-tank example of the toolbox, all parameters equal to 1.

    Examples
    --------
    >>> three_tanks_fdt().output[1]
    fV2 + (p2 - p3)/Rv2
    """
    plant = Plant("three tanks of the Fault Diagnosis Toolbox")
    p = plant.states("p1:4", range=(0, 6), nominal=[3, 2, 1])
    (inflow,) = plant.inputs("q0", range=(0, 3), nominal=1)
    valve = plant.faults("fV1:4", range=(-0.3, 0.3))
    tank = plant.faults("fT1:4", range=(-0.3, 0.3))
    R = plant.params("Rv1:4", 1)
    C = plant.params("CT1:4", 1)
    flow = [
        (p[0] - p[1]) / R[0] + valve[0],
        (p[1] - p[2]) / R[1] + valve[1],
        p[2] / R[2] + valve[2],
    ]
    plant.dynamics(
        [
            (inflow - flow[0]) / C[0] + tank[0],
            (flow[0] - flow[1]) / C[1] + tank[1],
            (flow[1] - flow[2]) / C[2] + tank[2],
        ]
    )
    plant.outputs([p[0], flow[1]])
    return plant
