"""The fault intervals of every filter, from a bank's memory."""

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.observer import Observer
from obsynth.designs.filter_bank.record import BankDesign
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def bank_intervals(
    observer: Observer, memory: ArrayLike, y: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return the fault intervals of every filter of a bank.

    Each holds the mean of the fault since the sets began, with the weights exp(-rate age); an alarm
    of any of them, zero outside of it, proves a fault. `Observer.step` decides by all of them too.

    Shapes: memory (..., n_memory), y (..., m).
    """
    if observer.method != "filter_bank":
        raise ObsynthError(
            f"the observer of the method {observer.method!r} is no bank of filters",
            method=observer.method,
        )
    design: BankDesign = observer.certificate.design
    parts, layout = np.asarray(memory, dtype=float), observer.memory_layout
    shown = np.asarray(y, dtype=float)[..., None]
    outputs, rates = design.outputs.tolist(), len(design.filters)
    places = [outputs.index(i) for i in design.fault_rows.tolist()]
    shape = (*parts.shape[:-1], len(places), rates)
    # what begins anew at its next call knows nothing yet
    N = (parts[..., layout["response"]] * (parts[..., layout["begin"]] < 0.5)).reshape(shape)
    found = []
    for noise, side in ((1, "upper"), (0, "lower")):
        ends = (shown[..., 0] - design.noise[:, noise]) / design.scale
        rest = ends[..., places][..., None] - parts[..., layout[f"filter_{side}"]].reshape(shape)
        open_end = np.full(shape, -np.inf if noise else np.inf)
        found.append(np.divide(rest, np.abs(N), out=open_end, where=N != 0.0))
    rises = design.gain[:, None] > 0.0
    return np.where(rises, found[0], -found[1]), np.where(rises, found[1], -found[0])
