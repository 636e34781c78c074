"""A single-track (bicycle) vehicle with a choice of tyre characteristics."""

from typing import Literal

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.plant import Plant

_TYRES = ("pacejka", "linear")


def bicycle(tyre: Literal["pacejka", "linear"] = "pacejka") -> Plant:
    """Return the single-track model of a passenger car with nonlinear tyres.

    Longitudinal speed v_x, lateral speed v_y and yaw rate r of the centre of gravity, steering
    angle delta; side forces from the slip angles
    alpha_f = delta - atan((v_y + l_f r)/v_x), alpha_r = -atan((v_y - l_r r)/v_x):
    v_x' = a + r v_y - F_f sin(delta)/m, v_y' = (F_f cos(delta) + F_r + d)/m - r v_x,
    r' = (l_f F_f cos(delta) - l_r F_r)/I_z, delta' = steering rate.

    Parameters
    ----------
    tyre : {"pacejka", "linear"}
        Side force of an axle with the load F_z: Pacejka's magic formula
        D sin(C atan(B alpha - E (B alpha - atan(B alpha)))) with D = 1.0489 F_z, C = 1.3507,
        E = -0.0074722 and the slope B C D = K = 21.92 F_z at zero; or K alpha.

    Returns
    -------
    Plant
        Continuous; inputs: longitudinal acceleration a (m/s^2) and steering rate (rad/s) with
        additive faults f1, f2; a side wind force d (N) is the unknown input. Measured are v_x,
        r and delta. Straight driving at any speed is an equilibrium.

    Raises
    ------
    PlantError
        Another tyre.

    References
    ----------
    Althoff, Wuersching: CommonRoad: Vehicle models, 2020: Tables 6 and 7, vehicle 2 (BMW 320i)
    with the tyre of the ADAMS handbook, without its shifts, load transfer and combined slip.
    Pacejka: Tire and Vehicle Dynamics, Chapter 4.

    Examples
    --------
    >>> car = bicycle()
    >>> car.names("x"), car.names("d")
    (('v_x', 'v_y', 'r', 'delta'), ('d',))
    >>> car.rhs[3]
    f2 + v_delta
    """
    if tyre not in _TYRES:
        raise PlantError(f"the bicycle has the tyres {', '.join(_TYRES)}, not {tyre!r}", tyre=tyre)
    R = sp.Rational
    plant = Plant("bicycle" if tyre == "pacejka" else f"bicycle, {tyre} tyre")
    (v_x,) = plant.states("v_x", range=(10, 30), nominal=20, unit="m/s")
    (v_y,) = plant.states("v_y", range=(-2, 2), nominal=0, unit="m/s")
    (r,) = plant.states("r", range=(-0.6, 0.6), nominal=0, unit="rad/s")
    (delta,) = plant.states("delta", range=(-0.2, 0.2), nominal=0, unit="rad")
    a, turn = plant.inputs(
        "a v_delta", range=[(-11.5, 11.5), (-0.4, 0.4)], nominal=0, unit=["m/s^2", "rad/s"]
    )
    plant.actuator_faults("f1:3", of=[a, turn], range=[(-2, 2), (-0.1, 0.1)])
    (wind,) = plant.unknown_inputs("d", range=(-2000, 2000), unit="N")
    m = plant.params("m", sp.Rational("1093.2952334674046"), unit="kg")[0]
    inertia = plant.params("I_z", sp.Rational("1791.5995300122856"), unit="kg m^2")[0]
    lengths = [sp.Rational("1.1561957064"), sp.Rational("1.4227170936")]
    l_f, l_r = plant.params("l_f l_r", lengths, unit="m")
    (g,) = plant.params("g", R(981, 100), unit="m/s^2")
    (slope,) = plant.params("p_K", R(2192, 100))
    shape: tuple[sp.Symbol, ...] = ()
    if tyre == "pacejka":
        values = [R(10489, 10**4), R(13507, 10**4), R(-74722, 10**7)]
        shape = plant.params("p_D p_C p_E", values)
    load_f, load_r = m * g * l_r / (l_f + l_r), m * g * l_f / (l_f + l_r)
    side_f = load_f * _side_force(tyre, delta - sp.atan((v_y + l_f * r) / v_x), slope, shape)
    side_r = load_r * _side_force(tyre, -sp.atan((v_y - l_r * r) / v_x), slope, shape)
    plant.dynamics(
        [
            a + r * v_y - side_f * sp.sin(delta) / m,
            (side_f * sp.cos(delta) + side_r + wind) / m - r * v_x,
            (l_f * side_f * sp.cos(delta) - l_r * side_r) / inertia,
            turn,
        ]
    )
    plant.outputs([v_x, r, delta], unit=["m/s", "rad/s", "rad"])
    return plant


def _side_force(
    tyre: str, slip: sp.Expr, slope: sp.Symbol, shape: tuple[sp.Symbol, ...]
) -> sp.Expr:
    """Side force divided by the load."""
    if tyre == "linear":
        return slope * slip
    friction, C, E = shape
    x = slope / (C * friction) * slip
    return friction * sp.sin(C * sp.atan(x - E * (x - sp.atan(x))))
