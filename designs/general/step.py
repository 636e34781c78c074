"""What runs: a prediction, corrected with the readings, and half widths around it."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import add_up
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.lifted import FAR
from obsynth.designs.core.signals import LARGEST_SIGNAL
from obsynth.designs.core.stepping import clip, inside
from obsynth.designs.general.lmis import rounding_in
from obsynth.designs.general.record import EllipsoidBound, EnergyBound, GeneralDesign, PeakBound
from obsynth.designs.general.system import error_system, magnitude
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import BoolArray, FloatArray

ROUND_UP = 1.0 + 2.0**-50
# covers the rounding of estimate - half and estimate + half
ULPS = 2.0**-50
# Above the relative rounding error of the few dozen operations of each formula below.
UP = 1.0 + 2.0**-44
SETTLED = 0.01
MOST_CALLS = 100_000


def curved(plant: Plant) -> BoolArray:
    """Return on which states of an extended plant some slope depends, (N,)."""
    sx = plant.sx()
    both = ca.vertcat(sx.x, sx.w)
    slopes = ca.jacobian(ca.vertcat(sx.rhs, sx.y), both)
    found = ca.which_depends(ca.vec(ca.densify(slopes)), sx.x, 1, False)
    return np.array(found, dtype=bool).reshape(-1)


def held(plant: Plant) -> BoolArray:
    """Return which inputs enter in no constant way, so that they have to keep to their range."""
    sx = plant.sx()
    slopes = ca.jacobian(ca.vertcat(sx.rhs, sx.y), sx.u)
    everything = ca.vertcat(sx.x, sx.u, sx.w)
    return np.array(
        [bool(ca.depends_on(ca.SX(slopes[:, k]), everything)) for k in range(sx.u.numel())]
    )


@dataclass(frozen=True, eq=False)
class Limits:
    """Where estimates and inputs are followed: boxes (N, 2), (n_u, 2).

    Inputs that enter in no constant way keep to their ranges. Everything else may leave its range
    by its width on either side, and where none is declared `LARGEST_SIGNAL` stands for it.
    """

    x: FloatArray
    u: FloatArray

    @classmethod
    def of(cls, plant: Plant) -> "Limits":
        """Read the limits of an extended plant."""
        x, u = (_finite(plant.box(kind)) for kind in "xu")
        return cls(_wider(x), np.where(held(plant)[:, None], u, _wider(u)))


def _finite(box: FloatArray) -> FloatArray:
    box = box.reshape(-1, 2)
    return np.where(np.isfinite(box), box, [-LARGEST_SIGNAL, LARGEST_SIGNAL])


def _wider(box: FloatArray) -> FloatArray:
    wide = np.clip(box + np.diff(box, axis=1) * [-1.0, 1.0], -LARGEST_SIGNAL, LARGEST_SIGNAL)
    return np.column_stack([np.minimum(box, wide)[:, 0], np.maximum(box, wide)[:, 1]])


def stages(design: GeneralDesign) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return (xp, u, y) -> xq, (xq, u, y) -> (xc, nu) and (xc, u, nu) -> next xp.

    Rows and outputs are the extended plant's own at v0, inside the box of the states on which a
    slope depends, and go on outside with the middle of their slopes.
    """
    plant, N = design.extended.plant, design.size
    m = len(plant.output_names)
    sizes = {"x": N, "u": len(plant.u), "y": m, "nu": m}
    x, u, y, nu = (ca.SX.sym(name, size) for name, size in sizes.items())
    empty = ca.DM(0, 1)
    box = np.where(curved(plant)[:, None], plant.box("x"), [-np.inf, np.inf])
    inner = clip(x, box)
    middle = design.middle
    outside = x - inner
    rows, outputs = plant.function()(inner, u, empty, empty, ca.DM(design.v_centre), empty, empty)
    A0, C0 = (ca.sparsify(ca.DM(part)) for part in (middle[:N, :N], middle[N:, :N]))
    loose = np.isfinite(box).any(axis=1)
    A0[:, np.flatnonzero(~loose).tolist()] = 0.0
    C0[:, np.flatnonzero(~loose).tolist()] = 0.0
    rows = rows + ca.sparsify(A0) @ outside + ca.sparsify(ca.DM(design.K)) @ nu
    innovation = y - (outputs + ca.sparsify(C0) @ outside)
    # the outputs that L0 reads have constant slopes: no clipping there
    plain = plant.function()(x, u, empty, empty, ca.DM(design.v_centre), empty, empty)[1]
    first = x + ca.sparsify(ca.DM(design.L0)) @ (y - plain)
    if not design.extended.picked:
        first = x
    second = x + ca.sparsify(ca.DM(design.Z)) @ innovation
    second, innovation = ca.densify(second), ca.densify(innovation)
    names = ["x", "u", "y"]
    return (
        ca.Function("first", [x, u, y], [ca.densify(first)], names, ["q"]),
        ca.Function("second", [x, u, y], [second, innovation], names, ["c", "nu"]),
        ca.Function("third", [x, u, nu], [ca.densify(rows)], ["x", "u", "nu"], ["p"]),
    )


