"""Runs and estimates as labelled arrays, as columns, and as files."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.designs.core.files import replaced
from obsynth.designs.core.observer import MEAN_OUTPUTS
from obsynth.evaluate.errors import ReportError
from obsynth.symbolic.arrays import FloatArray

DIMENSIONS = {"x": "state", "f": "fault", "y": "output", "u": "input", "d": "unknown_input"}
DIMENSIONS |= {"w": "disturbance", "rho": "scheduling", "reference": "channel"}
CLAIMS = {"xhat": "x", "x_lower": "x", "x_upper": "x", "fhat": "f", "f_lower": "f", "f_upper": "f"}


def to_dataset(run: Any, attrs: Mapping[str, Any]) -> Any:
    """Return what a run or an estimate holds as an ``xarray.Dataset``."""
    import xarray as xr

    coords: dict[str, Any] = {"time": ("time", run.t, {"units": "s"})}
    groups = {key: key for key in DIMENSIONS if key in run.names} | CLAIMS
    for group in dict.fromkeys(groups.values()):
        dim = DIMENSIONS[group]
        coords[dim] = (dim, np.array(run.names[group], dtype=np.str_))
        coords[f"{dim}_unit"] = (dim, np.array(run.units[group], dtype=np.str_))
    data: dict[str, Any] = {
        key: (("time", DIMENSIONS[group]), getattr(run, key))
        for key, group in groups.items()
        if hasattr(run, key)
    }
    data["status"] = (("time",), run.status)
    if run.alarm is not None:
        data["alarm"] = (("time", "fault"), run.alarm)
    if run.mean_status is not None:
        data |= {key: (("time", "fault"), getattr(run, key)) for key in MEAN_OUTPUTS[:2]}
        data["mean_status"] = (("time",), run.mean_status)
    return xr.Dataset(data, coords=coords, attrs=dict(attrs))


def write_columns(path: str | os.PathLike[str], columns: Mapping[str, FloatArray]) -> Path:
    """Write columns as Parquet or CSV by the ending; an existing file is replaced when complete."""
    target = Path(path)
    if target.suffix not in (".parquet", ".csv"):
        raise ReportError(f"{str(target)!r} ends neither with .parquet nor .csv.", path=str(target))
    if not target.parent.is_dir():
        raise ReportError(f"the folder {str(target.parent)!r} does not exist.", path=str(target))
    if target.suffix == ".csv":
        import pandas as pd

        with replaced(target) as beside:
            pd.DataFrame(dict(columns)).to_csv(beside, index=False, lineterminator="\n")
        return target
    try:
        import pyarrow as pa
        from pyarrow import parquet
    except ImportError:
        raise ReportError(
            f"{target.name} needs pyarrow: pip install 'obsynth[data]', or give a name with .csv.",
            path=str(target),
        ) from None
    with replaced(target) as beside:
        parquet.write_table(pa.table({key: np.asarray(v) for key, v in columns.items()}), beside)
    return target
