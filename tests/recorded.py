"""Runs of the methods' scenarios as records, with readings that are missing."""

import numpy as np

import obsynth as ob
from methods import METHODS, observer_of, run_of


def measured(name, count=40):
    """The first instants of a method's run as a record, one reading and one instant missing."""
    run = run_of(name)
    y, known = run.y[:count].copy(), [s.measured for s in observer_of(name).model.rho]
    y[7, -1], y[20] = np.nan, np.nan
    names = {key: run.names[key] for key in ("u", "y")}
    names["rho"] = tuple(np.array(run.names["rho"], dtype=object)[known])
    return ob.Record(
        time=run.t[:count],
        u=run.u[:count],
        y=y,
        reference=np.zeros((count, 0)),
        rho=run.rho[:count, known],
        names=names,
        units={key: ("",) * len(value) for key, value in names.items()},
        source="a run",
    )


def start_of(name):
    scenario = METHODS[name].scenario()
    declared = ob.scenarios.gentle(observer_of(name).model).f_range
    f_range = declared if scenario.f_range is None else scenario.f_range
    return {"guess": scenario.guess, "x_range": scenario.x_range, "f_range": f_range}
