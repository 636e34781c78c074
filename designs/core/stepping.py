"""What the steps of all methods share: finiteness, ranges, the status word, the names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS
from obsynth.symbolic.arrays import FloatArray

FINITE = 1e300
"""What is larger counts as no number: CasADi folds ``y == y`` to 1, so size is what tells."""


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return where the parts of a vector are, by their sizes, one behind the other."""
    layout, at = {}, 0
    for name, size in sizes.items():
        layout[name] = slice(at, at + size)
        at += size
    return layout


def clip(value: ca.SX, box: FloatArray) -> ca.SX:
    """Return the nearest point of a box of shape (n, 2); infinite ends do not bind."""
    parts = []
    for i, (low, high) in enumerate(box):
        entry = value[i]
        if np.isfinite(low):
            entry = ca.fmax(entry, low)
        if np.isfinite(high):
            entry = ca.fmin(entry, high)
        parts.append(entry)
    return ca.vertcat(*parts)


def inside(lower: ca.SX, upper: ca.SX, box: FloatArray) -> ca.SX:
    """Return 1 where the interval [lower, upper] lies in a box of shape (n, 2), else 0."""
    result = ca.SX(1)
    for i, (low, high) in enumerate(box):
        result = ca.logic_and(result, ca.logic_and(lower[i] >= low, upper[i] <= high))
    return result


def all_finite(vector: ca.SX) -> ca.SX:
    """Return 1 where every entry is a finite number, else 0."""
    result = ca.SX(1)
    for i in range(vector.numel()):
        result = ca.logic_and(result, ca.fabs(vector[i]) <= FINITE)
    return result


def finite_or(vector: ca.SX, other: ca.SX | ca.DM | Sequence[float]) -> ca.SX:
    """Return the vector with every entry that is no finite number replaced."""
    return ca.vertcat(
        *(
            ca.if_else(ca.fabs(vector[i]) <= FINITE, vector[i], other[i])
            for i in range(vector.numel())
        )
    )


def select(condition: ca.SX, then: ca.SX, otherwise: ca.SX) -> ca.SX:
    """Return one of two vectors, entry by entry, without letting infinities of the other one in."""
    return ca.vertcat(*(ca.if_else(condition, then[i], otherwise[i]) for i in range(then.numel())))


def status_word(bits: Mapping[str, ca.SX]) -> ca.SX:
    """Return the status from conditions (1 or 0) by the names of `STATUS`."""
    word = ca.SX(0)
    for name, condition in bits.items():
        word = word + STATUS[name] * condition
    return word


def make_step(inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]) -> ca.Function:
    """Return `Observer.step` with its inputs (memory, u, y[, theta]) and outputs in their order."""
    names = [name for name in ("memory", "u", "y", "theta") if name in inputs]
    return ca.Function(
        "step",
        [inputs[name] for name in names],
        [ca.densify(outputs[name]) for name in STEP_OUTPUTS],
        names,
        list(STEP_OUTPUTS),
        {"allow_duplicate_io_names": True},
    )
