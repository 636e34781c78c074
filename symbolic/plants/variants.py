"""Plants that are a text with options: what the options change in it."""

from pathlib import Path
from typing import Any, Literal

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.plant_file import PlantText


def text(name: str) -> str:
    """Return the text of a plant that is one, to begin one's own from."""
    return (Path(__file__).parent / f"{name}.toml").read_text(encoding="utf-8")


def _variant(name: str, changes: dict[str, Any]) -> Plant:
    """Return the plant of a text with other entries; None takes one away."""
    told = PlantText(text(name), f"{name}.toml")
    told.data = _changed(told.data, changes)
    return told.plant()


def _changed(old: Any, new: Any) -> Any:
    if not isinstance(new, dict):
        return new
    entries = old | {key: _changed(old.get(key), value) for key, value in new.items()}
    return {key: value for key, value in entries.items() if value is not None}


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
    if tyre == "pacejka":
        return _variant("bicycle", {})
    if tyre != "linear":
        raise PlantError(f"the bicycle has the tyres pacejka, linear, not {tyre!r}", tyre=tyre)
    slopes = {"x_f": None, "x_r": None, "grip_f": "p_K*slip_f", "grip_r": "p_K*slip_r"}
    shape = dict.fromkeys(("p_D", "p_C", "p_E"))
    name = "bicycle, linear tyre"
    return _variant("bicycle", {"name": name, "parameters": shape, "definitions": slopes})


def hinf_example(variant: Literal["consistent", "as_printed"] = "consistent") -> Plant:
    """Return the third-order example of Witczak, Korbicz and Jozefowicz, (48)-(50).

    The cosine of the first row is printed with the argument 12 x1, while the Jacobian (51),
    its bound (52) and the results belong to 12 x2.

    Parameters
    ----------
    variant : {"consistent", "as_printed"}
        Argument of the cosine: 12 x2, as all that follows (50) has it, or 12 x1.

    Returns
    -------
    Plant
        Discrete (Ts = 1), without units. The fault f enters x2 (L of the paper), the
        disturbances w1..w3 have finite energy and no bound. The states reach 39 in the
        paper's scenario, hence the range (-50, 50).

    Raises
    ------
    PlantError
        Another variant.

    References
    ----------
    Witczak, Korbicz, Jozefowicz: A H-infinity approach to robust fault estimation of non-linear
    discrete-time systems, Section IV.

    Examples
    --------
    >>> hinf_example().rhs[1]
    f + 3*u/5 + 2*w2/5 + 59*x1/5000 + 299*x2/1000 + 47*x3/100
    >>> hinf_example("as_printed").rhs[0].has(sp.cos(12 * sp.Symbol("x1", real=True)))
    True
    """
    angles = {"consistent": "12*x2", "as_printed": "12*x1"}
    if variant not in angles:
        raise PlantError(
            f"the H-infinity example has the variants {', '.join(angles)}, not {variant!r}",
            variant=variant,
        )
    return _variant("hinf_example", {"definitions": {"angle": angles[variant]}})


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
    values = {"a1": a1, "a3": a3, "b1": b1, "b3": b3}
    changes = {
        "process_faults": {"leak": {"rate": rate}},
        "disturbances": {"w1:4": {"bound": wx}, "w4:7": {"bound": wy}},
        "parameters": {name: sp.Rational(repr(float(v))) for name, v in values.items()},
    }
    return _variant("leaking_tanks", changes)


def van_der_pol(mu: Any = 1) -> Plant:
    """Return the forced van der Pol oscillator x1' = x2, x2' = mu (1 - x1^2) x2 - x1 + u.

    Parameters
    ----------
    mu : number or SymPy number
        Damping; 1 by default.

    Returns
    -------
    Plant
        Continuous, without units; x1 is measured, the input u has an additive fault f. The box
        (-3, 3)^2 contains the limit cycle of mu = 1; the origin is an unstable equilibrium.

    References
    ----------
    van der Pol: On relaxation oscillations, Philosophical Magazine 2(11), 1926.

    Examples
    --------
    >>> van_der_pol().rhs[1]
    f + mu*x2*(1 - x1**2) + u - x1
    """
    return _variant("van_der_pol", {"parameters": {"mu": mu}})
