"""What rounding adds to the error of one step, proved for the stored gains.

The step as it runs differs from equations (10)-(12) over real numbers with the plant's own
constants by what `rounding_bound` says of `equations`; what else is rounded moves the error as an
unknown reading and an unknown input would (docs/methods/bounded_error_uio.md, Rounding). All of it
is at most `UioDesign.rounding`, which bounds and recursions count as a disturbance.
"""

import functools
from collections.abc import Mapping
from dataclasses import replace

import casadi as ca
import numpy as np

from obsynth.derive.rigour import ExactMatrix
from obsynth.derive.structure.conditions import decouple
from obsynth.designs.bounded_error.model import rounding_allowance
from obsynth.designs.bounded_error.record import UioDesign
from obsynth.designs.bounded_error.step import equations
from obsynth.designs.core.boxes import cut_box
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.rounding import rounding_bound
from obsynth.designs.core.signals import finite_box
from obsynth.symbolic.arrays import FloatArray

CELLS = 256
# Of the magnitude of the states, in doubles: above it a bound is no help, and an assumption more
# honest. In single precision nothing is assumed.
USEFUL = 2.0**-30
# What boxes of estimates and readings are widened by, relative to their size.
WIDER = {"double": 2.0**-40, "single": 2.0**-14}
# Above the rounding of the formulas here, all of whose terms are nonnegative.
UP = 1.0 + 2.0**-40
# What is stored above what was found, so that another library finds it proved too.
ROOM = 1.0 + 2.0**-10


