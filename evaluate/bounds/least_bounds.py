"""The smallest disturbance bounds that explain a measured record, attained and certified."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.evaluate.bounds.attribution import Attribution, attribute
from obsynth.evaluate.bounds.certified import Least, below, least
from obsynth.evaluate.bounds.problem import Groups, Problem, pose
from obsynth.evaluate.bounds.validation import Validation, validate
from obsynth.evaluate.errors import BoundsError
from obsynth.symbolic import Plant, Record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import plain
from obsynth.symbolic.table import Table, Tabled
from obsynth.symbolic.taking import takes

SAFETY = 1.2
"""About beta^(-1/n) for beta = 5 % and 18 windows: see `LeastBounds.validate`."""
BESIDE = 0.01
"""By how much bounds are looked for above those that are asked for, relative."""


@dataclass(frozen=True, eq=False, repr=False)
class LeastBounds(Tabled):
    """The least bounds of a plant's disturbances with which a record can be explained.

    Bounds below the certified cost are refuted by the record, for certain. That the bounds which
    are attained will do tomorrow is an estimate: see :meth:`validate`.

    Parameters
    ----------
    problem : Problem
        What was asked.
    record : Record
    safety : float
        Factor between the bounds and those of :attr:`plant`.
    least : Least
        Both sides of the bound.
    """

    problem: Problem = field(repr=False)
    record: Record
    safety: float
    least: Least = field(repr=False)

    @property
    def bounds(self) -> dict[str, float]:
        """Bounds by group, attained by :attr:`trajectory`; of the largest member's size."""
        values = self.least.trajectory.bounds.tolist()
        return dict(zip(self.problem.groups, values, strict=True))

    @property
    def weights(self) -> dict[str, float]:
        """Weights by group."""
        return dict(zip(self.problem.groups, self.least.weights.tolist(), strict=True))

    @property
    def upper(self) -> float:
        """Sum of weights times bounds, attained."""
        return self.least.upper

    @property
    def lower(self) -> float:
        """Certified: no bounds with a smaller sum of weights times bounds explain the record.

        Proved in exact rationals from multipliers of a linear program that every trajectory within
        the plant's ranges satisfies. Infinite where no bounds do.
        """
        return self.least.lower

    @cached_property
    def refuted(self) -> bool:
        """Whether the declared bounds of the disturbances are too small for certain."""
        if self.lower == np.inf or not np.isfinite([*self._declared.values()]).all():
            return self.lower == np.inf
        return self.refutes(**self._declared)

    @property
    def trajectory(self) -> dict[str, FloatArray]:
        """Signals that explain the record, by name: states, faults, disturbances, (N,) each."""
        return dict(zip(self.problem.names, self.least.trajectory.v.T, strict=True))

    @property
    def params(self) -> dict[str, float]:
        """Values of the free parameters with which the bounds are attained."""
        names = np.array(self.problem.names)[self.problem.still]
        return {name: float(self.trajectory[name][0]) for name in names.tolist()}

    @cached_property
    def plant(self) -> Plant:
        """The plant with ``safety`` times the bounds, free parameters at their values.

        With the parameters held the bounds still explain the record, by the same trajectory.
        """
        problem = self.problem
        if not np.isfinite(self.least.trajectory.bounds).all():
            raise BoundsError(f"{problem.plant.name}: no bounds were found that are attained.")
        size = problem.sizes(self.safety * self.least.trajectory.bounds)
        ends = np.column_stack([problem.middle - size, problem.middle + size]).tolist()
        ours = np.flatnonzero(problem.group < len(problem.groups)).tolist()
        ranges = {problem.plant.names("w")[j]: (ends[j][0], ends[j][1]) for j in ours}
        held = {name: (value, value) for name, value in self.params.items()}
        return problem.plant.with_ranges({**ranges, **held})

    @property
    def support(self) -> Table:
        """The instants and disturbances whose bounds the certified number rests on."""
        solution, linear = self.least.solution, self.least.linear
        rows: list[list[Any]] = []
        if solution is not None and linear is not None and len(solution.multipliers):
            weight = np.where(linear.noise >= 0, solution.multipliers[linear.noise], 0.0).sum(
                axis=2
            )
            names = self.problem.plant.names("w")
            for k, j in np.argwhere(weight > 1e-9 * max(weight.max(), 1e-300)).tolist():
                time = float(self.record.time[self.least.begin + k])
                rows.append([time, names[j], float(weight[k, j])])
        return Table(
            "Support",
            ["time [s]", "disturbance", "multiplier"],
            rows,
            note="The readings and steps whose inequalities prove the certified bound.",
        )

    def front(self, group: str, values: Sequence[float]) -> Table:
        """Return the least weighted sum of the other bounds where one is held at values.

        Parameters
        ----------
        group : str
            Name of the group that is held, among :attr:`bounds`.
        values : sequence of float
            Its bounds, in its unit.

        Returns
        -------
        Table
            Rows (value, attained, certified); with two groups these are bounds of the other.
        """
        if group not in self.problem.groups:
            known = ", ".join(self.problem.groups)
            raise BoundsError(f"there is no group {group!r}; there are {known}.", group=group)
        g = self.problem.groups.index(group)
        weights = self.least.weights.copy()
        weights[g] = 0.0
        rows = []
        for value in values:
            top = np.where(np.arange(len(weights)) == g, float(value), np.inf)
            found = least(self.problem, weights, top, self.least.trajectory.v)
            rows.append([float(value), found.upper, found.lower])
        others = " + ".join(
            f"{w:g} {name}" if w != 1.0 else name
            for name, w in zip(self.problem.groups, weights, strict=True)
            if w
        )
        return Table(
            "Front",
            [group, f"least {others}, attained", "certified"],
            rows,
            note="Below the certified number nothing explains the record.",
        )

    def refutes(self, scale: float = 1.0, **bounds: float) -> bool:
        """Tell whether bounds by group are refuted for certain: no trajectory needs so little.

        Groups that are not named have the bounds that are attained.
        """
        given = np.array([*(self.bounds | bounds).values()])
        if len(given) > len(self.bounds) or not (np.isfinite(given) & (given >= 0.0)).all():
            raise BoundsError(
                "refutes() takes finite bounds, not negative, of the groups "
                f"{', '.join(self.bounds)}, not {bounds}.",
            )
        problem, top = self.problem.scaled(scale * given), 1.0 + BESIDE
        return below(problem, np.ones(1), np.array([top]), top)[1] > 1.0

    def attribute(self, without: Sequence[str] = (), safety: float | None = None) -> Attribution:
        """Say where a contradiction lies: see `Attribution`.

        Parameters
        ----------
        without : sequence of str
            Faults and unknown inputs that are held at zero.
        safety : float, optional
            Factor of the bounds; that of the fit by default.
        """
        factor = self.safety if safety is None else safety
        problem = self._held().fixed(**dict.fromkeys(without, 0.0))
        return attribute(problem, self.record, factor * self.least.trajectory.bounds)

    def validate(self, windows: int = 18) -> Validation:
        """Say what the bounds are worth for records to come: see `Validation`."""
        fitted = self.problem.still & (np.ptp(self.problem.box, axis=1) > 0.0)
        free = len(self.bounds) + int(fitted.sum())
        return validate(self._held(), self.least.trajectory.bounds, windows, free)

    def _held(self) -> Problem:
        """Return the problem with the parameters at their values."""
        return replace(self.problem, still=np.zeros_like(self.problem.still)).fixed(**self.params)

    @property
    def _declared(self) -> dict[str, float]:
        """Declared bounds of the groups, of their largest members."""
        radius = 0.5 * np.ptp(self.problem.plant.box("w").reshape(-1, 2), axis=1)
        members = {name: self.problem.group == g for g, name in enumerate(self.problem.groups)}
        return {name: float(radius[own].max(initial=0.0)) for name, own in members.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return what is found as names and numbers for JSON; null is infinite."""
        told: dict[str, Any] = {"plant": self.problem.plant.name, "record": self.record.source}
        told |= {"instants": len(self.record), "declared": self._declared}
        for name in ("bounds", "weights", "upper", "lower", "params", "refuted"):
            told[name] = getattr(self, name)
        return dict(plain(told))

    @property
    def pressed(self) -> dict[str, int]:
        """Numbers of instants at which a signal of the trajectory is at an end of its range.

        Where there are any, the range may be what asks for large bounds, not the noise.
        """
        box, v = self.problem.box, self.least.trajectory.v
        near = 1e-6 * np.ptp(box, axis=1)
        at = (v <= box[:, 0] + near) | (v >= box[:, 1] - near)
        at[:, self.problem.places["w"]] = False
        at[:, ~(near > 0.0)] = False
        count = at[np.isfinite(v).all(axis=1)].sum(axis=0)
        return {n: k for n, k in zip(self.problem.names, count.tolist(), strict=True) if k}

    def table(self) -> Table:
        """Bounds by group beside the declared ones, both sides of their weighted sum."""
        rows: list[list[Any]] = [
            [name, value, self.weights[name], self._declared[name]]
            for name, value in self.bounds.items()
        ]
        rows += [
            ["sum, attained", self.upper, None, None],
            ["sum, certified", self.lower, None, None],
        ]
        verdict = "The declared bounds are refuted." if self.refuted else ""
        if not np.isfinite(self.upper):
            gap = self.least.trajectory.gap
            verdict = f"No trajectory was found that meets the equations (best: to {gap:.2g})."
            if self.lower == np.inf:
                verdict = "No bounds explain it: ranges or equations without disturbance refute it."
        if self.pressed:
            told = ", ".join(f"{name} at {count} instants" for name, count in self.pressed.items())
            verdict += f" At an end of its range: {told}; a wider one may ask for smaller bounds."
        return Table(
            f"Least bounds of {self.problem.plant.name}",
            ["group", "bound", "weight", "declared"],
            rows,
            note=f"{len(self.record)} instants of {self.record.source}. {verdict}".strip(),
        )


@takes(plant="Plant", record="Record")
def least_bounds(
    plant: Plant,
    record: Record,
    free: Sequence[str] | Mapping[str, tuple[float, float] | None] | None = None,
    *,
    groups: Groups | None = None,
    weights: Mapping[str, float] | None = None,
    least_of: Mapping[str, float] | None = None,
    safety: float = SAFETY,
    progress: Callable[[str, float], None] | None = None,
) -> LeastBounds:
    """Return the smallest disturbance bounds with which a plant explains a record.

    Parameters
    ----------
    plant : Plant
        Discrete, with the sampling time of the record. Ranges of states, faults and parameters are
        taken for true.
    record : Record
        Inputs and outputs in the plant's order; NaN is no reading.
    free : sequence of str, or mapping of str to (lower, upper) or None, optional
        Faults, unknown inputs and parameters that may take any value of their range; all others are
        zero, parameters at their nominal values. A parameter with a value needs a range here. By
        default everything the plant leaves open is free.
    groups : mapping of str to sequence of str, optional
        Disturbances that share a bound, in proportion to their declared ones; a disturbance in no
        group keeps its declared bound. By default those of the dynamics, and those of the outputs.
    weights : mapping of str to float, optional
        Of the bounds in what is least; 1 by default.
    least_of : mapping of str to float, optional
        Bounds of groups that are known not to be smaller, as half a quantum of the readings.
    safety : float
        Factor between the bounds and those of the plant that is returned.
    progress : callable, optional
        Told the stage and the share that is done.

    Returns
    -------
    LeastBounds

    Raises
    ------
    BoundsError
        A record that does not belong to the plant, names that are none, a continuous plant.

    Notes
    -----
    Attained by a trajectory that Ipopt finds and that is measured itself; certified by multipliers
    of a linear program (McCormick 1976: products, chords and tangents of every operation of the
    plant) that are evaluated in exact rationals.

    Examples
    --------
    >>> from obsynth import least_bounds, plants, records
    >>> fit = least_bounds(plants.leaking_tanks(), records.three_tank_leak())
    >>> fit.lower < fit.upper < 1.01 * fit.lower
    True
    """
    problem = pose(plant, record, free, groups)
    if not problem.groups:
        raise BoundsError(
            f"{plant.name} has no disturbance whose bound is open: declare one, "
            "plant.disturbances(name, bound=)."
        )
    factors = _by_group(problem, "weights", weights, 1.0)
    smallest = _by_group(problem, "least_of", least_of, 0.0)
    if not (factors >= 0.0).all() or not factors.any() or not (smallest >= 0.0).all():
        raise BoundsError("weights= and least_of= are not negative, and some weight is positive.")
    if not safety >= 1.0:
        raise BoundsError(f"safety= is a factor of at least 1, not {safety}.", safety=safety)
    problem = replace(problem, smallest=smallest)
    found = least(problem, factors, progress=progress)
    return LeastBounds(problem, record, float(safety), found)


def _by_group(
    problem: Problem, what: str, given: Mapping[str, float] | None, default: float
) -> FloatArray:
    """Return a number for each group, (n_groups,)."""
    if unknown := set(given or {}) - set(problem.groups):
        raise BoundsError(
            f"{what}= names {min(unknown)!r}; the groups are {', '.join(problem.groups)}.",
            group=min(unknown),
        )
    return np.array([float((given or {}).get(name, default)) for name in problem.groups])
