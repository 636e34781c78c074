"""The equations (6)-(8), (14) in symbols, shared by the continuous form and the step."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.designs.set_adaptive.record import SetDesign
from obsynth.symbolic.arrays import FloatArray

_PARTS = {
    "zeta_m": "n",
    "zeta_M": "n",
    "Omega_m": "nq",
    "Omega_M": "nq",
    "theta_m": "q",
    "theta_M": "q",
    "xi_m": "n",
    "xi_M": "n",
    "R_m": "qq",
    "R_M": "qq",
    "b_m": "q",
    "b_M": "q",
    "weight": "1",
}
MONITORS = ("R_m", "R_M", "b_m", "b_M", "weight")
"""Integrals that no bound is made of."""


def memory_sizes(design: SetDesign) -> dict[str, int]:
    """Return the parts: zeta (6), Omega (7), theta (8), xi (14), integrals of the monitors (13).

    theta_m is the upper and theta_M the lower bound of the fault; matrices stand row by row.
    """
    return {name: math.prod(_shape(design, letters)) for name, letters in _PARTS.items()}


def _shape(design: SetDesign, letters: str) -> tuple[int, ...]:
    n, q = design.G.shape
    return tuple({"n": n, "q": q, "1": 1}[letter] for letter in letters)


class Memory:
    """The memory by its parts: vectors as columns, matrices in their shape."""

    def __init__(self, parts: Mapping[str, ca.SX], design: SetDesign) -> None:
        self.parts: dict[str, ca.SX] = {}
        for name in _PARTS:
            value = parts[name]
            if len(_PARTS[name]) == 2:
                rows, columns = _shape(design, _PARTS[name])
                value = ca.reshape(value, columns, rows).T
            self.parts[name] = value

    def __getitem__(self, name: str) -> ca.SX:
        return self.parts[name]


def columns(parts: Mapping[str, ca.SX]) -> dict[str, ca.SX]:
    """Return parts as they are stored, matrices row by row."""
    return {
        name: ca.vec(value.T) if len(_PARTS[name]) == 2 else value for name, value in parts.items()
    }


@dataclass(frozen=True, eq=False)
class Drive:
    """M = A_o - L C (n, n), what drives it, c (n, 1), and the magnitudes of its terms."""

    M: ca.SX
    c: ca.SX
    size: ca.SX


def ends(design: SetDesign, low: ca.SX, high: ca.SX, clipped: bool) -> tuple[ca.SX, ca.SX]:
    """Turn ends of the outputs C x into ends of the measured states, in the order of the bounds."""
    names = design.plant.names("x")
    first, second = [], []
    for state in design.bounds.states:
        i = names.index(state.name)
        k = int(np.argmax(design.C[:, i]))
        scale = float(design.C[k, i])
        a, b = low[k] / scale, high[k] / scale
        if clipped:
            a = ca.fmin(ca.fmax(a, state.lower), state.upper)
            b = ca.fmin(ca.fmax(b, state.lower), state.upper)
        first.append(a)
        second.append(b)
    return ca.vertcat(*first), ca.vertcat(*second)


Pair = tuple[ca.SX, ca.SX]
"""Lower and upper ends."""


@dataclass(frozen=True, eq=False)
class Balance:
    """The plant between ends of measured states: of A(rho) and of B u + offset, and its size."""

    A: Pair
    forced: Pair
    size: ca.SX


def balance(design: SetDesign, states: Pair, u: ca.SX, exact: ca.SX) -> Balance:
    """Bound the plant between ends of the measured states."""
    values = design.bounds.function()(*states, exact)
    A, B, offset = (values[2 * i : 2 * i + 2] for i in range(3))
    push, pull = ca.fmax(u, 0.0), ca.fmin(u, 0.0)
    low, high = (B[o] @ push + B[1 - o] @ pull + offset[o] for o in (0, 1))
    size = ca.fmax(ca.fabs(B[0]), ca.fabs(B[1])) @ ca.fabs(u)
    size = size + ca.fmax(ca.fabs(offset[0]), ca.fabs(offset[1]))
    return Balance((A[0], A[1]), (low, high), size)


def drives(
    design: SetDesign, states: Pair, outputs: Pair, u: ca.SX, exact: ca.SX, x: Pair
) -> tuple[Drive, Drive]:
    """Return the lower and the upper bounding system; x are ends of all states."""
    found, frame, given = balance(design, states, u, exact), design.frame, design.coordinates
    A, forced, size = found.A, found.forced, found.size
    M = [end - ca.DM(design.L @ design.C) for end in A]
    if given is not None and frame.own is not None:
        own, S, M = ca.DM(frame.own), np.abs(given.S), [ca.SX(ca.DM(given.D))] * 2
        low, high = image(given.S, *A)
        rest = product((low - own, high - own), x)
        low, high = image(given.S, *forced)
        forced = low + rest[0], high + rest[1]
        terms = ca.DM(S) @ ca.fmax(ca.fabs(A[0]), ca.fabs(A[1])) + ca.fabs(own)
        size = ca.DM(S) @ size + terms @ ca.fmax(ca.fabs(x[0]), ca.fabs(x[1]))
    centre, radius = design.w_centre, design.w_radius
    spread = ca.DM(np.abs(frame.W1) @ radius)
    size = size + ca.DM(np.abs(frame.W1) @ (np.abs(centre) + radius))
    size = size + ca.DM(np.abs(design.L)) @ ca.fmax(ca.fabs(outputs[0]), ca.fabs(outputs[1]))
    made = []
    for o, fed in enumerate(image(design.L, *outputs)):
        c = forced[o] + ca.DM(frame.W1 @ centre) + (spread if o else -spread) + fed
        made.append(Drive(M[o], ca.densify(c), ca.densify(size)))
    return made[0], made[1]


def speeds(design: SetDesign, states: Pair, u: ca.SX, exact: ca.SX, x: Pair) -> Pair:
    """Return the ends of x' for states between ends and faults in their declared ranges."""
    found = balance(design, states, u, exact)
    low, high = product(found.A, x)
    w, f = design.w_radius, design.plant.box("f")
    bias = ca.DM(design.W1 @ design.w_centre)
    spread = ca.DM(np.abs(design.W1) @ w)
    faults = image(design.G, *(ca.SX(ca.DM(end)) for end in f.T))
    size = ca.fmax(ca.fabs(found.A[0]), ca.fabs(found.A[1])) @ ca.fmax(ca.fabs(x[0]), ca.fabs(x[1]))
    size = size + found.size + ca.DM(np.abs(design.W1) @ (np.abs(design.w_centre) + w))
    size = design.rounding * (size + ca.DM(np.abs(design.G) @ np.abs(f).max(axis=1)))
    return (
        low + found.forced[0] + bias - spread + faults[0] - size,
        high + found.forced[1] + bias + spread + faults[1] + size,
    )


