"""What is read of a plant: a point of operation, and the equations enclosed around it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np

from obsynth.designs.core.backward import Sweeps
from obsynth.designs.core.boxes import FAR, Ends
from obsynth.designs.core.contractor import EVERY_CUT, Contractor
from obsynth.designs.core.equations import Before
from obsynth.designs.core.given import PlantClass
from obsynth.designs.general.model import GeneralModel
from obsynth.designs.set_membership.enclosure import Enclosures, told_by_rate
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray, IntArray

CLASS = PlantClass(
    who="the set-membership observer",
    time="discrete",
    faults=(Role.ACTUATOR_FAULT, Role.PROCESS_FAULT, Role.SENSOR_FAULT),
    finite={"x": " has no finite range, and the equations are not linear in it; declare range="},
    linear=True,
)
_NEAR = 1e-6
_PUSH = 0.1
"""Of half the range of a state: what an input without a range is taken to move it in a call."""


@dataclass(frozen=True, eq=False)
class Around:
    """Affine enclosures in numbers, see `enclosure`: columns (N, .), all else by their names."""

    J: FloatArray
    columns: FloatArray
    spread: FloatArray
    H: FloatArray
    sigma: FloatArray


@dataclass(frozen=True, eq=False)
class SetMembershipModel:
    """A plant in discrete time, and its equations around a point of operation.

    followed: places of faults that are states of the zonotopes
    general: what the general class makes of the plant, None where it is not of it
    """

    plant: Plant
    followed: IntArray
    general: GeneralModel | None = None

    @cached_property
    def enclosures(self) -> Enclosures:
        """Affine enclosures of the equations."""
        assert self.plant.Ts is not None
        sweeps = Sweeps(Contractor(self.plant, self.plant.Ts, EVERY_CUT))
        return Enclosures(sweeps, self.followed)

    @property
    def group(self) -> int:
        """Generators that one call adds to a zonotope, and the box that it makes of others."""
        N = self.enclosures.size
        return 2 * N + len(self.enclosures.alone) + len(self.plant.output_names)

    @cached_property
    def half(self) -> FloatArray:
        """Half the declared ranges of z, 1 where there is none, (N,)."""
        box = np.vstack([self.plant.box("x"), self.plant.box("f").reshape(-1, 2)[self.followed]])
        half = 0.5 * np.diff(box, axis=1)[:, 0]
        return np.where(np.isfinite(half) & (half > 0.0), half, 1.0)

    @cached_property
    def box(self) -> FloatArray:
        """Ranges of the variables (x, f, rest), `FAR` where there are none, (n_v, 2)."""
        box: FloatArray = self.enclosures.sweeps.equations.box.copy()
        declared = np.vstack([self.plant.box("x"), self.plant.box("f").reshape(-1, 2)])
        box[: len(declared)] = np.clip(declared, -FAR, FAR)
        return box

    @cached_property
    def point(self) -> tuple[FloatArray, FloatArray]:
        """Variables and known signals at the point of operation: nominal, else middle, else 0."""
        plant = self.plant
        measured = [s for s in plant.rho if s.measured]
        nominal = [s.nominal for s in (*plant.x, *plant.f)]
        rest = [None] * (len(self.box) - len(nominal))
        v = _numbers([*nominal, *rest], self.box)
        v[len(plant.x) : len(nominal)] = np.clip(0.0, *self.box[len(plant.x) : len(nominal)].T)
        theta = np.array([(s.lower, s.upper) for s in measured]).reshape(-1, 2)
        known = np.vstack([plant.box("u").reshape(-1, 2), theta])
        return v, _numbers([*(s.nominal for s in plant.u), *(s.nominal for s in measured)], known)

    @cached_property
    def beside(self) -> FloatArray:
        """Half widths of variables that z does not carry, (n_v,).

        Of those without a range what moves no state by more than a tenth of half its range.
        """
        half = 0.5 * np.diff(self.box, axis=1)[:, 0]
        half[[*self.enclosures.place]] = 0.0
        loose = half > 0.25 * FAR
        half[loose] = 0.0
        for j in np.flatnonzero(loose).tolist():
            unit = half.copy()
            unit[j] = 1.0
            push = (self.effects(unit) / self.half).max(initial=0.0)
            half[j] = _PUSH / push if push > 0.0 else 0.0
        return half

    @cached_property
    def slopes(self) -> FloatArray:
        """What a unit of every variable beside z moves z in a call, about, (N, n_v)."""
        found = np.zeros((len(self.half), len(self.beside)))
        for j in self.enclosures.beside:
            if self.beside[j] > 0.0:
                unit = np.where(np.arange(len(self.beside)) == j, self.beside, 0.0)
                found[:, j] = self.effects(unit) / self.beside[j]
        return found

    def effects(self, radius: FloatArray) -> FloatArray:
        """Return what variables of half widths beside z add to z in a call, (N,)."""
        found, none = (self.around(np.zeros(len(self.half)), r) for r in (radius, 0.0 * radius))
        total = np.abs(found.columns).sum(axis=1) + found.spread
        return np.asarray(total - np.abs(none.columns).sum(axis=1) - none.spread)

    def around(self, z: FloatArray, beside: FloatArray) -> Around:
        """Enclose the equations around the point, over half widths of z and of what is beside."""
        v, known = self.point
        radius = beside.copy()
        for j, k in self.enclosures.place.items():
            radius[j] = max(z[k], _NEAR * self.half[k])
        lower, upper = (np.clip(v + side * radius, *self.box.T) for side in (-1.0, 1.0))
        N, m = len(self.half), len(self.plant.output_names)
        found = self._around(lower, upper, known).full()[:, 0]
        sizes = (N * N, N * len(self.enclosures.alone), N, m * N, m)
        J, columns, spread, H, sigma = np.split(found, np.cumsum(sizes)[:-1])
        return Around(
            J.reshape(N, N, order="F"),
            columns.reshape(N, -1, order="F"),
            spread,
            H.reshape(m, N, order="F"),
            sigma,
        )

    @cached_property
    def nearest(self) -> Around:
        """The equations next to the point of operation: their slopes there."""
        return self.around(np.zeros(len(self.half)), self.beside)

    @cached_property
    def _around(self) -> ca.Function:
        """(lower, upper) of all variables and known signals -> J, columns, spread, H, sigma."""
        sweeps = self.enclosures.sweeps
        n, n_f, n_v = sweeps.n, sweeps.n_f, sweeps.equations.n_v
        lower, upper = ca.SX.sym("lower", n_v), ca.SX.sym("upper", n_v)
        known = ca.SX.sym("known", len(self.point[1]))
        cuts = (slice(0, n), slice(n, n + n_f), slice(n + n_f, n_v))
        x, f, rest = (Ends(lower[part], upper[part]) for part in cuts)
        here = Before(x, f, known, rest)
        rows, shown = self.enclosures.rows(here), self.enclosures.outputs(here)
        columns = ca.horzcat(*rows.columns) if rows.columns else ca.SX(self.enclosures.size, 0)
        outputs = [rows.J, columns, rows.spread, shown.H, shown.sigma]
        together = ca.vertcat(*(ca.vec(ca.densify(part)) for part in outputs))
        return ca.Function("around", [lower, upper, known], [together])


def read(plant: Plant) -> SetMembershipModel:
    """Read a discrete plant; which faults are followed depends on what is seen of them."""
    assert plant.Ts is not None
    return SetMembershipModel(plant, told_by_rate(Contractor(plant, plant.Ts, EVERY_CUT)))


def _numbers(nominal: Sequence[float | None], box: FloatArray) -> FloatArray:
    """Return nominal numbers, middles of ranges where there are none, else the nearest to zero."""
    low, high = np.clip(box, -FAR, FAR).T
    bounded = high - low < FAR
    middle = np.where(bounded, 0.5 * low + 0.5 * high, np.clip(0.0, low, high))
    given = zip(nominal, middle.tolist(), strict=True)
    return np.array([m if n is None else float(n) for n, m in given])
