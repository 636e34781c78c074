"""`read_record`: columns of any source become a record on the instants of a plant."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.columns import Columns, close, read_columns
from obsynth.symbolic.errors import RecordError
from obsynth.symbolic.grid import affine, at_instants, hold_last, resampled, stamps, when
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.record import Record

Spec = str | tuple[Any, ...] | Callable[[Columns], Any] | None


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
