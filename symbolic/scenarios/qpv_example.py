"""The fault scenarios of the parameter-varying example with process faults."""

import math
from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.scenario import Scenario, known_name

Name = Literal["FS0", "FS1", "FS2", "Fig. 7", "SC"]

_NAMES = ("FS0", "FS1", "FS2", "Fig. 7", "SC")
_NOISE = 2.5
_HOLD = 0.01


def qpv_example(
    name: Name = "FS0",
    Ts: float = 1e-3,
    duration: float = 180.0,
    hold: float | None = None,
    seed: int = 1,
) -> Scenario:
    """Return a scenario of Rotondo, Buciakowski and Witczak, Section 5.

    theta_1 = .5 + .5 sin(2 pi t / 5), theta_2 = .5 + .5 cos(2 pi t / 3); the inputs are those that
    hold (10, 10, 10) at the current theta, plus U_p = .065 times three cosines each. x(0) = (10,
    10, 10), the guess is (11, 10.5, 12), and the design may assume the initial state as far from
    the guess as it is. Inputs, faults and scheduling are functions of k = t / Ts, so that an
    integration reads them between the samples too.

    Parameters
    ----------
    name : {"FS0", "FS1", "FS2", "Fig. 7", "SC"}
        No fault; abrupt faults; slow faults that end abruptly; FS2 with U_p = 1 and ten times the
        faults; FS2 with noise held for 10 ms, which SC1 and SC2 of the paper compare for two
        gains.
    Ts : float
        Sample time in s, that of the observer's step.
    duration : float
        In s.
    hold : float, optional
        Time in s for which a draw of the noise is held; no noise by default (10 ms for "SC").
        The paper does not say it, and the effect of the noise depends on it.
    seed : int
        The noise is ``default_rng(seed).uniform(-2.5, 2.5, (3, M))`` for M = duration / hold draws.

    Returns
    -------
    Scenario

    Raises
    ------
    PlantError
        Another name, or times that are not positive or do not fit each other.

    Examples
    --------
    >>> scenario = qpv_example("FS2", Ts=0.01)
    >>> scenario.steps, [round(f, 3) for f in scenario.faults(6900)]
    (18000, [-0.095, 0.022, 0.0])
    """
    known_name(name, _NAMES, "the QPV example has")
    if not (0.0 < Ts < duration < math.inf):
        raise PlantError(
            f"Ts = {Ts} s and duration = {duration} s: a positive step shorter than the whole",
            Ts=Ts,
            duration=duration,
        )
    steps = round(duration / Ts)
    if name == "SC" and hold is None:
        hold = _HOLD
    guess = np.array([11.0, 10.5, 12.0])
    reach = np.array([1.0, 0.5, 2.0])
    large = name == "Fig. 7"
    return Scenario(
        name=name if hold is None else f"{name}, noise held {1e3 * hold:g} ms, seed {seed}",
        steps=steps,
        x0=np.full(3, 10.0),
        guess=guess,
        inputs=_inputs(Ts, 1.0 if large else 0.065),
        faults=_faults(name, Ts, 10.0 if large else 1.0),
        scheduling=lambda k: _theta(k * Ts),
        disturbances=_noise(steps, Ts, duration, hold, seed),
        x_range=np.column_stack([guess - reach, guess + reach]),
        f_range=np.zeros((3, 2)),
    )


def _theta(t: float) -> tuple[float, float]:
    return (
        0.5 + 0.5 * math.sin(2.0 * math.pi * t / 5.0),
        0.5 + 0.5 * math.cos(2.0 * math.pi * t / 3.0),
    )


def _equilibrium(t1: float, t2: float) -> tuple[float, float, float]:
    """-B(theta)^-1 A(theta) (10, 10, 10)' written out."""
    return (
        (87.0 + 0.5 * t1 + 20.0 * t2) / (1.2 + t1),
        10.0 + 20.0 * t2 - 40.0 * t1,
        10.0 + 15.0 * t1,
    )


def _inputs(Ts: float, U_p: float) -> Callable[[float], Sequence[float]]:
    """Equilibrium at the current theta, plus the perturbation."""
    turn = math.pi / 9.0

    def at(k: float) -> tuple[float, float, float]:
        t = k * Ts
        t1, t2 = _theta(t)
        waves = (
            5.0 * (math.cos(t) + math.cos(4 * t - 12 * turn) + math.cos(7 * t - 42 * turn)),
            math.cos(2 * t - 2 * turn) + math.cos(5 * t - 20 * turn) + math.cos(8 * t - 56 * turn),
            math.cos(3 * t - 6 * turn) + math.cos(6 * t - 30 * turn) + math.cos(9 * t - 72 * turn),
        )
        u1, u2, u3 = _equilibrium(t1, t2)
        return u1 + U_p * waves[0], u2 + U_p * waves[1], u3 + U_p * waves[2]

    return at


def _faults(name: str, Ts: float, factor: float) -> Callable[[float], Sequence[float]]:
    """Faults that are a constant or a ramp from its start to its end, zero elsewhere."""
    constants = ((-0.1, 100.0, 140.0), (0.2, 120.0, 160.0), (-0.05, 130.0, 175.0))
    ramps = ((-0.005, 50.0, 70.0), (0.0025, 60.0, 80.0), (-0.001, 70.0, 100.0))

    def abrupt(k: float) -> tuple[float, ...]:
        return tuple(value if on <= k * Ts <= off else 0.0 for value, on, off in constants)

    def slow(k: float) -> tuple[float, ...]:
        t = k * Ts
        return tuple(
            factor * slope * (t - on) if on <= t <= off else 0.0 for slope, on, off in ramps
        )

    if name == "FS0":
        return lambda _: (0.0, 0.0, 0.0)
    return abrupt if name == "FS1" else slow


def _noise(steps: int, Ts: float, duration: float, hold: float | None, seed: int) -> FloatArray:
    if hold is None:
        return np.zeros((steps + 1, 3))
    per = round(hold / Ts)
    if per < 1 or abs(per * Ts - hold) > 1e-9 * hold:
        raise PlantError(
            f"hold = {hold} s has to be a whole number of steps of Ts = {Ts} s", hold=hold, Ts=Ts
        )
    draws = np.random.default_rng(seed).uniform(-_NOISE, _NOISE, (3, round(duration / hold)))
    held = np.repeat(draws, per, axis=1)
    return np.asarray(np.hstack([held, held[:, -1:]])[:, : steps + 1].T)
