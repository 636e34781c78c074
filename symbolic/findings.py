"""What readings show before any model: stuck, saturated, outliers, missing, and their quantum."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Finding:
    """Rows at which a channel's readings are "stuck", "saturated", an "outlier" or "missing".

    text: what was seen, what it means and what to do
    """

    kind: str
    channel: str
    rows: IntArray
    text: str

    def __str__(self) -> str:
        return self.text


def quantum(values: FloatArray) -> float:
    """Return the step of which all differences are multiples; NaN where there is none."""
    levels = np.unique(values[np.isfinite(values)])
    gaps = np.diff(levels)
    gaps = gaps[gaps > 1e-9 * np.abs(levels).max(initial=0.0)]
    if gaps.size < 5:
        return np.nan
    step = gaps.sum() / np.rint(gaps / gaps.min()).sum()
    off = np.abs(gaps - np.rint(gaps / step) * step)
    return float(step) if off.max() < 0.1 * step else np.nan


def find(name: str, y: FloatArray, time: FloatArray, inputs: FloatArray) -> Iterator[Finding]:
    """Look through the readings y (N,) of a channel, next to the inputs (N, n_u).

    A run of equal readings counts only if quantisation and standstill do not explain it: elsewhere
    noise moves the readings to and fro by more than a quantum, so that eight such moves are
    missing; or the run begins or ends with a jump that no input has; or it cuts off a motion
    through the channel's extreme value.
    """
    levels = np.unique(y[np.isfinite(y)])
    step = float(np.diff(levels).min(initial=np.ptp(levels))) if levels.size else 0.0
    spikes, moved = np.zeros(len(y), dtype=bool), np.zeros(len(y), dtype=bool)
    for u in inputs.T:
        spikes |= _outliers(u, 0.0)
        steps = np.abs(np.diff(u, prepend=u[0]))
        moved |= steps > 6 * np.nanquantile(steps, 0.9)
    odd = _outliers(y, step) & ~spikes & ~np.roll(spikes, 1)
    for k in np.flatnonzero(odd):
        yield Finding(
            "outlier",
            name,
            np.array([k]),
            f"{name} reads {y[k]:g} at instant {k} (t = {time[k]:g} s), between {y[k - 1]:g} and "
            f"{y[k + 1]:g}: far from both beside its usual differences. If it was no reading, take "
            f"it out with record.without({name!r}, {k}); else bounds of noise have to cover it",
        )
    v = np.where(odd, np.nan, y)
    for a, b, extreme, why in _runs(v, step, moved):
        what = "as this is its extreme value, the sensor was at its limit, or stuck"
        yield Finding(
            "saturated" if extreme else "stuck",
            name,
            np.arange(a, b),
            f"{name} reads {v[a]:g} at all instants {a}..{b - 1} (t = {time[a]:g} to "
            f"{time[b - 1]:g} s), {why}: {what if extreme else 'the sensor was stuck'}. These are "
            f"no readings: take them out with record.without({name!r}, slice({a}, {b}))",
        )
    rows = np.flatnonzero(np.isnan(y))
    if rows.size:
        yield Finding(
            "missing",
            name,
            rows,
            f"{name} has no reading at {rows.size} of {len(y)} instants, first {rows[0]} (t = "
            f"{time[rows[0]]:g} s): observers do without it there, and bounds are wider",
        )


def _returns(v: FloatArray) -> FloatArray:
    """Return by how much each sample is above, or below, both its neighbours (N,)."""
    d = np.diff(v)
    there = np.minimum(np.abs(d[:-1]), np.abs(d[1:]))
    return np.concatenate([[0.0], np.where(d[:-1] * d[1:] < 0, there, 0.0), [0.0]])


def _outliers(v: FloatArray, step: float) -> BoolArray:
    """Return which single samples are far from both neighbours (N,)."""
    size, found = _returns(v), np.zeros(len(v), dtype=bool)
    usual = [6 * np.quantile(size, 0.9), 6 * step]
    usual.append(3 * np.quantile(np.nan_to_num(np.abs(np.diff(v))), 0.9))
    for k in np.flatnonzero(size > max(usual)):
        near = np.concatenate([size[max(k - 10, 0) : k - 1], size[k + 2 : k + 11]])
        found[k] = size[k] > 3 * near.max(initial=0.0)
    return found


def _runs(v: FloatArray, step: float, moved: BoolArray) -> Iterator[tuple[int, int, bool, str]]:
    """Return runs of equal readings that are none: first row, row after, at an extreme, why."""
    d = np.diff(v)
    starts = np.concatenate([[0], np.flatnonzero(d != 0) + 1])
    lengths = np.diff(np.append(starts, len(v)))
    quiet = np.repeat(lengths >= 8, lengths) | np.isnan(v)
    if quiet.all():
        return
    returns, steps = _returns(v), np.abs(np.append(0.0, d))
    steps = steps[~quiet & np.isfinite(steps)]
    noisy, busy = np.mean(returns[~quiet] > 1.5 * step), np.mean(steps > 0)
    usual, noise = max(np.quantile(steps, 0.9), step), max(np.quantile(returns[~quiet], 0.9), step)
    pad = np.concatenate([np.full(3, np.nan), v, np.full(3, np.nan)])
    calm = ~np.concatenate([[False] * 3, moved, [False] * 3])
    low, high = np.nanmin(v), np.nanmax(v)
    for a, length in zip(starts[lengths >= 5], lengths[lengths >= 5], strict=True):
        b, value = a + length, v[a]
        before, after = pad[a : a + 3] - value, pad[b + 3 : b + 6] - value
        ends = [(before, calm[a + 1 : a + 4].all()), (after, calm[b + 2 : b + 4].all())]
        jumps = [
            free and abs(part.sum()) == np.abs(part).sum() and np.abs(part).min() > 6 * usual
            for part, free in ends
        ]
        extreme, w = value in (low, high), max(2, length // 4)
        inside = extreme and w <= a and b - 1 + w < len(v)
        cut = min(abs(v[a - w] - value), abs(v[b - 1 + w] - value)) if inside else 0.0
        why = ""
        if length * noisy >= 8:
            why = f"where noise moves {noisy:.0%} of the others by more than a quantum"
        elif any(jumps) and length >= 10 and length * busy >= 8:
            why = "with a jump at its end that no input has"
        elif all(free for _, free in ends) and cut > 4 * noise:
            why = "and comes and goes without slowing down"
        if why:
            yield int(a), int(b), extreme, why
