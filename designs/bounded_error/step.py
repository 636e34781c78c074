"""What runs: equations (10)-(12), half-width recursions (33)-(36) and their first values."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.bounded_error.lmis import kept_coordinates
from obsynth.designs.bounded_error.peak.design import peak_data
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign, ellipsoid_of
from obsynth.designs.core.given import Start, read_vector
from obsynth.designs.core.stepping import (
    all_finite,
    clip,
    finite_or,
    inside,
    largest_level,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

ROUND_UP = 1.0 + 2.0**-50
# covers the rounding of estimate - half and estimate + half
ULPS = 2.0**-50
# Above the relative rounding error of the few dozen operations of each formula below.
UP = 1.0 + 2.0**-44


@dataclass(frozen=True, eq=False)
class RuntimeBound:
    """How the guaranteed half widths evolve: ``s+ = decay s + offset``.

    The half widths are ``sqrt(reach s) + add`` if `root` is set (ellipsoids, eqs. (35)-(36), one s
    per component) and ``reach s + add`` otherwise (peak bounds, see `Fading`). Shapes: decay
    (k, k), offset (k,), reach (n + n_f, k), add (n + n_f,).

    reset: value of s that holds whenever the state, the fault and their estimates lie in the
        declared boxes; infinite where no such box is declared
    """

    decay: FloatArray
    offset: FloatArray
    reach: FloatArray
    add: FloatArray
    root: bool
    reset: FloatArray

    def half_widths(self, s: FloatArray) -> FloatArray:
        """Return the half widths that belong to a value of s."""
        inner = self.reach @ s
        return (np.sqrt(inner) if self.root else inner) * ROUND_UP + self.add

    @property
    def steady(self) -> FloatArray:
        """Half widths in the limit k to infinity."""
        limit = np.linalg.solve(np.eye(len(self.decay)) - self.decay, self.offset)
        return self.half_widths(np.asarray(limit, dtype=float))


def noise_offset(design: UioDesign) -> FloatArray:
    """Return the bound of ``E W2 w_k``, which separates e from zeta, shape (n,)."""
    bound: FloatArray = np.abs(design.E) @ (np.abs(design.W2) @ design.w_radius) * UP
    return bound


class StartBox:
    """Where the error can be at k = 0, as boxes of zeta, e and e_f.

    z0 (n,)
    x_range (n, 2)
    fhat0 (n_f,)
    f_range (n_f, 2)
    """

    def __init__(
        self,
        design: UioDesign,
        z0: FloatArray,
        x_range: FloatArray,
        fhat0: FloatArray,
        f_range: FloatArray,
    ) -> None:
        middle, radius = x_range.mean(axis=1), 0.5 * (x_range[:, 1] - x_range[:, 0])
        reach = np.abs(design.T) @ (np.abs(middle) + radius) + np.abs(z0)
        slack = 2.0**-44 * reach
        spread = np.abs(design.T) @ radius + slack
        centre = design.T @ middle - z0
        noise = noise_offset(design)
        self.zeta = (centre - spread, centre + spread)
        self.e = (self.zeta[0] - noise, self.zeta[1] + noise)
        self.e_f = (f_range[:, 0] - fhat0, f_range[:, 1] - fhat0)

    def xi(self, design: UioDesign, error: str) -> tuple[FloatArray, FloatArray]:
        """Box of the error coordinates, (lower, upper)."""
        if error == "plain":
            sides = self.e
        else:
            kept = kept_coordinates(design.T)
            sides = (self.zeta[0][kept], self.zeta[1][kept])
        return (
            np.concatenate([sides[0], self.e_f[0]]),
            np.concatenate([sides[1], self.e_f[1]]),
        )


def _component_map(design: UioDesign, bound: EllipsoidBound) -> list[int | None]:
    """For each of the n + n_f errors the component of xi that bounds it, or None."""
    n, n_f = design.A.shape[0], design.rate.size
    if bound.error == "plain":
        return list(range(n + n_f))
    kept = kept_coordinates(design.T)
    states: list[int | None] = [kept.index(i) if i in kept else None for i in range(n)]
    return states + [len(kept) + j for j in range(n_f)]


def ellipsoid_runtime(design: UioDesign) -> RuntimeBound:
    """Return the recursion of eq. (36) for every component, rounding errors of the step included.

    An error of at most `UioDesign.rounding` per step is at most rho in the norm
    of P, so ``V+ <= ((1 - gamma) V + gamma) (1 + rho) + rho + rho^2``.
    """
    bound = ellipsoid_of(design)
    n, n_f = design.A.shape[0], design.rate.size
    size = n + n_f
    decay, offset, scale = np.zeros(size), np.zeros(size), np.zeros(size)
    add = design.rounding * UP
    if bound.error == "shifted":
        add[:n] += noise_offset(design)
    reset = np.full(size, np.inf)
    box = reset_box(design)
    for i, component in enumerate(_component_map(design, bound)):
        if component is None:
            continue
        shape = bound.shape_of(component)
        gamma, P = float(bound.gamma[shape]), bound.P[shape]
        kept = [j for j, c in enumerate(_component_map(design, bound)) if c is not None]
        tau = design.rounding[kept]
        rho = float(np.sqrt(tau @ np.abs(P) @ tau)) * UP
        decay[i] = (1.0 - gamma) * (1.0 + rho) * UP
        offset[i] = (gamma * (1.0 + rho) + rho + rho**2) * UP
        scale[i] = bound.inverse_diagonal[component] * UP
        if box is not None:
            reset[i] = largest_level(P, *box.xi(design, bound.error))
    return RuntimeBound(np.diag(decay), offset, np.diag(scale), add, True, reset)


def reset_box(design: UioDesign) -> StartBox | None:
    """Return the errors when state, fault and their estimates lie in their declared boxes."""
    x_box, f_box = design.plant.box("x"), design.plant.box("f")
    if not (np.isfinite(x_box).all() and np.isfinite(f_box).all()):
        return None
    if isinstance(design.bound, EllipsoidBound) and design.bound.error == "shifted":
        # zeta has to lie in the range of T, which a missing measurement does not keep.
        return None
    width, f_width = np.diff(x_box)[:, 0], np.diff(f_box)[:, 0]
    n, n_f = design.A.shape[0], design.rate.size
    box = StartBox(design, np.zeros(n), np.zeros((n, 2)), np.zeros(n_f), np.zeros((n_f, 2)))
    noise = noise_offset(design)
    box.e = (-width, width)
    box.zeta = (-width - noise, width + noise)
    box.e_f = (-f_width, f_width)
    return box


def check_range_of_T(design: UioDesign, bound: EllipsoidBound, z: FloatArray) -> None:
    """Refuse a first z that a recursion in the range of T would not keep."""
    if bound.error == "shifted" and np.any(design.T @ z != z):
        raise ObsynthError(
            "z0 has to lie in the range of T (zero in the coordinates that the unknown input "
            'takes away) for error="shifted"; give the guess alone',
            z0=z,
        )


def first_levels(design: UioDesign, box: StartBox) -> FloatArray:
    """Return V_0 of every component's ellipsoid for a box of first errors, delta of (48)."""
    bound = ellipsoid_of(design)
    lower, upper = box.xi(design, bound.error)
    levels = [largest_level(P, lower, upper) for P in bound.P]
    components = _component_map(design, bound)
    return np.array([0.0 if c is None else levels[bound.shape_of(c)] for c in components])


