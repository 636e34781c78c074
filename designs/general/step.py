"""What runs: a prediction, corrected with the readings, and half widths around it."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import add_up
from obsynth.designs.core.boxes import LIMITS, Ends, column, every
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.equations import curved_states
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.half_widths import (
    ROUND_UP,
    SETTLED,
    UP,
    Running,
    above,
    all_around,
    all_steady,
    settle,
    shaken,
)
from obsynth.designs.core.stepping import clip, inside
from obsynth.designs.general.lmis import rounding_in
from obsynth.designs.general.record import EllipsoidBound, GeneralDesign, PeakBound
from obsynth.designs.general.system import error_system, magnitude
from obsynth.symbolic.arrays import FloatArray


def stages(design: GeneralDesign) -> tuple[ca.Function, ca.Function, ca.Function]:
    """Return (xp, u, y) -> xq, (xq, u, y) -> (xc, nu) and (xc, u, nu) -> next xp.

    Outside the box of the states on which a slope depends they go on with the middle of the slopes.
    """
    plant, N = design.extended.plant, design.size
    m = len(plant.output_names)
    sizes = {"x": N, "u": len(plant.u), "y": m, "nu": m}
    x, u, y, nu = (ca.SX.sym(name, size) for name, size in sizes.items())
    centre, function = ca.DM(design.v_centre), plant.function()
    box = np.where(curved_states(plant, noise=True)[:, None], plant.box("x"), [-np.inf, np.inf])
    inner = clip(x, box, design.precision)
    middle = design.middle
    outside = x - inner
    found = function(x=inner, u=u, w=centre)
    A0, C0 = (ca.sparsify(ca.DM(part)) for part in (middle[:N, :N], middle[N:, :N]))
    loose = np.isfinite(box).any(axis=1)
    A0[:, np.flatnonzero(~loose).tolist()] = 0.0
    C0[:, np.flatnonzero(~loose).tolist()] = 0.0
    rows = found["rhs"] + ca.sparsify(A0) @ outside + ca.sparsify(ca.DM(design.K)) @ nu
    innovation = y - (found["y"] + ca.sparsify(C0) @ outside)
    # the outputs that L0 reads have constant slopes: no clipping there
    plain = function(x=x, u=u, w=centre)["y"]
    first = x + ca.sparsify(ca.DM(design.L0)) @ (y - plain) if design.extended.picked else x
    second = x + ca.sparsify(ca.DM(design.Z)) @ innovation
    second, innovation = ca.densify(second), ca.densify(innovation)
    names = ["x", "u", "y"]
    return (
        ca.Function("first", [x, u, y], [ca.densify(first)], names, ["q"]),
        ca.Function("second", [x, u, y], [second, innovation], names, ["c", "nu"]),
        ca.Function("third", [x, u, nu], [ca.densify(rows)], ["x", "u", "nu"], ["p"]),
    )


def start_bound(design: GeneralDesign, x: Ends, f: Ends, prediction: ca.SX) -> ca.SX:
    """Return an s of every bound, for a state and a fault in boxes around a prediction."""
    low, high = (
        ca.vertcat(a, *(b[k] for k in design.places))
        for a, b in ((x.lower, f.lower), (x.upper, f.upper))
    )
    apart = ca.fmax(high - prediction, prediction - low) * above(design.precision, 1)
    return ca.vertcat(*(_start(design, bound, apart) for bound in design.bounds))


def _start(design: GeneralDesign, bound: PeakBound | EllipsoidBound, apart: ca.SX) -> ca.SX:
    """Return an s for first errors of at most `apart`."""
    up = above(design.precision, 4 * design.size)
    if isinstance(bound, PeakBound):
        return ca.sparsify(ca.DM(bound.fading.start * up)) @ apart
    M, other, added = start_of_ellipsoid(design, bound)
    # sqrt V of M e_p, and of what channels, disturbances and rounding add to it
    rest = ca.DM(other) @ apart + ca.DM(added)
    size = np.abs(bound.P)
    parts = [ca.sqrt(ca.dot(a, ca.DM(W) @ a)) for a, W in ((apart, M), (rest, size))]
    return (parts[0] + parts[1]) ** 2 * up


def running(design: GeneralDesign) -> tuple[Running, ...]:
    """Return how the half widths of every bound evolve, none of an energy gain."""
    return tuple(_running(design, bound) for bound in design.bounds)


def _running(design: GeneralDesign, bound: PeakBound | EllipsoidBound) -> Running:
    """Return the recursion of a bound; underflow is far below what `add` counts twice."""
    if isinstance(bound, PeakBound):
        add, fading = bound.b[design.size :] * ROUND_UP, bound.fading
        still = np.zeros(len(fading.G))
        G, reach = fading.G * UP, fading.reach * UP
        return Running(G, still, reach, add, root=False, precision=design.precision)
    step, gamma = rounding_in(error_system(design), design.rounding), bound.gamma
    rho = float(np.sqrt(step @ np.abs(bound.P) @ step)) * UP
    decay, offset = shaken(gamma, rho)
    return Running(
        decay=np.array([[decay]]),
        offset=np.array([offset]),
        reach=bound.inverse_diagonal[:, None] * UP,
        add=np.zeros(design.size),
        root=True,
        precision=design.precision,
    )


def start_of_ellipsoid(
    design: GeneralDesign, bound: EllipsoidBound
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return ``|M'PM|`` and what bounds ``e_c - M e_p`` by ``|e_p|``: (N, N), (N, N), (N,)."""
    system, N = error_system(design), design.size
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
    found = np.full(len(design.plant.x) + len(design.plant.f), np.inf)
    found[design.pick] = widths
    return found


