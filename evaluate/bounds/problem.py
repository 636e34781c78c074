"""A record as a question: which trajectories of a plant explain it?

A trajectory holds, at every instant k of the record, v_k = (x, f, d, w, p, scheduling that is not
measured) with x_{k+1} = F(v_k, u_k, theta_k) and y_k = h(v_k, u_k, theta_k) where there is a
reading. Every disturbance w_j is a middle plus at most ``shape_j`` times the bound of its group.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program
from obsynth.derive.rigour import middle_and_radius, up
from obsynth.designs.core.equations import symbols
from obsynth.evaluate.data.estimate import fits
from obsynth.evaluate.errors import BoundsError
from obsynth.symbolic import Plant, Record
from obsynth.symbolic.arrays import BoolArray, FloatArray, IntArray

Groups = Mapping[str, Sequence[str]]


@dataclass(frozen=True, eq=False)
class Problem:
    """A record, a plant, and what of it may vary.

    u, y: inputs with measured scheduling, and readings, NaN where there is none; (N, n_u), (N, m)
    groups: names of the disturbances that share a bound
    group, shape, middle: of every disturbance, (n_w,)
    box: ranges of v, (n_v, 2), by names; those of the disturbances play no part
    smallest: what the bounds of groups are at least, (n_groups,); 0 by default
    first: ends of the states at the first instant, (n, 2), where they are known better
    """

    plant: Plant
    u: FloatArray
    y: FloatArray
    groups: tuple[str, ...]
    group: IntArray
    shape: FloatArray
    middle: FloatArray
    box: FloatArray
    names: tuple[str, ...]
    still: BoolArray = field(repr=False)
    smallest: FloatArray | float = 0.0
    first: FloatArray | None = field(default=None, repr=False)

    @cached_property
    def places(self) -> dict[str, slice]:
        """Where x, f, d, w and p stand in v; the rest follows."""
        start, found = 0, {}
        for kind in ("x", "f", "d", "w", "p"):
            size = len(getattr(self.plant, kind))
            found[kind] = slice(start, start + size)
            start += size
        return found

    @cached_property
    def equations(self) -> ca.Function:
        """(v, known) -> (next state, outputs)."""
        v, known, rows, outputs, _ = symbols(self.plant)
        return ca.Function("equations", [v, known], [rows, outputs])

    @cached_property
    def program(self) -> Program:
        """The same as a program of interval operations, over (v, known)."""
        return Program.from_casadi(self.equations)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.plant.x)

    def __len__(self) -> int:
        return len(self.y)

    def sizes(self, bounds: FloatArray) -> FloatArray:
        """Return how large every disturbance may be for bounds of the groups, up, (n_w,)."""
        with np.errstate(invalid="ignore"):
            sizes = self.shape * np.append(bounds, 1.0)[self.group]
        return np.where(sizes > 0.0, up(sizes), 0.0)

    def window(self, first: int, last: int) -> "Problem":
        """Return the same for the instants ``first`` to ``last - 1``."""
        return replace(self, u=self.u[first:last], y=self.y[first:last], first=None)

    def scaled(self, bounds: FloatArray) -> "Problem":
        """Return the problem of one number: the factor of bounds of the groups."""
        return replace(
            self,
            groups=("scale",),
            group=np.where(self.group < len(self.groups), 0, 1),
            shape=self.sizes(bounds),  # of those in no group it stays
            smallest=0.0,
        )

    def fixed(self, **values: float) -> "Problem":
        """Return the problem with variables of v at values."""
        box = self.box.copy()
        for name, value in values.items():
            if name not in self.names:
                raise BoundsError(f"{name!r} is none of {', '.join(self.names)}.", symbol=name)
            box[self.names.index(name)] = value
        return replace(self, box=box)


def pose(
    plant: Plant,
    record: Record,
    free: Sequence[str] | Mapping[str, tuple[float, float] | None] | None = None,
    groups: Groups | None = None,
) -> Problem:
    """Ask a record; `free` and `groups` as in `least_bounds`."""
    plant, wanted = _opened(plant, free)
    if plant.Ts is None:
        raise BoundsError(
            f"{plant.name} is continuous: discretise it with the step of the record, "
            f"plant.discretise('taylor', Ts={np.median(np.diff(record.time)):g}).",
            field="Ts",
        )
    fits(plant, record)
    known = np.hstack([record.u, record.rho])
    scheduling = tuple(s.name for s in plant.rho if s.measured)
    if record.names["rho"] != scheduling or not np.isfinite(known).all():
        raise BoundsError(
            f"the record {record.source!r} lacks inputs or measured scheduling at some instants: "
            f"{', '.join((*plant.names('u'), *scheduling))} have to be known throughout.",
            field="u",
        )
    kinds = [s for kind in ("x", "f", "d", "w", "p") for s in getattr(plant, kind)]
    kinds += [s for s in plant.rho if not s.measured]
    held = {s.name for s in (*plant.f, *plant.d) if wanted is not None and s.name not in wanted}
    box = np.array([(0.0, 0.0) if s.name in held else (s.lower, s.upper) for s in kinds])
    for k, s in enumerate(kinds):
        if wanted is not None and s in plant.p and s.name not in wanted:
            box[k] = s.usual
    return Problem(
        plant,
        known,
        np.array(record.y),
        *_grouped(plant, groups),
        box.reshape(-1, 2),
        tuple(s.name for s in kinds),
        np.array([s in plant.p and s.constant for s in kinds], dtype=bool),
    )


def _opened(
    plant: Plant, free: Sequence[str] | Mapping[str, tuple[float, float] | None] | None
) -> tuple[Plant, set[str] | None]:
    """Return the plant with ranges in place of the values of free constants, and the free names."""
    if free is None:
        return plant, None
    ranges = dict(free) if isinstance(free, Mapping) else dict.fromkeys(free)
    signals = {s.name: s for s in plant.signals}
    able = [s.name for s in (*plant.f, *plant.d, *plant.p, *plant.constants)]
    for name, pair in ranges.items():
        if name not in able:
            raise BoundsError(
                f"free= names {name!r}, which is no fault, unknown input or parameter of "
                f"{plant.name}: {', '.join(able)}.",
                symbol=name,
            )
        if pair is None and signals[name] in plant.constants:
            raise BoundsError(
                f"the parameter {name} of {plant.name} has a value and no range: give the range to "
                f"look in, free={{{name!r}: (lower, upper), ...}}.",
                symbol=name,
            )
    given = {name: pair for name, pair in ranges.items() if pair is not None}
    return (plant.with_ranges(given) if given else plant), set(ranges)


def _grouped(
    plant: Plant, groups: Groups | None
) -> tuple[tuple[str, ...], IntArray, FloatArray, FloatArray]:
    """Return names of groups; the group, shape and middle of every disturbance."""
    given = default_groups(plant) if groups is None else {g: tuple(m) for g, m in groups.items()}
    names = plant.names("w")
    place = {name: k for k, members in enumerate(given.values()) for name in members}
    if sum(map(len, given.values())) != len(place) or set(place) - set(names):
        raise BoundsError(
            f"groups= has every disturbance of {plant.name} at most once: {', '.join(names)}.",
            symbol=next(iter(set(place) - set(names)), None),
        )
    box = plant.box("w").reshape(-1, 2)
    group = np.array([place.get(name, len(given)) for name in names], dtype=np.int64)
    middle, radius = middle_and_radius(*box.T)
    radius = np.where(box[:, 0] == -box[:, 1], box[:, 1], radius)  # exact
    largest = np.array([radius[group == g].max() for g in group])
    with np.errstate(invalid="ignore", divide="ignore"):
        smaller = np.isfinite(largest) & (radius < largest)
        shape = np.where(smaller, np.where(radius > 0.0, up(radius / largest), 0.0), 1.0)
    held = group == len(given)
    if not np.isfinite(radius[held]).all():
        name = names[int(np.flatnonzero(held & ~np.isfinite(radius))[0])]
        raise BoundsError(
            f"the disturbance {name} of {plant.name} has no bound and is in no group: put it into "
            "one of groups=.",
            symbol=name,
        )
    shape[held] = radius[held]
    return tuple(given), group, shape, middle


def default_groups(plant: Plant) -> dict[str, tuple[str, ...]]:
    """Return disturbances by where they stand: in the dynamics, in the outputs, or in both.

    What a discretisation leaves out has bounds that are derived, and stands in no group.
    """
    v, _, rows, outputs, _ = symbols(plant)
    start = len(plant.x) + len(plant.f) + len(plant.d)
    w = v[start : start + len(plant.w)]
    moves, shows = (
        np.array(ca.which_depends(part, w, 1, False), dtype=bool).reshape(-1)
        if w.numel()
        else np.zeros(0, dtype=bool)
        for part in (rows, outputs)
    )
    found = {
        "dynamics": [k for k in range(len(moves)) if moves[k] and not shows[k]],
        "outputs": [k for k in range(len(moves)) if shows[k] and not moves[k]],
        "both": [k for k in range(len(moves)) if moves[k] and shows[k]],
    }
    names, derived = plant.names("w"), {s.name for s in plant.remainder or ()}
    given = {key: tuple(names[k] for k in places) for key, places in found.items()}
    given = {key: tuple(n for n in members if n not in derived) for key, members in given.items()}
    return {key: members for key, members in given.items() if members}
