"""The fault indicators (16)-(18) and the monitors (13) of an observer's memory."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.designs.core.observer import Observer
from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.shown import Shown

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False, repr=False)
class Indicators(Shown):
    """Which outputs and faults raise an alarm.

    s: (16): the output is outside of what a plant without fault may show
    d: (17): zero is outside of the interval of the fault
    z: (18): the output is outside of what any constant fault explains
    """

    s: Flags
    d: Flags
    z: Flags

    def __str__(self) -> str:
        count = self.S.size
        told = ((name, int(getattr(self, name).sum())) for name in "SDZ")
        return "Indicators: " + ", ".join(f"{name} at {k} of {count} instants" for name, k in told)

    @property
    def S(self) -> Flags:
        """Any of s."""
        return np.asarray(self.s.any(axis=-1))

    @property
    def D(self) -> Flags:
        """Any of d."""
        return np.asarray(self.d.any(axis=-1))

    @property
    def Z(self) -> Flags:
        """Any of z."""
        return np.asarray(self.z.any(axis=-1))


@dataclass(frozen=True, eq=False)
class Monitors:
    """Means over the window, (13), and what they tell.

    limit_m, limit_M (q,): R^-1 b, where the printed law would settle; NaN while R is singular
    excitation: smallest eigenvalue of R_m and R_M: persistent excitation keeps it positive
    weight: length of the window that is filled, in seconds
    """

    R_m: FloatArray
    R_M: FloatArray
    b_m: FloatArray
    b_M: FloatArray
    limit_m: FloatArray
    limit_M: FloatArray
    excitation: float
    weight: float


def fault_indicators(
    observer: Observer,
    memory: ArrayLike,
    y: ArrayLike,
    form: Literal["corrected", "printed"] = "corrected",
) -> Indicators:
    """Evaluate the tests (16)-(18) for one memory or many.

    Parameters
    ----------
    observer : Observer
        Made by `SetAdaptiveObserver`.
    memory : array_like, shape (..., n_memory)
        As `Observer.step` takes and returns it.
    y : array_like, shape (..., m)
        The outputs of the same instants.
    form : {"corrected", "printed"}
        (17) as printed takes the upper bound of the fault for the lower one.

    Returns
    -------
    Indicators
        Flags `s`, `d`, `z` per output and fault, and any of them as `S`, `D`, `Z`.

    Raises
    ------
    ObsynthError
        An observer of another method; another form.

    References
    ----------
    Efimov, Raissi, Zolghadri: Set adaptive observers for linear parameter-varying systems:
    application to fault detection, 2014, equations (16)-(18).

    Examples
    --------
    >>> from obsynth.designs import SetAdaptiveObserver, fault_indicators
    >>> from obsynth.symbolic.plants import three_tanks
    >>> observer = SetAdaptiveObserver().design(three_tanks())
    >>> memory = observer.memory0([0.5, 0.1, 0.3])
    >>> bool(fault_indicators(observer, memory, [0.5, 0.1]).D)
    False
    >>> bool(fault_indicators(observer, memory, [0.5, 0.1], form="printed").D)
    True
    """
    design = _design(observer)
    parts = np.asarray(memory, dtype=float)
    layout = observer.memory_layout
    shown = np.asarray(y, dtype=float) - design.W2 @ design.w_centre
    low, high = shown - design.noise, shown + design.noise

    def outside(name: str) -> Flags:
        plus, minus = np.maximum(design.frame.C.T, 0.0), np.minimum(design.frame.C.T, 0.0)
        lower, upper = parts[..., layout[f"{name}_m"]], parts[..., layout[f"{name}_M"]]
        first, second = lower @ plus + upper @ minus, upper @ plus + lower @ minus
        return np.asarray((high < first) | (low > second))

    first, second = parts[..., layout["theta_m"]], parts[..., layout["theta_M"]]
    if form == "corrected":
        first, second = np.minimum(first, second), np.maximum(first, second)
    elif form != "printed":
        raise ObsynthError(f'form is {form!r}; it has to be "corrected" or "printed"')
    return Indicators(outside("zeta"), np.asarray((first > 0.0) | (second < 0.0)), outside("xi"))


def monitors(observer: Observer, memory: ArrayLike) -> Monitors:
    """Return the monitors (13) of a memory. Shapes: memory (n_memory,)."""
    design = _design(observer)
    q = len(design.Gamma)
    parts = np.asarray(memory, dtype=float)
    layout = observer.memory_layout
    weight = float(parts[layout["weight"]][0])
    if weight <= 0.0:
        raise ObsynthError("nothing has been measured yet: the monitors have no window")
    found: dict[str, FloatArray] = {}
    for o in ("m", "M"):
        R = parts[layout[f"R_{o}"]].reshape(q, q) / weight
        b = parts[layout[f"b_{o}"]] / weight
        found[f"R_{o}"], found[f"b_{o}"] = R, b
        limit = np.full(q, np.nan)
        if np.linalg.matrix_rank(R) == q:
            limit[:] = np.linalg.solve(R, b)
        found[f"limit_{o}"] = limit
    smallest = min(float(np.linalg.eigvalsh(found[f"R_{o}"])[0]) for o in ("m", "M"))
    return Monitors(**found, excitation=smallest, weight=weight)


def _design(observer: Observer) -> SetDesign:
    if observer.method != "set_adaptive_observer":
        raise ObsynthError(
            f"an observer of the method {observer.method!r} has no indicators (16)-(18)",
            method=observer.method,
        )
    design: SetDesign = observer.certificate.design
    return design