def steady(design: GeneralDesign) -> FloatArray:
    """Return the steady half widths of the core, states then faults, (n + n_f,)."""
    return per_signal(design, all_steady(running(design)))


def settling(
    design: GeneralDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray] | None:
    """Return how many calls bounds from boxes take to settle, and the largest then, or None."""
    bounds = running(design)
    if not bounds:
        return None
    n, pick = len(design.plant.x), design.pick
    if not np.isfinite(box[pick]).all():
        return 0, np.full(box.shape, np.inf)
    half = box[pick]
    middle = ca.SX(ca.DM(all_steady(bounds) * (1.0 + SETTLED) + half))
    ends = np.zeros((len(box), 2))
    ends[pick] = np.column_stack([-half, half])
    first = start_bound(design, Ends.of(ends[:n]), Ends.of(ends[n:]), middle)
    k, widths = settle(bounds, np.array(ca.evalf(first)).ravel() * UP, calls)
    return k, per_signal(design, widths)


def fault_delay(design: GeneralDesign) -> int:
    """Return how many calls late faults are known: one where they are divided out."""
    return int(bool(design.divided))


def memory_sizes(design: GeneralDesign) -> dict[str, int]:
    """Return the parts of the memory: the prediction of states and followed faults, and s."""
    sizes = {"prediction": design.size}
    parts = [len(b.fading.G) if isinstance(b, PeakBound) else 1 for b in design.bounds]
    return {**sizes, "bound": sum(parts)} if parts else sizes


def first_memory(
    design: GeneralDesign, start: Start, z0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at the guess, or a paper's z_0, and in the middle of the followed faults' boxes."""
    x = start.guess if z0 is None else read_vector(z0, "z0", design.plant.names("x"))
    return {"prediction": np.concatenate([x, start.f.mean(axis=1)[design.places]])}


def build_core(design: GeneralDesign) -> Core:
    """Build what the observer knows of its own; half widths begin anew after a missing reading."""
    first, second, third = stages(design)
    plant, n = design.extended.plant, len(design.plant.x)
    limits, precision = design.limits, design.precision
    far = LIMITS[precision].far
    bounds = running(design)
    names, followed = design.plant.names("f"), design.extended.followed
    own = curved_states(plant, noise=True)[:n]
    domain = np.where(own[:, None], design.plant.box("x"), [-np.inf, np.inf])
    outputs, centre = plant.function(), ca.DM(design.v_centre)

    def spread(values: ca.SX, other: float) -> ca.SX:
        return column(
            values[n + followed.index(name)] if name in followed else ca.SX(other) for name in names
        )

    def run(seen: Seen) -> Known:
        prediction = seen.memory["prediction"]
        u = ca.vertcat(seen.u, seen.theta)
        expected = outputs(x=prediction, u=u, w=centre)["y"]
        y = seen.readings(expected)
        q = first(prediction, u, y)
        c, nu = second(q, u, y)
        checked = [(prediction, limits.x), (q, limits.x), (c, limits.x), (u, limits.u)]
        sound = every(inside(value, value, box, precision) for value, box in checked)
        moved = {"prediction": third(c, u, nu)}
        if not bounds:
            return Known(c[:n], spread(c, 0.0), None, None, moved, sound=sound)
        half, moved["bound"] = all_around(bounds, seen.memory["bound"], c)
        low, high = c - half, c + half
        return Known(
            c[:n],
            spread(c, 0.0),
            Ends(low[:n], high[:n]),
            Ends(spread(low, -far), spread(high, far)) if followed else None,
            moved,
            sound=sound,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        return {"bound": start_bound(design, x, f, kept["prediction"])} if bounds else {}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        near = x.nearest(kept["prediction"][:n])
        ends = (column(end[k] for k in design.places) for end in (f.lower, f.upper))
        return {"prediction": ca.vertcat(near, Ends(*ends).nearest(kept["prediction"][n:]))}

    return Core(run, begin, place, domain=domain, nonnegative=("bound",))
