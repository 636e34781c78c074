"""Parameters of a plant from a record: intervals for certain, values by least squares."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from scipy.sparse import block_array, csc_array, diags_array
from scipy.sparse.linalg import splu

from obsynth.evaluate.bounds.certified import narrowed
from obsynth.evaluate.bounds.problem import Problem, default_groups, pose
from obsynth.evaluate.bounds.trajectory import Search, Trajectory, guess, measured
from obsynth.evaluate.errors import BoundsError
from obsynth.symbolic import Plant, Record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

MOST_CUTS = 12
"""Times that the intervals are cut at most."""
STALLED = 0.001
"""Share of an interval below which another cut is not worth its programs."""
UNKNOWN = 1e-8
"""Information of a direction, relative to the largest, below which the record has none of it."""


@dataclass(frozen=True, eq=False, repr=False)
class Identified(Tabled):
    """What a record says of a plant's parameters.

    Parameters
    ----------
    intervals : dict of str to (float, float)
        Hold the parameters for certain if the declared ranges and bounds hold.
    values : dict of str to float
        Of the trajectory with the least squares (or absolute values) of all disturbances, each
        relative to its bound.
    deviations : dict of str to float
        Standard deviations of the values if disturbances are spread evenly in their bounds;
        infinite for those in a direction that the record says nothing of.
    directions : tuple of mappings
        What the record does not determine: relative changes of parameters that leave everything
        measured as it is, to first order.
    """

    problem: Problem = field(repr=False)
    record: Record
    intervals: dict[str, tuple[float, float]]
    values: dict[str, float]
    deviations: dict[str, float]
    directions: tuple[Mapping[str, float], ...]
    trajectory: Trajectory = field(repr=False)

    @cached_property
    def plant(self) -> Plant:
        """The plant with values, and with what their intervals make of its equations as bounds."""
        ranges = {
            name: (float(np.clip(value, *self.intervals[name])), *self.intervals[name])
            for name, value in self.values.items()
        }
        return self.problem.plant.with_params(**ranges)

    def table(self) -> Table:
        """Value, deviation and interval of every parameter."""
        rows: list[list[Any]] = [
            [name, self.values[name], self.deviations[name], *self.intervals[name]]
            for name in self.values
        ]
        said = [
            "Not determined: " + ", ".join(f"{name} by {v:+.2g}" for name, v in d.items())
            for d in self.directions
        ]
        seen = [
            f"{name} {np.nanmin(self.record[name]):.4g} to {np.nanmax(self.record[name]):.4g}"
            for name in (*self.record.names["u"], *self.record.names["y"])
        ]
        return Table(
            f"Parameters of {self.problem.plant.name}",
            ["parameter", "value", "standard deviation", "at least", "at most"],
            rows,
            note=". ".join([*said, "Seen over " + ", ".join(seen)]) + ".",
        )


@takes(plant="Plant", record="Record")
def identify(
    plant: Plant,
    record: Record,
    params: Sequence[str] | Mapping[str, tuple[float, float]],
    *,
    free: Sequence[str] | None = None,
    loss: Literal["squares", "absolute"] = "squares",
) -> Identified:
    """Return parameters of a plant from a record, as guaranteed intervals and as values.

    Parameters
    ----------
    plant : Plant
        Discrete. Its declared ranges and bounds of disturbances are taken for true: with bounds
        that are too small the intervals are empty, see `least_bounds`.
    record : Record
        NaN is no reading.
    params : sequence of str, or mapping of str to (float, float)
        Parameters, with the ranges to look in where they have a value.
    free : sequence of str, optional
        Faults and unknown inputs that may take any value of their range; by default all of them.
        Rows without them identify the parameters.
    loss : {"squares", "absolute"}
        What is least of the disturbances; absolute values leave single outliers alone.

    Returns
    -------
    Identified

    Raises
    ------
    BoundsError
        A record that contradicts the declared bounds, or that does not belong to the plant.

    Examples
    --------
    >>> from obsynth import identify, plants, records
    >>> tanks = plants.leaking_tanks(wx=0.0016, wy=0.0072)
    >>> found = identify(tanks, records.three_tank_leak()[20:80], {"b3": (0.03, 0.04)})
    >>> found.intervals["b3"][0] < found.values["b3"] < found.intervals["b3"][1]
    True
    """
    if loss not in ("squares", "absolute"):
        raise BoundsError(f"loss= is 'squares' or 'absolute', not {loss!r}.", loss=loss)
    ranges = dict(params) if isinstance(params, Mapping) else dict.fromkeys(params)
    able = {s.name for s in (*plant.p, *plant.constants)}
    if wrong := [name for name in ranges if name not in able] or ([""] if not ranges else []):
        raise BoundsError(
            f"params= names parameters of {plant.name}: {', '.join(sorted(able))}; "
            f"got {wrong[0]!r}.",
            symbol=wrong[0],
        )
    signals = [s.name for s in (*plant.f, *plant.d)] if free is None else list(free)
    problem = pose(plant, record, {**dict.fromkeys(signals), **ranges})
    cut = _intervals(problem)
    found = _fit(cut, loss)
    names = np.array(cut.names)[cut.still & (np.ptp(problem.box, axis=1) > 0.0)].tolist()
    places = [cut.names.index(name) for name in names]
    deviations, directions = _information(cut, found.v, places)
    return Identified(
        problem,
        record,
        {
            name: (float(cut.box[j, 0]), float(cut.box[j, 1]))
            for name, j in zip(names, places, strict=True)
        },
        {name: float(found.v[0, j]) for name, j in zip(names, places, strict=True)},
        dict(zip(names, deviations.tolist(), strict=True)),
        tuple(directions),
        found,
    )


def _sizes(problem: Problem) -> FloatArray:
    """Return declared bounds of the disturbances, (n_w,)."""
    box = problem.plant.box("w").reshape(-1, 2)
    size = 0.5 * (box[:, 1] - box[:, 0])
    if not np.isfinite(size).all():
        name = problem.plant.names("w")[int(np.flatnonzero(~np.isfinite(size))[0])]
        raise BoundsError(f"the disturbance {name} has no bound: declare one.", symbol=name)
    return size


def _intervals(problem: Problem) -> Problem:
    """Return the problem with what the declared bounds leave of the parameters."""
    size = _sizes(problem)
    groups = range(len(problem.groups))
    bounds = np.nextafter([size[problem.group == g].max(initial=0.0) for g in groups], np.inf)
    for _ in range(MOST_CUTS):
        after = narrowed(problem, bounds)
        if after is None:
            raise BoundsError(
                "the record contradicts the declared ranges and bounds for certain: "
                "least_bounds(plant, record, free=) says which bounds it needs."
            )
        width = np.ptp(problem.box[problem.still], axis=1)
        stalled = np.ptp(after.box[problem.still], axis=1) >= (1.0 - STALLED) * width
        problem = after
        if stalled.all():
            break
    return problem


def _fit(problem: Problem, loss: str) -> Trajectory:
    """Return the trajectory whose disturbances are least."""
    search, start = Search.of(problem), guess(problem)
    relative = search.off / np.tile(np.maximum(_sizes(problem), 1e-300), len(problem))
    if loss == "squares":
        none = np.empty(0)
        extra, ends = ca.MX(0, 1), (none, none, none)
        objective, within = ca.sumsqr(relative), ca.MX(0, 1)
    else:
        count = relative.numel()
        extra = ca.MX.sym("size", count)
        ends = np.zeros(count), np.ones(count), np.full(count, np.inf)
        objective, within = ca.sum1(extra), ca.vertcat(relative - extra, -relative - extra)
    return measured(problem, search.minimise(objective, within, start, extra, ends))


def _information(
    problem: Problem, v: FloatArray, places: list[int]
) -> tuple[FloatArray, list[dict[str, float]]]:
    """Return deviations of parameters, and directions that nothing is known of.

    Least squares of the disturbances, of variance 1/3; what is not determined would not show in the
    outputs if nothing disturbed the states.
    """
    shown = default_groups(problem.plant).get("outputs", ())
    quiet = [name in shown for name in problem.plant.names("w")]
    scale = np.abs(v[0, places])
    H = _normal(problem, v, places, np.ones(len(quiet), dtype=bool))
    values, vectors = np.linalg.eigh(_normal(problem, _undisturbed(problem, v), places, quiet))
    lost = vectors[:, values <= UNKNOWN * max(float(values.max(initial=0.0)), 1e-300)]
    inside = np.linalg.svd(lost.T)[2][lost.shape[1] :].T  # an orthonormal basis of the rest
    spread = inside @ np.linalg.pinv(3.0 * inside.T @ H @ inside) @ inside.T
    unknown = (lost**2).sum(axis=1) > 1e-6
    deviations = np.where(unknown, np.inf, scale * np.sqrt(np.maximum(np.diag(spread), 0.0)))
    names = [problem.names[j] for j in places]
    directions = []
    for vector in lost.T:
        pairs = zip(names, (vector / vector[np.abs(vector).argmax()]).tolist(), strict=True)
        directions.append({name: share for name, share in pairs if abs(share) > 1e-3})
    return deviations, directions


def _undisturbed(problem: Problem, v: FloatArray) -> FloatArray:
    """Return the trajectory from the same start without disturbances, or this if it runs away."""
    path = v.copy()
    path[:, problem.places["w"]] = problem.middle
    for k in range(len(v) - 1):
        path[k + 1, : problem.n] = np.array(problem.equations(path[k], problem.u[k])[0]).ravel()
    away = np.abs(path[:, : problem.n] - v[:, : problem.n]).max()
    return path if away <= np.ptp(v[:, : problem.n]) else v


def _normal(problem: Problem, v: FloatArray, places: list[int], noise: Any) -> FloatArray:
    """Return H, relative to the parameters, where some disturbances move."""
    search, steps, n_v = Search.of(problem), len(problem), len(problem.box)
    slopes = ca.Function("slopes", [search.v], [ca.jacobian(search.zeros, ca.vec(search.v))])
    J = csc_array(slopes(v.T).sparse())
    moving = np.ptp(problem.box, axis=1) > 0.0
    moving[problem.places["w"]] = noise
    moving[problem.still] = False
    instants = n_v * np.arange(steps)
    columns = (instants[:, None] + np.flatnonzero(moving)).ravel()
    weight = np.full(n_v, 1e-9)  # as good as nothing: what follows may not be determined either
    weight[problem.places["w"]] = 1.0 / np.maximum(_sizes(problem), 1e-300) ** 2
    Q = np.column_stack([J[:, instants + j].sum(axis=1) for j in places]) * v[0, places]
    A, W = J[:, columns], diags_array(np.tile(weight[moving], steps))
    soft = diags_array(np.full(A.shape[0], -1e-14))
    solved = splu(csc_array(block_array([[W, A.T], [A, soft]]))).solve(
        np.vstack([np.zeros((A.shape[1], len(places))), -Q])
    )
    H: FloatArray = Q.T @ solved[A.shape[1] :]
    return 0.5 * (H + H.T)
