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


class Columns(Mapping[str, FloatArray]):
    """Columns of a frame by name, (N,), read as numbers where they are asked for.

    frame: as it came, the index as a column; clock: the index, if it is a time; used: columns that
    were asked for
    """

    def __init__(self, frame: Any, source: str) -> None:
        self.source, self.units = source, frame.attrs.get("units", {})
        self.used: set[str] = set()
        index, self.clock = frame.index, None
        if index.name is not None or index.dtype.kind in "Mmf":
            name = str(index.name or "index")
            self.clock = name if index.dtype.kind in "Mmf" or name.lower() in CLOCK else None
            frame = frame.set_axis(range(len(frame)))
            if name not in frame:
                frame.insert(0, name, index)
        names = [str(name) for name in frame.columns]
        self.frame = frame.set_axis(names, axis=1).reset_index(drop=True)
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

    def __len__(self) -> int:
        return len(self.frame.columns)

    def __contains__(self, name: object) -> bool:
        return name in self.frame

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
    kind = type(source).__name__
    try:
        if hasattr(source, "data_vars"):
            frame = source.to_dataframe()
            frame.attrs["units"] = {n: v.attrs.get("units", "") for n, v in source.items()}
            if frame.index.nlevels > 1:
                raise ValueError(f"it has the dimensions {', '.join(source.dims)}, not time alone")
            timed = frame.index.name in source.coords
            return Columns(frame if timed else frame.reset_index(drop=True), kind)
        if isinstance(source, Mapping):
            columns = {name: getattr(column, "values", column) for name, column in source.items()}
            return Columns(pd.DataFrame(columns), kind)
        if getattr(getattr(source, "dtype", None), "names", None):
            return Columns(pd.DataFrame({n: source[n] for n in source.dtype.names}), kind)
    except RecordError:
        raise
    except ValueError as error:
        raise RecordError(f"record {kind!r} is no table of columns: {error}") from error
    if isinstance(source, pd.DataFrame):
        return Columns(source, kind)
    raise RecordError(
        "a record is a pandas DataFrame, an xarray Dataset, a mapping of columns, a structured "
        f"array, or the path of a CSV or Parquet file, not {kind}"
    )


def _file(path: Path) -> Any:
    """Read a file as a frame."""
    import pandas as pd

    def refuse(text: str) -> RecordError:
        return RecordError(f"record {path.name!r}: {text}", path=str(path))

    if not path.is_file():
        near = close(path.name, sorted(p.name for p in path.parent.glob("*"))).split(";")[0]
        raise refuse(f"there is no file {str(path)!r}{near}")
    end = path.suffix.lower()
    try:
        if end in (".parquet", ".pq"):
            return pd.read_parquet(path)
        if end not in (".csv", ".txt", ".tsv", ".dat"):
            raise refuse(f"files of type {end!r} are not read; give CSV, Parquet or a DataFrame")
        return _csv(path, refuse)
    except ImportError as error:
        raise refuse(
            "Parquet needs pyarrow: pip install 'obsynth[data]', or give a CSV file"
        ) from error
    except RecordError:
        raise
    except (OSError, ValueError, pd.errors.ParserWarning) as error:
        raise refuse(
            f"it cannot be read as {end.removeprefix('.').upper()}: {str(error).strip()}"
        ) from error


def _csv(path: Path, refuse: Any) -> Any:
    """Read text with a line of names; commas, tabs, or semicolons with either decimal mark."""
    import pandas as pd

    with path.open(newline="", encoding="utf-8-sig") as file:
        header, first = file.readline(), file.readline()
    mark = max(",;\t", key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=mark), [])]
    if not names or not all(any(c.isalpha() for c in name) for name in names):
        raise refuse(f"the first line has to name the columns, not {header.strip():.60}")
    with warnings.catch_warnings():
        warnings.simplefilter("error", pd.errors.ParserWarning)
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
        )
    return frame.set_axis(names, axis=1)
