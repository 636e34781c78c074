"""The two fault scenarios of the quadruple-tank example."""

import numpy as np
from numpy.typing import NDArray

from obsynth.symbolic.scenario import Scenario, known_name

_NAMES = ("FS1", "FS2")


def quadruple_tank(name: str = "FS1") -> Scenario:
    """Return FS1 (pump 1 fails) or FS2 (both pumps fail) of Buciakowski et al., Section 6.

    5000 steps of 1 s, x0 = (130, 170, 30, 40) cm, guess (125, 165, 25, 35) cm, inputs
    10 + sin(k/50) and 10 + cos(k/80) V, d = 0.1, noise uniform in its declared box. The
    design may assume the initial levels within 10 cm of the guess and no initial fault.

    Parameters
    ----------
    name : str
        ``"FS1"`` or ``"FS2"``.

    Returns
    -------
    Scenario

    Raises
    ------
    PlantError
        Another name.

    Examples
    --------
    >>> quadruple_tank("FS2").faults[2000].tolist()
    [-5.0, 5.0]
    """
    known_name(name, _NAMES, "the quadruple tank has")
    steps = 5000
    k = np.arange(steps + 1, dtype=np.float64)
    profile = _profile(k)
    guess = np.array([125.0, 165.0, 25.0, 35.0])
    return Scenario(
        name=name,
        steps=steps,
        x0=np.array([130.0, 170.0, 30.0, 40.0]),
        guess=guess,
        inputs=np.column_stack([10.0 + np.sin(k / 50.0), 10.0 + np.cos(k / 80.0)]),
        faults=np.column_stack([profile, 0.0 - profile if name == "FS2" else np.zeros(steps + 1)]),
        unknown_inputs=np.full((steps + 1, 1), 0.1),
        x_range=np.column_stack([guess - 10.0, guess + 10.0]),
        f_range=np.zeros((2, 2)),
    )


def _profile(k: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return f1 of both scenarios: down to -5 V, long after up to 5 V."""
    cases = [k <= 1000, k <= 1100, k <= 3000, k <= 3200]
    values = [np.zeros_like(k), 50.0 - 0.05 * k, np.full_like(k, -5.0), 0.05 * k - 155.0]
    return np.select(cases, values, 5.0)
