"""What runs: equations (10)-(12), half-width recursions (33)-(36) and how they begin."""

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.bounded_error.record import UioDesign
from obsynth.designs.core.boxes import Ends, Rounding, select, some
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.equations import curved_states
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.half_widths import SETTLED, UP, Running, above, all_around, settle, shaken
from obsynth.designs.core.stepping import clip, inside
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


def noise_offset(design: UioDesign) -> FloatArray:
    """Return the bound of ``E W2 w_k``, which separates e from zeta, shape (n,)."""
    bound: FloatArray = np.abs(design.E) @ (np.abs(design.W2) @ design.w_radius) * UP
    return bound


def _component_map(design: UioDesign) -> list[int | None]:
    """For each of the n + n_f errors the component of xi that bounds it, or None."""
    kept, rows = design.kept(design.bound.error), range(len(design.A))
    states: list[int | None] = [kept.index(i) if i in kept else None for i in rows]
    return states + [len(kept) + j for j in range(design.rate.size)]


def running_bound(design: UioDesign) -> Running:
    """Return the recursion (36) for every component, rounding included as in `shaken`."""
    bound, components = design.bound, _component_map(design)
    n, n_f = design.A.shape[0], design.rate.size
    size = n + n_f
    decay, offset, scale = np.zeros(size), np.zeros(size), np.zeros(size)
    add = design.rounding * UP
    if bound.error == "shifted":
        add[:n] += noise_offset(design)
    for i, component in enumerate(components):
        if component is None:
            continue
        shape = bound.shape_of(component)
        gamma, P = float(bound.gamma[shape]), bound.P[shape]
        kept = [j for j, c in enumerate(components) if c is not None]
        tau = design.rounding[kept]
        rho = float(np.sqrt(tau @ np.abs(P) @ tau)) * UP
        decay[i], offset[i] = shaken(gamma, rho)
        scale[i] = bound.inverse_diagonal[component] * UP
    return Running(np.diag(decay), offset, np.diag(scale), add, True, design.precision)


def check_range_of_T(design: UioDesign, z: FloatArray) -> None:
    """Refuse a first z that a recursion in the range of T would not keep."""
    if design.bound.error == "shifted" and np.any(design.T @ z != z):
        raise ObsynthError(
            "z0 has to lie in the range of T (zero in the coordinates that the unknown input "
            'takes away) for error="shifted"; give the guess alone',
            z0=z,
        )


def settling(
    design: UioDesign, box: FloatArray, calls: int | None = None
) -> tuple[int, FloatArray]:
    """Return how many calls bounds from boxes take to settle, and the largest then."""
    if not np.isfinite(box).all():
        return 0, np.full(box.shape, np.inf)
    bound, n = running_bound(design), len(design.A)
    near = bound.steady * (1.0 + SETTLED)
    ends = np.column_stack([-box, box])
    # the truth may be at one end of its box, and the estimate beyond the other
    z = near[:n] + noise_offset(design) + np.abs(design.T) @ box[:n]
    kept = {"z": ca.SX(ca.DM(z)), "fhat": ca.SX(ca.DM(near[n:] + box[n:]))}
    first = first_bound(design, Ends.of(ends[:n]), Ends.of(ends[n:]), kept)
    return settle([bound], np.array(ca.evalf(first)).ravel() * UP, calls)


def equations(design: UioDesign) -> ca.Function:
    """(z, fhat, u, y) -> (xhat, innovation, next_state, z_next, fhat_next), y less W2 w_centre.

    (10)-(12) without N, G, L and the split, which would be rounded (the method's page, Observer).
    """
    model, C = design.plant, ca.DM(design.C)
    sizes = {"z": len(model.x), "fhat": len(model.f), "u": len(model.u), "y": C.shape[0]}
    inputs = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    z, fhat, u, y = inputs.values()
    xhat = z - ca.DM(design.E) @ y
    innovation = y - C @ xhat
    # Outside the box the dynamics may not be defined (a level below zero); the
    # estimate is clipped there so that the recursion stays finite, in coordinates that
    # enter nonlinearly. Inside, where the bound holds, clipping does nothing.
    box = np.where(curved_states(model)[:, None], model.box("x"), [-np.inf, np.inf])
    near, middle = clip(xhat, box, design.precision), ca.DM(design.w_centre)
    next_state = model.function()(x=near, u=u, f=fhat, w=middle)["rhs"]
    outputs = {
        "xhat": xhat,
        "innovation": innovation,
        "next_state": next_state,
        "z_next": ca.DM(design.T) @ next_state + ca.DM(design.K) @ innovation,
        "fhat_next": fhat + ca.DM(design.F) @ innovation,
    }
    return ca.Function(
        "equations", list(inputs.values()), list(outputs.values()), list(inputs), list(outputs)
    )