def _through(design: UioDesign, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bound what readings off by delta (m,) add to xi in a step, (n + n_f,), and to x - xhat."""
    E, K, F, C = (np.abs(part) for part in (design.E, design.K, design.F, design.C))
    before = E @ delta
    seen = C @ before + delta
    return np.concatenate([_moved(design) @ before + K @ seen, F @ seen]), before


def _moved(design: UioDesign) -> FloatArray:
    """Bound |T (A + M)| over the family."""
    family = design.family
    reach = np.abs(family.ranges).max(axis=1, initial=0.0)
    slope = np.abs(design.A) + np.abs(family.constant) + family.radius
    slope = slope + np.tensordot(reach, np.abs(family.directions), axes=1)
    return np.asarray(np.abs(design.T) @ slope)


def of_matrices(design: UioDesign, off: Mapping[str, FloatArray]) -> FloatArray:
    """Bound what rounding the matrices of the split, by `off`, adds in one step, (n + n_f,)."""
    plant = design.plant
    x, f, _ = (np.abs(box).max(axis=1, initial=0.0) for box in design.limits)
    d, w = (np.abs(finite_box(plant, kind)).max(axis=1, initial=0.0) for kind in "dw")
    found, before = _through(design, off["C"] @ x + off["W2"] @ w)
    moved = off["D"] @ d + off["B_f"] @ (2.0 * f) + off["W1"] @ design.w_radius
    n = len(x)
    state = np.maximum(found[:n] + np.abs(design.T) @ moved, before)
    return np.concatenate([state, found[n:]]) * UP


def of_step(design: UioDesign) -> FloatArray:
    """Bound what one step as it runs adds to xi and to the returned estimates, (n + n_f,)."""
    plant, C, E = design.plant, design.C, design.E
    limits, n = design.limits, len(design.A)
    shift = design.W2 @ design.w_centre
    X = limits.x
    w_radius = np.abs(design.W2) @ design.w_radius
    y = _product(C, X) + shift[:, None] + w_radius[:, None] * [-1.0, 1.0]
    known_to = WIDER[design.precision]
    y = _outward(y, known_to)
    lo, hi = cut_box(X, CELLS)
    shown = _outward(y - shift[:, None], known_to)[:, :, None]
    # one step of rounding may take the exact estimate out of a box that the computed one is in
    cell = _outward(np.stack([lo, hi], axis=1), known_to)
    z = _outward(cell + _product(E, shown), known_to)
    nu = _outward(shown - _product(C, cell)[:, ::-1], known_to)
    box = {"z": z, "fhat": limits.f[:, :, None], "u": limits.u[:, :, None], "y": y[:, :, None]}
    known, precision = {"xhat": cell, "innovation": nu}, design.precision
    found = rounding_bound(
        _readings(design, shift),
        {name: (part[:, 0], part[:, 1]) for name, part in box.items()},
        precision,
        {name: (part[:, 0], part[:, 1]) for name, part in known.items()},
        read=("y",),
    )
    if np.any(found["xhat"].error > known_to * np.abs(cell).max(axis=(1, 2))):
        return np.full(n + len(design.F), np.inf)
    # stored T for I + E C, W2 w_centre formed in doubles, what is left of the unknown input
    missing = ExactMatrix.of(np.eye(n)) + ExactMatrix.of(E) @ ExactMatrix.of(C)
    missing = missing - ExactMatrix.of(design.T)
    noise = 2.0**-50 * len(design.w_centre) * (np.abs(design.W2) @ np.abs(design.w_centre))
    moved, before = _through(design, noise)
    residual = decouple(C, design.D).residual
    d = np.abs(plant.box("d")).sum() if residual > 0.0 else 0.0
    shaken = found["xhat"].error
    state = found["z_next"].error + moved[:n] + _moved(design) @ shaken + residual * d
    state = state + np.abs(missing.to_floats()) @ found["next_state"].size
    fault = found["fhat_next"].error + moved[n:]
    return np.concatenate([np.maximum(state, shaken + before), fault]) * UP


def _readings(design: UioDesign, shift: FloatArray) -> ca.Function:
    """Return the equations for readings as they come."""
    inner = equations(design)
    names = inner.name_in()
    inputs = [ca.SX.sym(name, inner.numel_in(k)) for k, name in enumerate(names)]
    outputs = [*inner(*inputs[:-1], inputs[-1] - ca.DM(shift))]
    return ca.Function("readings", inputs, outputs, names, inner.name_out())


def _product(matrix: FloatArray, box: FloatArray) -> FloatArray:
    """Return the box of a matrix times a box, (rows, 2, ...)."""
    positive, negative = np.maximum(matrix, 0.0), np.minimum(matrix, 0.0)
    first, second = np.tensordot(positive, box, axes=1), np.tensordot(negative, box, axes=1)
    return np.asarray(first + second[:, ::-1])


def _outward(box: FloatArray, share: float) -> FloatArray:
    """Widen a box, (rows, 2, ...), by more than forming it took and rounding of what is in it."""
    slack = share * np.abs(box).max(axis=(1, *range(2, box.ndim)), initial=1e-300)
    slack = slack.reshape(-1, *[1] * (box.ndim - 2))
    return np.stack([box[:, 0] - slack, box[:, 1] + slack], axis=1)


@functools.lru_cache(maxsize=8)
def step_error(design: UioDesign) -> tuple[FloatArray, bool]:
    """Return what the allowance has to hold of one step, and whether that is proved or assumed."""
    step = of_step(design)
    size = max(1.0, float(np.abs(finite_box(design.plant, "x")).max()))
    if np.all(step <= USEFUL * size) or design.precision == "single":
        return step, True
    return rounding_allowance(design.plant, decouple(design.C, design.D).residual), False


def settle(design: UioDesign, off: Mapping[str, FloatArray]) -> UioDesign:
    """Return a design with gains, its allowance that of the gains; see `of_matrices` for off."""
    needed = step_error(design)[0] + of_matrices(design, off)
    if not np.isfinite(needed).all():
        raise InfeasibleDesign(
            "rounding of the step in single precision has no bound",
            ["take precision='double', or narrower ranges"],
        )
    return replace(design, rounding=needed * ROOM)


def prove_rounding(design: UioDesign) -> Claim:
    """Compare the allowance with what one step needs."""
    step, is_proved = step_error(design)
    room = float((design.rounding - step).min(initial=np.inf))
    return Claim(
        "rounding",
        "the rounding error of one step is within the allowance"
        if is_proved
        else "the allowance for rounding is not below 2^-40 of the ranges, which is assumed enough",
        room >= 0.0,
        room,
        "interval analysis of the rounding of every instruction" if is_proved else "comparison",
    )
