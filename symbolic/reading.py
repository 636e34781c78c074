"""`read_record`: columns of any source become a record: stamps, rows on instants, missing rows."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from obsynth.symbolic.arrays import BoolArray, FloatArray
from obsynth.symbolic.columns import CLOCK, Columns, close, read_columns
from obsynth.symbolic.errors import RecordError
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.record import Record

Spec = str | tuple[Any, ...] | Callable[[Columns], Any] | None


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


def read_record(
    source: Any,
    plant: Plant,
    map: Mapping[str, Spec] | None = None,
    time: str | tuple[Any, ...] | Literal[False] | None = None,
    *,
    jitter: float = 0.05,
    resample: Literal["nearest", "linear"] | None = None,
    hold: bool = True,
    reference: Sequence[str] | Mapping[str, Spec] | None = None,
) -> Record:
    """Read measured inputs and outputs of a discrete plant.

    Parameters
    ----------
    source : DataFrame, Dataset, mapping, structured array, or path
        Named columns of pandas, xarray or NumPy, or a CSV or Parquet file; rows in order of time,
        empty cells and NaN where samples are missing.
    plant : Plant
        Says which inputs, measured scheduling and outputs there are, in which units, and Ts.
    map : mapping of the plant's symbols, optional
        To a column; to ``(column, scale, offset)``, for scale * column + offset; to a function of
        the columns (arrays by name); or to None for an output that was not measured. By default
        to the column of the same name.
    time : str, tuple or False, optional
        Column of the time in s, ``(column, scale)`` for other units; also of dates or durations.
        By default the index or a column ``t`` or ``time``; False: rows are Ts apart.
    jitter : float
        How far stamps may lie off the plant's grid, as a share of Ts, less than .25.
    resample : {"nearest", "linear"}, optional
        Bring rows of other times to the grid: readings are the nearest ones, at most Ts / 2 away,
        or interpolated between rows at most Ts away; inputs are those of the last row.
    hold : bool
        Whether a missing input takes its last value; observers begin anew where it stays missing.
    reference : names of columns, or mapping like `map`, optional
        Channels that no observer reads, for comparison; by default all other columns of numbers.

    Returns
    -------
    Record
        A row for every instant of the grid; ``notes`` say what was seen and assumed.

    Raises
    ------
    RecordError
        Names the source, the column and the row, and what to do.

    Examples
    --------
    >>> from obsynth import plants
    >>> log = {"v": [0, 0, 1, 1], "level": [12, 14, None, 20], "place": [0.1, 0.2, 0.4, 0.5]}
    >>> names = {"u": "v", "y1": ("level", 0.1), "y2": "place"}
    >>> record = read_record(log, plants.interval_example(), names)
    >>> record["y1"], record.notes[-1]
    (array([1.2, 1.4, nan, 2. ]), 'there is no time: rows are taken to be Ts = 1 s apart')
    """
    if plant.check().Ts is None:
        raise RecordError(
            f"{plant.name} is continuous, and the rows of a record are instants: give "
            "plant.discretise(...) with the sample time of the record."
        )
    if not 0 <= jitter < 0.25 or resample not in (None, "nearest", "linear"):
        raise RecordError(
            f"jitter={jitter!r}, resample={resample!r}: jitter is a share of Ts from 0 to less "
            "than .25, else a row has no instant of its own; resample 'nearest' or 'linear' or None"
        )
    columns, Ts = read_columns(source), float(plant.Ts or 0.0)
    groups = {"u": plant.u, "rho": tuple(s for s in plant.rho if s.measured)}
    names = {group: tuple(s.name for s in found) for group, found in groups.items()}
    units = {group: tuple(s.unit for s in found) for group, found in groups.items()}
    names["y"], units["y"] = plant.output_names, plant.output_units
    symbols = [name for group in names.values() for name in group]
    known, given = len(symbols) - len(names["y"]), dict(map or {})
    for name in given:
        if name not in symbols:
            raise columns.refuse(
                f"map= names {name!r}, which is no input, measured scheduling or output of "
                f"{plant.name!r}{close(name, symbols)}. Channels for comparison go into reference=",
                symbol=name,
            )
    notes: list[str] = []
    unit = dict(zip(symbols, (u for group in units.values() for u in group), strict=True))
    table = [
        _channel(columns, name, given.get(name, name), unit[name], notes, output=j >= known)
        for j, name in enumerate(symbols)
    ]
    t, start = stamps(columns, time, symbols, Ts, notes)
    others = _references(columns, reference, symbols, notes)
    names["reference"] = tuple(others)
    units["reference"] = tuple(columns.units.get(name, "") for name in others)
    filled = np.column_stack([*table, *others.values()])
    if resample is None:
        rows = at_instants(columns, t, filled, Ts, jitter, notes)
    else:
        rows = resampled(t, filled, known, Ts, resample, notes)
    grid = t[0] + np.arange(len(rows)) * Ts
    scheduling = [(s.lower, s.upper) for s in groups["rho"]]
    ranges = np.vstack([plant.box("u"), np.reshape(scheduling, (-1, 2)), plant.output_ranges])
    for j, (name, (lower, upper)) in enumerate(zip(symbols, ranges, strict=True)):
        column = rows[:, j]
        if j < known:
            hold_last(columns, name, column, grid, hold, notes)
        out = (column < lower) | (column > upper)
        if out.any():
            word = "its declared range" if j < known else "what its sensor is declared to show"
            ends = f"[{np.nanmin(column):g}, {np.nanmax(column):g}]"
            notes.append(
                f"{name} runs over {ends} and leaves {word}, [{lower:g}, {upper:g}], at "
                f"{when(out, grid)}"
            )
    parts = np.split(rows, np.cumsum([len(names[group]) for group in ("u", "rho", "y")]), axis=1)
    u, rho, y, rest = parts
    return Record(grid, u, y, rest, names, units, columns.source, rho, tuple(notes), start)


def _channel(
    columns: Columns, name: str, spec: Spec, unit: str, notes: list[str], *, output: bool
) -> FloatArray:
    """Return the values of a symbol (N,), and note what was made of which column."""
    count = len(columns.frame)
    if spec is None and output:
        notes.append(f"{name} was not measured")
        return np.full(count, np.nan)
    if callable(spec):
        notes.append(f"{name} is a function of the columns")
        values = np.asarray(spec(columns), dtype=float)
        if values.shape not in ((), (count,)):
            raise columns.refuse(
                f"the function of {name} gives the shape {values.shape}, not {count} numbers",
                symbol=name,
            )
        return np.full(count, values)
    label, scale, offset = affine(columns, name, spec)
    if label not in columns:
        never = f", or {{{name!r}: None}} where it was not measured" if output else ""
        raise columns.refuse(
            f"{name} has no column {label!r}{close(label, columns)}. Give map={{{name!r}: its "
            f"column}}{never}",
            symbol=name,
            column=label,
        )
    shift = f" {'-' if offset < 0 else '+'} {abs(offset)!r}" if offset else ""
    if scale != 1 or offset or label != name:
        notes.append(f"{name} = {'' if scale == 1 else f'{scale!r} * '}{label}{shift}")
    shown = columns.units.get(label, "")
    if shown and unit and shown != unit and scale == 1:
        notes.append(f"{label} is in {shown}, {name} in {unit}, and no scale is given")
    return scale * columns[label] + offset


def _references(
    columns: Columns,
    wanted: Sequence[str] | Mapping[str, Spec] | None,
    symbols: Sequence[str],
    notes: list[str],
) -> dict[str, FloatArray]:
    """Return the channels that no observer reads, by name."""
    found: dict[str, FloatArray] = {}
    specs = wanted if isinstance(wanted, Mapping) else {name: name for name in wanted or ()}
    for name, spec in specs.items():
        if name in symbols:
            raise columns.refuse(f"reference= names {name!r}, a symbol of the plant", symbol=name)
        found[name] = _channel(columns, name, spec, "", notes, output=True)
    for name in [name for name in columns if wanted is None and name not in columns.used]:
        try:
            found[name if name not in symbols else f"column {name}"] = columns[name]
        except RecordError as error:
            notes.append(f"column {name!r} is left out: row {error.row} is no number")
    return found