def memory_sizes(design: UioDesign) -> dict[str, int]:
    """Return the parts of the memory: z (10), fhat (12), s of `Running`, the predicted state."""
    n, n_f = len(design.A), len(design.rate)
    return {"z": n, "fhat": n_f, "bound": n + n_f, "prediction": n}


def first_memory(
    design: UioDesign, start: Start, z0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at z_0 = T guess, or at a given z_0 as the paper does; y0 is not needed."""
    z = design.T @ start.guess
    if z0 is not None:
        z = read_vector(z0, "z0", design.plant.names("x"))
        check_range_of_T(design, z)
    return {"z": z, "fhat": start.f.mean(axis=1), "prediction": start.guess}


def shift(design: UioDesign, x: Ends) -> tuple[ca.SX, ca.SX]:
    """Return middle and radius of T x for a box of states, rounded outwards, shapes (n, 1)."""
    T, size = ca.DM(design.T), ca.DM(np.abs(design.T))
    middle = 0.5 * x.lower + 0.5 * x.upper
    radius = ca.fmax(x.upper - middle, middle - x.lower)
    share = above(design.precision, len(design.T)) - 1.0
    return T @ middle, size @ (radius + share * (ca.fabs(middle) + radius))


def first_bound(design: UioDesign, x: Ends, f: Ends, kept: Parts) -> ca.SX:
    """Return an s, delta of (48), for a state and a fault in boxes, around given z and fhat."""
    middle, radius = shift(design, x)
    z, fhat, bound = kept["z"], kept["fhat"], design.bound
    up = above(design.precision, 4 * len(bound.P[0]))
    zeta = ca.fabs(middle - z) * up + radius + (up - 1.0) * ca.fabs(z)
    e_f = ca.fmax(f.upper - fhat, fhat - f.lower) * up
    if bound.error == "plain":
        reach = ca.vertcat((zeta + ca.DM(noise_offset(design))) * up, e_f)
    else:
        reach = ca.vertcat(*(zeta[i] for i in design.kept(bound.error)), e_f)
    levels = [ca.dot(reach, ca.DM(np.abs(P)) @ reach) * up for P in bound.P]
    components = _component_map(design)
    return ca.vertcat(*(0.0 if c is None else levels[bound.shape_of(c)] for c in components))


def build_core(design: UioDesign) -> Core:
    """Build the core: `equations` and half widths, which begin anew after a missing reading."""
    bound, move = running_bound(design), equations(design)
    n, C, W2 = len(design.A), ca.DM(design.C), design.W2
    offset, noise = ca.DM(W2 @ design.w_centre), ca.DM(np.abs(W2) @ design.w_radius)
    limits, curved, precision = design.limits, curved_states(design.plant), design.precision

    def pick(one: ca.SX, other: ca.SX) -> ca.SX:
        return ca.vertcat(*(one[i] if curved[i] else other[i] for i in range(n)))

    def run(seen: Seen) -> Known:
        z, fhat, s, prediction = (seen.memory[part] for part in memory_sizes(design))
        y = seen.readings(C @ prediction + offset) - offset
        xhat, innovation, next_state, z_next, fhat_next = move(z, fhat, seen.u, y)
        half, moved = all_around([bound], s, ca.vertcat(xhat, fhat))
        x = Ends(xhat - half[:n], xhat + half[:n])
        f = Ends(fhat - half[n:], fhat + half[n:])
        # what rounding takes of the innovation and of this sum
        size = ca.fabs(y) + ca.fabs(offset) + ca.fabs(C) @ (ca.fabs(xhat) + half[:n]) + noise
        allowed = ca.fabs(C) @ half[:n] + noise + (n + 8) * Rounding(precision).step * size
        empty = some(ca.fabs(innovation[i]) > allowed[i] for i in range(allowed.numel()))
        # a state on which a derivative depends is itself in its range by assumption
        near = inside(pick(xhat, x.lower), pick(xhat, x.upper), limits.x, precision)
        sound = ca.logic_and(near, inside(fhat, fhat, limits.f, precision))
        sound = ca.logic_and(sound, inside(seen.u, seen.u, limits.u, precision))
        return Known(
            xhat,
            fhat,
            x,
            f if fhat.numel() else None,
            {
                "z": z_next,
                "fhat": fhat_next,
                "bound": moved,
                "prediction": next_state,
            },
            sound=sound,
            empty=empty,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        return {"bound": first_bound(design, x, f, kept)}

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        middle, radius = shift(design, x)
        z = Ends(middle - radius, middle + radius).nearest(kept["z"])
        if design.bound.error == "shifted":
            # a part of the box need not lie in the range of T, its middle and what was kept do
            moved = ca.logic_not(ca.sum1(ca.fabs(z - kept["z"])) <= 0.0)
            z = select(moved, middle, kept["z"])
        return {
            "z": z,
            "fhat": f.nearest(kept["fhat"]),
            "prediction": x.nearest(kept["prediction"]),
        }

    return Core(run, begin, place, nonnegative=("bound",))