def start_bound(design: GeneralDesign, x: Ends, f: Ends, prediction: ca.SX) -> ca.SX:
    """Return an s that holds for a state and a fault in boxes, around a prediction."""
    low, high = (
        ca.vertcat(x.lower, _followed(design, f.lower)),
        ca.vertcat(x.upper, _followed(design, f.upper)),
    )
    apart = ca.fmax(high - prediction, prediction - low) * UP
    if isinstance(design.bound, PeakBound):
        return ca.sparsify(ca.DM(design.bound.fading.start * UP)) @ apart
    M, other, added = start_of_ellipsoid(design)
    # sqrt V of M e_p, and of what channels, disturbances and rounding add to it
    rest = ca.DM(other) @ apart + added
    size = np.abs(design.bound.P)
    parts = [ca.sqrt(ca.dot(a, ca.DM(W) @ a)) for a, W in ((apart, M), (rest, size))]
    return (parts[0] + parts[1]) ** 2 * UP


def _followed(design: GeneralDesign, f: ca.SX) -> ca.SX:
    names = design.plant.names("f")
    return ca.vertcat(*(f[names.index(name)] for name in design.extended.followed))


@dataclass(frozen=True, eq=False)
class Running:
    """How half widths evolve: ``s+ = decay s + offset``, half widths ``reach s + add``, (N,).

    root: of ``reach s`` the square root, for ellipsoids, where s bounds V
    """

    decay: FloatArray
    offset: FloatArray
    reach: FloatArray
    add: FloatArray
    root: bool

    @classmethod
    def of(cls, design: GeneralDesign) -> "Running":
        """Read the recursion of a design; underflow is far below what `add` counts twice.

        In the norm of P, rounding is at most rho: V+ <= ((1 - gamma) V + gamma) (1 + rho) + rho +
        rho^2.
        """
        bound = design.bound
        if isinstance(bound, PeakBound):
            add = bound.b[design.size :] * ROUND_UP
            nothing = np.zeros(len(bound.fading.G))
            return cls(bound.fading.G * UP, nothing, bound.fading.reach * UP, add, root=False)
        if not isinstance(bound, EllipsoidBound):
            raise TypeError("an energy gain has no half widths")
        step, gamma = rounding_in(error_system(design), design.rounding), bound.gamma
        rho = float(np.sqrt(step @ np.abs(bound.P) @ step)) * UP
        return cls(
            decay=np.array([[(1.0 - gamma) * (1.0 + rho) * UP]]),
            offset=np.array([(gamma * (1.0 + rho) + rho + rho**2) * UP]),
            reach=bound.inverse_diagonal[:, None] * UP,
            add=np.zeros(design.size),
            root=True,
        )

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = self.reach @ s
        return np.asarray((np.sqrt(inner) if self.root else inner) * ROUND_UP + self.add)

    @property
    def steady(self) -> FloatArray:
        """The half widths after long, (N,)."""
        limit = np.linalg.solve(np.eye(len(self.decay)) - self.decay, self.offset)
        return self.half_widths(np.asarray(limit, dtype=float))


def start_of_ellipsoid(design: GeneralDesign) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``|M'PM|`` and what bounds ``e_c - M e_p`` by ``|e_p|``: (N, N), (N, N), (N,)."""
    system, N = error_system(design), design.size
    bound = design.bound
    if not isinstance(bound, EllipsoidBound):
        raise TypeError("the design has no ellipsoid")
    shaped = system.M.T @ bound.P @ system.M
    h, Z = system.of_h, np.abs(system.Z)
    # M holds the rest of the outputs that L0 reads alone
    seen = np.abs(h.columns) @ h.coupling(N) + system.rest[N:, :N]
    other = Z @ (seen @ magnitude(system.T))
    radius = system.v_radius
    through = magnitude(system.through) @ radius
    drawn = np.abs(h.columns) @ h.sizes(N, radius) + system.rest[N:, N:] @ radius
    added = magnitude(system.direct) @ radius + Z @ (seen @ through + drawn)
    rounding = add_up(design.rounding.q, design.rounding.c)
    kept = np.eye(N) + Z @ (np.abs(system.C0) + seen)
    return (
        magnitude(shaped) * UP,
        other * UP,
        (added + kept @ rounding) * UP,
    )


def per_signal(design: GeneralDesign, widths: FloatArray) -> FloatArray:
    """Return half widths of states and all faults from those of the followed ones, (n + n_f,)."""
    n, names = len(design.plant.x), design.plant.names("f")
    found = np.full(n + len(names), np.inf)
    found[:n] = widths[:n]
    for k, name in enumerate(design.extended.followed):
        found[n + names.index(name)] = widths[n + k]
    return found


def steady(design: GeneralDesign) -> FloatArray:
    """Return the steady half widths of the core, states then faults, (n + n_f,)."""
    return per_signal(design, Running.of(design).steady)