def responses(design: SetDesign, memory: Memory) -> tuple[ca.SX, ca.SX]:
    """Return N_m and N_M, (m, q) each: N_m theta <= r_m and r_M <= N_M theta, see `residuals`."""
    low, high = image(design.frame.C, memory["Omega_m"], memory["Omega_M"])
    return -low, -high


def residuals(design: SetDesign, memory: Memory, low: ca.SX, high: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return r_m = y_high - C zeta_m and r_M = y_low - C zeta_M, (m, 1) each, C by its signs."""
    ends = image(design.frame.C, memory["zeta_m"], memory["zeta_M"])
    return high - ends[0], low - ends[1]


@dataclass(frozen=True, eq=False)
class Pull:
    """factor * fault is on one side of rest, 0 where an output is silent; size: of their terms."""

    factor: ca.SX
    rest: ca.SX
    size: ca.SX


def pulls(
    design: SetDesign, memory: Memory, r: tuple[ca.SX, ca.SX], sizes: ca.SX
) -> tuple[list[list[Pull]], list[list[Pull]]]:
    """Return what bounds every fault from above and below, others in their bounds, by N's signs."""
    N, size = responses(design, memory), sizes + shown_size(design, memory)
    bounds = memory["theta_m"], memory["theta_M"]
    found: tuple[list[list[Pull]], list[list[Pull]]] = ([], [])
    for i, k in enumerate(design.fault_outputs.tolist()):
        others = [j for j in range(len(design.Gamma)) if j != i]
        rests = []
        for matrix, residual, least in ((N[0], r[0], ca.fmin), (N[1], r[1], ca.fmax)):
            rest = residual[k]
            for j in others:
                rest = rest - least(*(matrix[k, j] * bound[j] for bound in bounds))
            rests.append((matrix[k, i], rest))
        for made, sides in zip(found, ((ca.fmax, ca.fmin), (ca.fmin, ca.fmax)), strict=True):
            pairs = zip(sides, rests, strict=True)
            made.append([Pull(side(n, 0.0), rest, size[k]) for side, (n, rest) in pairs])
    return found


def shown_size(design: SetDesign, memory: Memory) -> ca.SX:
    """Return the magnitudes of what zeta - Omega theta shows, (m, 1), summed."""
    faults = ca.fmax(ca.fabs(memory["theta_m"]), ca.fabs(memory["theta_M"]))
    zeta, Omega = (
        ca.fmax(ca.fabs(memory[f"{name}_m"]), ca.fabs(memory[f"{name}_M"]))
        for name in ("zeta", "Omega")
    )
    size: ca.SX = ca.DM(np.abs(design.frame.C)) @ (zeta + Omega @ faults)
    return size


def theta_rates(design: SetDesign, memory: Memory, r: tuple[ca.SX, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the derivatives of theta_m and theta_M by the law of the method's page."""
    own = memory["theta_m"], memory["theta_M"]
    if design.law == "printed":
        pairs = zip(responses(design, memory), r, own, strict=True)
        first, second = (ca.DM(design.Gamma) * (N.T @ (rest - N @ end)) for N, rest, end in pairs)
        return first, second
    rates = []
    for found, end in zip(pulls(design, memory, r, ca.SX.zeros(len(design.C))), own, strict=True):
        parts = [
            sum(gain * p.factor * (p.rest - p.factor * end[i]) for p in found[i])
            for i, gain in enumerate(design.Gamma.tolist())
        ]
        rates.append(ca.vertcat(*parts))
    return rates[0], rates[1]


def image(matrix: FloatArray, low: ca.SX, high: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M a for every a between two ends, columns or matrices."""
    plus, minus = ca.DM(np.maximum(matrix, 0.0)), ca.DM(np.minimum(matrix, 0.0))
    return plus @ low + minus @ high, plus @ high + minus @ low


def carried(
    matrix: FloatArray | None, low: ca.SX, high: ca.SX, share: float
) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M a outside of what rounding may do, a share of the terms' magnitudes."""
    if matrix is None:
        return low, high
    first, second = image(matrix, low, high)
    slack = share * (ca.DM(np.abs(matrix)) @ ca.fmax(ca.fabs(low), ca.fabs(high)))
    return first - slack, second + slack


def product(M: tuple[ca.SX, ca.SX], x: tuple[ca.SX, ca.SX]) -> tuple[ca.SX, ca.SX]:
    """Return the ends of M x, column, for a matrix and a column between two ends each."""
    ends: tuple[list[ca.SX], list[ca.SX]] = ([], [])
    for i in range(M[0].shape[0]):
        low, high = ca.SX(0), ca.SX(0)
        for j in range(M[0].shape[1]):
            corners = [a[i, j] * b[j] for a in M for b in x]
            low = low + ca.fmin(ca.fmin(*corners[:2]), ca.fmin(*corners[2:]))
            high = high + ca.fmax(ca.fmax(*corners[:2]), ca.fmax(*corners[2:]))
        ends[0].append(low)
        ends[1].append(high)
    return ca.vertcat(*ends[0]), ca.vertcat(*ends[1])
