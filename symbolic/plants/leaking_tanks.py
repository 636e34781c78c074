"""Three tanks of a laboratory rig with a leak, identified from its record."""

import sympy as sp

from obsynth.symbolic.plant import Plant


def leaking_tanks(
    wx: float = 0.003,
    wy: float = 0.006,
    rate: float | None = None,
    *,
    a1: float = 0.024044,
    a3: float = 0.022232,
    b1: float = 0.036427,
    b3: float = 0.035121,
) -> Plant:
    """Return three tanks in a row, 1 - 2 - 3, with pumps into 1 and 3 and a leak out of 2.

    The states are differences and a level, e1 = h1 - h2, h2 and e3 = h3 - h2, so that the square
    roots sqrt(e1), sqrt(e3) are defined in the whole box. Levels are in V of the pressure sensors.

    Parameters
    ----------
    wx, wy : float
        Bounds, in V, of what moves a level in a second beside the model, and of what a reading is
        off by. Of the rig by default, about: its record needs 1.1 times as much at four instants.
    rate : float, optional
        Largest change of the leak in a second; None: it may jump.
    a1, a3, b1, b3 : float
        Of the pipes and pumps; decimals are meant as they are written.

    Returns
    -------
    Plant
        Discrete, Ts = 1 s; inputs u1, u3 are shares of the pumps' full range, `leak` is in V/s, the
        three levels are measured.

    References
    ----------
    Parameters identified from the whole record of Lejun Hu with the flow meter as the leak; least
    squares of single steps differs by 3 per cent. See `records.three_tank_leak`.

    Examples
    --------
    >>> leaking_tanks().rhs[1]
    a1*sqrt(e1) + a3*sqrt(e3) + h2 - leak + w2
    """
    plant = Plant("leaking tanks")
    span = (0.02, 0.36)
    e1, h2, e3 = plant.states(
        "e1 h2 e3", range=[span, (0, 0.6), span], nominal=[0.12, 0.1, 0.12], unit="V"
    )
    u1, u3 = plant.inputs("u1 u3", range=(0, 1), nominal=0.47)
    (leak,) = plant.faults("leak", range=(-0.05, 0.05), rate=rate, unit="V/s")
    w = plant.disturbances("w1:7", bound=[wx] * 3 + [wy] * 3, unit="V")
    values = [sp.Rational(repr(float(value))) for value in (a1, a3, b1, b3)]
    pipe_1, pipe_3, pump_1, pump_3 = plant.params("a1 a3 b1 b3", values)
    flow_1, flow_3 = pipe_1 * sp.sqrt(e1), pipe_3 * sp.sqrt(e3)
    in_1, in_3 = pump_1 * u1, pump_3 * u3
    level = [-flow_1 + in_1 + w[0], flow_1 + flow_3 - leak + w[1], -flow_3 + in_3 + w[2]]
    plant.dynamics([e1 + level[0] - level[1], h2 + level[1], e3 + level[2] - level[1]], Ts=1)
    plant.outputs([e1 + h2 + w[3], h2 + w[4], e3 + h2 + w[5]], unit="V")
    return plant