def settling(
    design: GeneralDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray] | None:
    """Return how many calls the bounds take to come within 1 % of their limits, and what they are.

    They begin from boxes of half widths `box` (n + n_f,), around estimates that are as near as the
    limits say; with `calls` given, the half widths after so many, infinite where a box has no
    bound. None of an energy gain.
    """
    if isinstance(design.bound, EnergyBound):
        return None
    running = Running.of(design)
    n, names = len(design.plant.x), design.plant.names("f")
    pick = [*range(n), *(n + names.index(name) for name in design.extended.followed)]
    near = running.steady * (1.0 + SETTLED)
    if not np.isfinite(box[pick]).all():
        return 0, np.full(box.shape, np.inf)
    half, middle = box[pick], ca.SX(ca.DM(near + box[pick]))
    ends = np.zeros((n + len(names), 2))
    ends[pick] = np.column_stack([-half, half])
    first = start_bound(design, Ends.of(ends[:n]), Ends.of(ends[n:]), middle)
    s = np.array(ca.evalf(first)).ravel() * (1.0 + 2.0**-40)
    k = 0
    while k < (MOST_CALLS if calls is None else min(calls, MOST_CALLS)):
        if calls is None and np.all(running.half_widths(s) <= near):
            break
        s, k = running.decay @ s + running.offset, k + 1
    return k, per_signal(design, running.half_widths(s) * (1.0 + 2.0**-30))


def fault_delay(design: GeneralDesign) -> int:
    """Return how many calls late faults are known: one where they are divided out."""
    return int(bool(design.divided))


def memory_sizes(design: GeneralDesign) -> dict[str, int]:
    """Return the parts of the memory: the prediction of states and followed faults, and s."""
    bound, sizes = design.bound, {"prediction": design.size}
    if isinstance(bound, EnergyBound):
        return sizes
    return {**sizes, "bound": len(bound.fading.G) if isinstance(bound, PeakBound) else 1}


def first_memory(design: GeneralDesign, start: Start) -> dict[str, ArrayLike]:
    """Start at the guess, and in the middle of the boxes of the followed faults."""
    names = design.plant.names("f")
    middle = start.f.mean(axis=1)
    faults = [middle[names.index(name)] for name in design.extended.followed]
    return {"prediction": np.concatenate([start.guess, faults])}


def build_core(design: GeneralDesign) -> Core:
    """Build what the observer knows of its own.

    A missing reading counts as expected, and the half widths begin anew after it.
    """
    first, second, third = stages(design)
    plant, n = design.extended.plant, len(design.plant.x)
    limits = Limits.of(plant)
    running = None if isinstance(design.bound, EnergyBound) else Running.of(design)
    names, followed = design.plant.names("f"), design.extended.followed
    own = curved(plant)[:n]
    domain = np.where(own[:, None], design.plant.box("x"), [-np.inf, np.inf])
    outputs = plant.function()
    empty = ca.DM(0, 1)

    def spread(values: ca.SX, other: float) -> ca.SX:
        entries = [
            values[n + followed.index(name)] if name in followed else ca.SX(other) for name in names
        ]
        return ca.vertcat(*entries) if entries else ca.SX(0, 1)

    def run(seen: Seen) -> Known:
        prediction = seen.memory["prediction"]
        u = ca.vertcat(seen.u, seen.theta)
        expected = outputs(prediction, u, empty, empty, ca.DM(design.v_centre), empty, empty)[1]
        y = seen.readings(expected)
        q = first(prediction, u, y)
        c, nu = second(q, u, y)
        sound = ca.logic_and(inside(prediction, prediction, limits.x), inside(q, q, limits.x))
        sound = ca.logic_and(sound, inside(c, c, limits.x))
        sound = ca.logic_and(sound, inside(u, u, limits.u))
        moved = {"prediction": third(c, u, nu)}
        if running is None:
            return Known(c[:n], spread(c, 0.0), None, None, moved, sound=sound)
        s = seen.memory["bound"]
        reach, decay = (ca.sparsify(ca.DM(part)) for part in (running.reach, running.decay))
        inner = reach @ s
        half = (ca.sqrt(inner) if running.root else inner) * ROUND_UP + ca.DM(running.add)
        half = half + ULPS * ca.fabs(c)
        low, high = c - half, c + half
        moved["bound"] = decay @ s + ca.DM(running.offset) if running.root else decay @ s
        return Known(
            c[:n],
            spread(c, 0.0),
            Ends(low[:n], high[:n]),
            Ends(spread(low, -FAR), spread(high, FAR)) if followed else None,
            moved,
            sound=sound,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        return {} if running is None else {"bound": start_bound(design, x, f, kept["prediction"])}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        near = x.nearest(kept["prediction"][:n])
        box = Ends(_followed(design, f.lower), _followed(design, f.upper))
        return {"prediction": ca.vertcat(near, box.nearest(kept["prediction"][n:]))}

    return Core(run, begin, place, domain=domain)
