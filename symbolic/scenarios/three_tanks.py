"""The fault scenario of the three-tank example, with the noise of the reference numbers."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.noise import bounded_noise
from obsynth.symbolic.scenario import Scenario, known_name

_NAMES = ("faults", "fault free")
_BOUND = 4.5e-3
_GAIN = 1.329e-3
_OUTLET = 1.772e-4
_PERIOD = 100.0
_TIMES = (200.0, 300.0)


def three_tanks(
    name: str = "faults",
    Ts: float = 0.01,
    end: float = 320.0,
    noise: int | None = 1,
    theta: tuple[float, float] = (8e-5, 6e-5),
) -> Scenario:
    """Return the scenario of Efimov, Raissi and Zolghadri, Section 6.

    Two level controllers follow a reference that changes every 100 s; pump 1 fails at 200 s,
    pump 2 at 300 s. The paper gives neither the range of the faults nor the noise nor the end:
    here they are [-1e-4, 1e-4], SplitMix64 noise within 4.5 mm, and `end`.

    Parameters
    ----------
    name : str
        ``"faults"`` or ``"fault free"``.
    Ts : float
        Sample time in seconds; the control is a feedback of the measured levels.
    end : float
        In seconds, a multiple of Ts.
    noise : int or None
        Seed of the measurement noise; None for exact measurements.
    theta : tuple of float
        Sizes of the two faults in m^3/s.

    Returns
    -------
    Scenario

    Raises
    ------
    PlantError
        Another name, or an end that is no multiple of Ts.

    Examples
    --------
    >>> scenario = three_tanks()
    >>> scenario.steps, scenario.faults[[19999, 20000, 30000]].tolist()
    (32000, [[0.0, 0.0], [8e-05, 0.0], [8e-05, 6e-05]])
    """
    known_name(name, _NAMES, "the three tanks have")
    steps = round(end / Ts)
    if steps < 1 or abs(steps * Ts - end) > 1e-9 * end:
        raise PlantError(f"end={end} is not a multiple of Ts={Ts}", end=end, Ts=Ts)
    time = Ts * np.arange(steps + 1)
    faults = np.zeros((steps + 1, 2))
    if name == "faults":
        for i, start in enumerate(_TIMES):
            faults[time >= start - 1e-9, i] = theta[i]
    levels = [(0.44, 0.56), (0.04, 0.16), (0.24, 0.36)]
    middle = np.array(levels).mean(axis=1)
    return Scenario(
        name=name,
        steps=steps,
        x0=middle,
        guess=middle,
        inputs=three_tanks_control(Ts),
        faults=faults,
        disturbances=(
            np.zeros((steps + 1, 2))
            if noise is None
            else bounded_noise(noise, steps, [_BOUND, _BOUND])
        ),
        x_range=np.array(levels),
        f_range=np.array([(-1e-4, 1e-4)] * 2),
    )


def three_tanks_control(Ts: float) -> Callable[[float, NDArray[np.float64]], ArrayLike]:
    """Return the two level controllers as a feedback (k, y).

    u1 = max(0, -k rho(y1 - yr1)), u2 = max(0, -k rho(y2 - yr2) + a20 rho(y2)), where the
    reference yr = (.5, .1) rises to (.535, .15) on (100, 200], (300, 400] and so on.
    """

    def law(k: float, y: NDArray[np.float64]) -> ArrayLike:
        raised = math.ceil(k * Ts / _PERIOD - 1e-9) % 2 == 0 and k > 0
        wanted = (0.535, 0.15) if raised else (0.5, 0.1)
        flows = [-_GAIN * _root(float(y[i]) - wanted[i]) for i in (0, 1)]
        flows[1] += _OUTLET * _root(float(y[1]))
        return [max(0.0, flow) for flow in flows]

    return law


def _root(z: float) -> float:
    return math.copysign(math.sqrt(abs(z)), z)