def first_fading(design: UioDesign, box: StartBox) -> FloatArray:
    """Return the first s of peak bounds for a box of first errors, see `Fading`."""
    zeta, e_f = (np.max(np.abs(sides), axis=0) for sides in (box.zeta, box.e_f))
    first: FloatArray = peak_data(design).fading.start @ np.concatenate([zeta, e_f]) * UP
    return first


def peak_runtime(design: UioDesign) -> RuntimeBound:
    """Return the recursion of what the first error adds to the peak bounds.

    Underflow of its products is far below the rounding that `add` counts a second time.
    """
    bound = peak_data(design)
    fading, box = bound.fading, reset_box(design)
    count = len(fading.G)
    return RuntimeBound(
        decay=fading.G * UP,
        offset=np.zeros(count),
        reach=fading.reach * UP,
        add=(bound.b[: len(fading.reach)] + design.rounding) * ROUND_UP,
        root=False,
        reset=np.full(count, np.inf) if box is None else first_fading(design, box),
    )


def memory_sizes(design: UioDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``z`` (10), ``fhat`` (12), ``bound`` (the s of `RuntimeBound`),
    ``prediction`` (of the state, used when a measurement is missing) and
    ``initialised`` (0 or 1).
    """
    n, n_f = len(design.A), len(design.rate)
    ellipsoid = isinstance(design.bound, EllipsoidBound)
    bound = n + n_f if ellipsoid else len(peak_data(design).fading.G)
    return {"z": n, "fhat": n_f, "bound": bound, "prediction": n, "initialised": 1}


def running_bound(design: UioDesign) -> RuntimeBound:
    """Return how the half widths of a design evolve."""
    ellipsoid = isinstance(design.bound, EllipsoidBound)
    return ellipsoid_runtime(design) if ellipsoid else peak_runtime(design)


def first_memory(
    design: UioDesign, start: Start, z0: ArrayLike | None = None
) -> dict[str, ArrayLike]:
    """Start at z_0 = T guess, or at a given z_0 as the paper does; y0 is not needed."""
    x_box, z = start.x, design.T @ start.guess
    if z0 is not None:
        z = read_vector(z0, "z0", design.plant.names("x"))
        if isinstance(design.bound, EllipsoidBound):
            check_range_of_T(design, design.bound, z)
    fhat = start.f.mean(axis=1)
    box = StartBox(design, z, x_box, fhat, start.f)
    first = first_levels if isinstance(design.bound, EllipsoidBound) else first_fading
    return {"z": z, "fhat": fhat, "bound": first(design, box), "prediction": start.guess}


def equations(design: UioDesign) -> ca.Function:
    """(z, fhat, u, y) -> (xhat, innovation, next_state, z_next, fhat_next), y less W2 w_centre.

    Equations (10)-(12) with N = T A - K C and L = K - N E are, with the
    innovation nu_k = y_k - C xhat_k, the same as

        z_{k+1}    = T f(xhat_k, u_k, fhat_k) + K nu_k ,
        xhat_k     = z_k - E y_k ,
        fhat_{k+1} = fhat_k + F nu_k ,

    where f is the plant's own right-hand side without unknown input. This form
    needs neither the split nor N, G, L, so nothing is lost by rounding them.
    """
    model, C = design.plant, ca.DM(design.C)
    sizes = {"z": len(model.x), "fhat": len(model.f), "u": len(model.u), "y": C.shape[0]}
    inputs = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    z, fhat, u, y = inputs.values()
    xhat = z - ca.DM(design.E) @ y
    innovation = y - C @ xhat
    # Outside the box the dynamics may not be defined (a level below zero); the
    # estimate is clipped there so that the recursion stays finite. Inside, where
    # the guarantee holds, clipping does nothing.
    next_state = model.function()(
        clip(xhat, model.box("x")),
        u,
        ca.DM.zeros(len(model.d)),
        fhat,
        ca.DM(design.w_centre),
        ca.DM.zeros(len(model.p)),
        ca.DM.zeros(len(model.rho)),
    )[0]
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


def build_step(design: UioDesign) -> ca.Function:
    """Build `Observer.step` of the bounded-error observer from its `equations`."""
    bound = running_bound(design)
    model, C, W2, w_centre = design.plant, design.C, design.W2, design.w_centre
    n, n_u, n_f, m = len(model.x), len(model.u), len(model.f), C.shape[0]
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", n_u), ca.SX.sym("y", m)
    z, fhat, s, prediction = (memory[layout[k]] for k in ("z", "fhat", "bound", "prediction"))
    initialised = memory[layout["initialised"]] > 0.5
    box, f_box = model.box("x"), model.box("f")

    y_shifted = y - ca.DM(W2 @ w_centre)
    y_finite, u_finite = all_finite(y), all_finite(u)
    expected = ca.DM(C) @ prediction
    y_used = finite_or(y_shifted, expected)
    nominal = [0.0 if signal.nominal is None else float(signal.nominal) for signal in model.u]
    u_used = finite_or(u, nominal)

    xhat, innovation, next_state, z_next, fhat_next = equations(design)(z, fhat, u_used, y_used)
    xhat_inside = inside(xhat, xhat, box)
    fhat_inside = inside(fhat, fhat, f_box)
    can_reset = ca.logic_and(xhat_inside, fhat_inside)
    known = ca.logic_and(y_finite, all_finite(s))
    again = ca.logic_and(y_finite, can_reset) if np.all(np.isfinite(bound.reset)) else ca.SX(0)
    s_now = select(known, s, ca.SX(bound.reset))
    have_bound = ca.logic_or(known, again)
    inner = ca.sparsify(ca.DM(bound.reach)) @ s_now
    estimate = ca.vertcat(xhat, fhat)
    half = (ca.sqrt(inner) if bound.root else inner) * ROUND_UP + ca.DM(bound.add)
    half = half + ULPS * ca.fabs(estimate)
    valid = ca.logic_and(initialised, have_bound)
    half = ca.vertcat(*(ca.if_else(valid, half[i], ca.inf) for i in range(n + n_f)))
    x_lower, x_upper = xhat - half[:n], xhat + half[:n]
    f_lower, f_upper = fhat - half[n:], fhat + half[n:]

    allowed = ca.DM(np.abs(C)) @ half[:n] + ca.DM(np.abs(W2) @ design.w_radius)
    consistent = ca.SX(1)
    for i in range(m):
        consistent = ca.logic_and(consistent, ca.fabs(innovation[i]) <= allowed[i])
    status = status_word(
        {
            "not_initialised": ca.logic_not(initialised),
            "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
            "outside_domain": ca.logic_not(
                ca.logic_and(inside(x_lower, x_upper, box), xhat_inside)
            ),
            "void": ca.logic_not(consistent),
            "fault_not_valid": ca.logic_not(valid),
        }
    )

    s_next = ca.sparsify(ca.DM(bound.decay)) @ s_now + ca.DM(bound.offset)
    s_next = select(
        ca.logic_and(have_bound, u_finite), s_next, ca.SX(np.full(len(bound.reset), np.inf))
    )
    moved = ca.vertcat(z_next, fhat_next, s_next, next_state, 1)
    return make_step(
        {"memory": memory, "u": u, "y": y},
        {
            "memory": select(initialised, moved, memory),
            "xhat": xhat,
            "fhat": fhat,
            "x_lower": x_lower,
            "x_upper": x_upper,
            "f_lower": f_lower,
            "f_upper": f_upper,
            "status": status,
        },
    )
