"""Any source of a record as named columns: frames, datasets, mappings, arrays and files."""

import csv
import os
import warnings
from collections.abc import Iterable, Iterator, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import RecordError

CLOCK = ("t", "time", "timestamp", "datetime")
"""What a column of time is called where nobody says, in small letters."""


class Columns:
    """Columns of a frame by name, (N,), read as numbers where they are asked for, then `used`."""

    def __init__(self, frame: Any, source: str) -> None:
        self.source, self.units = source, frame.attrs.get("units", {})
        self.used: set[str] = set()
        clock = str(frame.index.name or "index")
        timed = frame.index.dtype.kind in "Mmf"
        self.clock = clock if timed or clock.lower() in CLOCK else None
        kept = clock not in frame and (timed or frame.index.name)
        frame = frame.rename_axis(index=clock) if kept else frame
        frame = frame.reset_index(drop=not kept)
        names = [str(name) for name in frame.columns]
        self.frame = frame.set_axis(names, axis=1)
        twice = [name for name in names if names.count(name) > 1]
        if twice:
            raise self.refuse(
                f"column {twice[0]!r} occurs {names.count(twice[0])} times; rename or drop one"
            )

    def refuse(self, text: str, **facts: Any) -> RecordError:
        """Return a refusal that names the source."""
        return RecordError(f"record {self.source!r}: {text}", source=self.source, **facts)

    def __iter__(self) -> Iterator[str]:
        return iter(self.frame.columns)

    def series(self, name: str) -> Any:
        """Return a column as it came."""
        if name not in self.frame:
            raise self.refuse(f"there is no column {name!r}{close(name, self)}", column=name)
        self.used.add(name)
        return self.frame[name]

    def __getitem__(self, name: str) -> FloatArray:
        import pandas as pd

        column = self.series(name)
        dates = column.dtype.kind in "Mmc"
        read = column.isna() / 0 if dates else pd.to_numeric(column, errors="coerce")
        found: FloatArray = read.to_numpy(dtype=float, na_value=np.nan)
        bad = np.flatnonzero(np.isinf(found) | (np.isnan(found) & column.notna()))
        if bad.size:
            row = int(bad[0])
            raise self.refuse(
                f"column {name!r}, row {row}: {column[row]!r} is no number; a missing sample is an "
                "empty cell or NaN (rows are counted from 0)",
                column=name,
                row=row,
            )
        return found


def close(name: str, known: Iterable[str]) -> str:
    """Return what there is, and what is close to a name."""
    near = get_close_matches(name, known := list(known), 1)
    return f"{f' (did you mean {near[0]!r}?)' if near else ''}; there are {', '.join(known)}"


def read_columns(source: Any) -> Columns:
    """Read a source of any kind that holds named columns."""
    import pandas as pd

    if isinstance(source, str | os.PathLike):
        path = Path(source).expanduser()
        return Columns(_file(path), path.name)
    kind, names = type(source).__name__, getattr(getattr(source, "dtype", None), "names", None)
    try:
        if hasattr(source, "data_vars"):
            units = {name: v.attrs.get("units", "") for name, v in source.items()}
            (dim,) = source.dims
            source = source.to_dataframe().reset_index(drop=dim not in source.coords)
            source = source.set_index(dim) if dim in source else source
            source.attrs["units"] = units
        elif names or isinstance(source, Mapping):
            source = {n: getattr(source[n], "values", source[n]) for n in names or source}
            source = pd.DataFrame(source)
    except ValueError as error:
        raise RecordError(f"record {kind!r} is no table of columns over time: {error}") from error
    if not isinstance(source, pd.DataFrame):
        raise RecordError(
            "a record is a pandas DataFrame, an xarray Dataset, a mapping of columns, a structured "
            f"array, or the path of a CSV or Parquet file, not {kind}"
        )
    return Columns(source, kind)


def _file(path: Path) -> Any:
    """Read a file as a frame."""
    import pandas as pd

    def refuse(text: str) -> RecordError:
        return RecordError(f"record {path.name!r}: {text}", path=str(path))

    if not path.is_file():
        near = close(path.name, sorted(p.name for p in path.parent.glob("*"))).split(";")[0]
        raise refuse(f"there is no file {str(path)!r}{near}")
    kind = path.suffix.lower()
    try:
        if kind in (".parquet", ".pq"):
            return pd.read_parquet(path)
        if kind in (".csv", ".txt", ".tsv", ".dat"):
            return _csv(path)
    except ImportError as error:
        raise refuse("Parquet needs pyarrow: pip install 'obsynth[data]', or give CSV") from error
    except (OSError, ValueError, pd.errors.ParserWarning) as error:
        raise refuse(f"it cannot be read as {kind[1:].upper()}: {str(error).strip()}") from error
    raise refuse(f"files of type {kind!r} are not read; give CSV, Parquet or a DataFrame")


def _csv(path: Path) -> Any:
    """Read text with a line of names; commas, tabs, or semicolons with either decimal mark."""
    import pandas as pd

    with path.open(encoding="utf-8-sig") as file:
        header, first = file.readline(), file.readline()
    mark = max(",;\t", key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=mark), [])]
    if not names or not all(any(c.isalpha() for c in name) for name in names):
        raise ValueError(f"the first line has to name the columns, not {header.strip():.60}")
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)
        # pandas before 3.1 reads a third of all numbers a last bit off where it is not told
        exact = "round_trip" if pd.__version__ < "3.1" else None
        frame = pd.read_csv(
            path,
            sep=mark,
            decimal="," if mark == ";" and "," in first else ".",
            names=range(len(names)),
            header=0,
            index_col=False,
            skipinitialspace=True,
            encoding="utf-8-sig",
            low_memory=False,
            float_precision=exact,
        )
    return frame.set_axis(names, axis=1)
