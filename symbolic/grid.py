"""Stamps of rows, and the rows on the instants of a plant; missing rows and inputs."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from obsynth.symbolic.arrays import BoolArray, FloatArray
from obsynth.symbolic.columns import CLOCK, Columns
from obsynth.symbolic.errors import RecordError


def when(there: BoolArray, time: FloatArray) -> str:
    """Say at how many instants something is true, and from when on."""
    word = "instant" if there.sum() == 1 else "instants"
    return f"{there.sum()} {word} of {len(time)}, first t = {time[there.argmax()]:g} s"


def affine(columns: Columns, name: str, spec: Any) -> tuple[str, float, float]:
    """Read "column", ("column", scale) or ("column", scale, offset)."""
    label, *rest = (spec,) if isinstance(spec, str) else spec if isinstance(spec, tuple) else (0,)
    scale, offset = (*rest, *(1.0, 0.0)[len(rest) :]) if len(rest) < 3 else (np.nan, np.nan)
    numbers = all(isinstance(v, int | float) and np.isfinite(v) for v in (scale, offset))
    if not isinstance(label, str) or not numbers:
        raise columns.refuse(
            f"{name} is mapped to {spec!r}; a column, (column, scale) or (column, scale, offset) "
            "is needed",
            symbol=name,
        )
    return label, float(scale), float(offset)


def stamps(
    columns: Columns, time: Any, symbols: Sequence[str], Ts: float, notes: list[str]
) -> tuple[FloatArray, Any]:
    """Return when each row was taken (N,), in s and increasing, and the clock at 0 or None."""
    if len(columns.frame) < 2:
        raise columns.refuse(f"it has {len(columns.frame)} rows; two at least are needed")
    if time is None:
        named = [name for name in columns if name.lower() in CLOCK and name not in symbols]
        time = columns.clock or (named[0] if named else False)
    if time is False:
        notes.append(f"there is no time: rows are taken to be Ts = {Ts:g} s apart")
        return np.arange(float(len(columns.frame))) * Ts, None
    label, scale, offset = affine(columns, "time", time)
    series, start = columns.series(label), None
    try:
        t = scale * columns[label] + offset
    except RecordError:
        t, start = _dates(columns, label, series)
    bad = np.isnan(t) if np.isnan(t).any() else np.append(False, np.diff(t) <= 0)
    if bad.any():
        row = int(bad.argmax())
        what = "is missing" if np.isnan(t[row]) else f"does not increase after {t[row - 1]:.9g} s"
        raise columns.refuse(
            f"time {label!r} {what} at row {row}: sort the rows, drop those without a time of "
            "their own",
            row=row,
        )
    return t, start


def _dates(columns: Columns, label: str, series: Any) -> tuple[FloatArray, Any]:
    """Return seconds since the first row (N,), and its date; of durations the seconds and None."""
    import pandas as pd

    read, second = series, np.timedelta64(1, "s")
    if series.dtype.kind not in "Mm":
        read = pd.to_timedelta(series, errors="coerce")
        if read.isna().all():
            read = pd.to_datetime(series, errors="coerce", format="ISO8601", utc=True)
        wrong = np.flatnonzero(read.isna() & series.notna())
        if wrong.size:
            raise columns.refuse(
                f"time {label!r}, row {wrong[0]}: {series[wrong[0]]!r} is no number of seconds, no "
                "duration, and no date like 2026-01-31 12:00:00.5",
                column=label,
                row=int(wrong[0]),
            )
    if read.dtype.kind == "m":
        return (read / second).to_numpy(dtype=float), None
    read = pd.DatetimeIndex(read)
    read = read if read.tz is None else read.tz_convert("UTC").tz_localize(None)
    return ((read - read[0]) / second).to_numpy(dtype=float), read[0].to_datetime64()


def at_instants(
    columns: Columns, t: FloatArray, table: FloatArray, Ts: float, jitter: float, notes: list[str]
) -> FloatArray:
    """Return rows for all instants, NaN where the source has none; refuse what is off the grid."""
    step = float(np.median(np.diff(t)))
    if step < (1 - 2 * jitter) * Ts or step > 1.5 * Ts:
        every = f"keep every {round(Ts / step)}th row if inputs are held over Ts, "
        raise columns.refuse(
            f"rows are {step:.6g} s apart, the plant's instants Ts = {Ts:g} s: "
            f"{every if step < 0.75 * Ts else ''}discretise the plant with Ts = {step:.6g}, give "
            "resample=, or time=(column, scale) if the stamps are not in s",
            Ts=step,
        )
    at = np.rint((t - t[0]) / Ts).astype(np.int64)
    rest = t - at * Ts
    off = np.abs(rest - (rest.max() + rest.min()) / 2)
    if off.max() > jitter * Ts + 4 * np.spacing(np.abs(t).max()):
        row = int(np.abs(rest - np.median(rest)).argmax())
        raise columns.refuse(
            f"row {row}, at {t[row]:.9g} s, lies off the grid of Ts = {Ts:g} s: stamps are up to "
            f"{off.max():.3g} s off, {jitter * Ts:.3g} s are allowed. A guarantee speaks of the "
            "grid: give resample=, or a larger jitter= and bounds of noise that cover it, or "
            "time=False where only the clock drifts",
            row=row,
        )
    gaps = np.diff(at)
    if gaps.min() == 0 or at[-1] > 10 * len(t) + 1000:
        row = int(gaps.argmin() if gaps.min() == 0 else gaps.argmax()) + 1
        what = "are of one instant, drop one" if gaps.min() == 0 else "are far apart, divide there"
        raise columns.refuse(
            f"rows {row - 1} and {row}, at {t[row - 1]:.9g} s and {t[row]:.9g} s, {what} "
            f"(Ts = {Ts:g} s)",
            row=row,
        )
    if off.max() > 1e-6 * Ts:
        notes.append(
            f"stamps lie up to {off.max():.3g} s off the grid, of which the guarantee speaks: the "
            "bounds of noise have to cover what a signal moves meanwhile"
        )
    rows = np.full((at[-1] + 1, table.shape[1]), np.nan)
    rows[at] = table
    missing = ~np.isin(np.arange(len(rows)), at)
    if missing.any():
        notes.append(f"there is no row for {when(missing, t[0] + np.arange(len(rows)) * Ts)}")
    return rows


def resampled(
    t: FloatArray, table: FloatArray, known: int, Ts: float, way: str, notes: list[str]
) -> FloatArray:
    """Return rows for all instants from rows of other times; the first `known` columns are held."""
    time = t[0] + np.arange(int((t[-1] - t[0]) / Ts * (1 + 1e-12)) + 1) * Ts
    rows, slack = np.full((len(time), table.shape[1]), np.nan), 1e-9 * Ts
    last = np.searchsorted(t, time + slack, side="right") - 1
    fresh = time - t[last] <= Ts + slack
    rows[fresh, :known] = table[last[fresh], :known]
    for j in range(known, table.shape[1]):
        there = np.isfinite(table[:, j])
        at = np.concatenate([[-np.inf], t[there], [np.inf]])
        values = np.concatenate([[np.nan], table[there, j], [np.nan]])
        after = np.searchsorted(at, time - slack)
        before = np.searchsorted(at, time + slack, side="right") - 1
        to, since = at[after] - time, time - at[before]
        if way == "nearest":
            good = np.minimum(to, since) <= Ts / 2 + slack
            rows[good, j] = values[np.where(to < since, after, before)[good]]
        else:
            good = np.maximum(to, since) <= Ts + slack
            rows[good, j] = np.interp(time[good], at[1:-1], values[1:-1]) if good.any() else np.nan
    said = {
        "nearest": "readings are the nearest ones: the bounds of noise have to cover what a "
        "signal moves in Ts / 2",
        "linear": "readings are interpolated, so they were never taken: the bounds of noise have "
        "to cover how far a signal bends away from a line between rows at most 2 Ts apart",
    }
    notes.append(f"resampled: {said[way]}; inputs are those of the last row")
    moved = np.append(0, np.cumsum((np.diff(table[:, :known], axis=0) != 0).any(axis=1)))
    within = moved[np.maximum(last[1:] - 1, last[:-1])] > moved[last[:-1]]
    if within.any():
        notes.append(
            f"inputs change between instants after {when(within, time)}: the plant takes them to "
            "be held, which a guarantee assumes"
        )
    return rows


def hold_last(
    columns: Columns, name: str, column: FloatArray, time: FloatArray, hold: bool, notes: list[str]
) -> None:
    """Fill a missing input with its last value, in place, and note it."""
    missing = np.isnan(column)
    if missing[0]:
        raise columns.refuse(
            f"input {name} is missing at row 0, t = {time[0]:g} s, so the next state is unknown: "
            "start the record where the input is known",
            symbol=name,
            row=0,
        )
    if missing.any():
        held = "its last value is held, which a guarantee assumes"
        what = held if hold else "it stays missing, and observers begin anew there"
        notes.append(f"input {name} is missing at {when(missing, time)}: {what}")
        rows = np.maximum.accumulate(np.where(missing, 0, np.arange(len(column))))
        column[:] = column[rows] if hold else column
