"""The run-time functions of the bank: envelopes between samples, unmeasured states, filters."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import LIMITS, Ends, column, every, some
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.stepping import make_ode, slices
from obsynth.designs.filter_bank.record import UNKNOWN, BankDesign
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_PASSES = 3
_WIDER = 1.05
_EXTRA = 1e-12


def memory_sizes(design: BankDesign) -> dict[str, int]:
    """Return the parts of the memory (the method's page); filters: faults first, then rates.

    ``shown``: what the outputs' states are known to be if the next measurement is missing.
    """
    n_z, m = len(design.hidden), len(design.outputs)
    n_l = len(design.filters) * len(design.gain)
    sizes = {
        "hidden_lower": n_z,
        "hidden_upper": n_z,
        "filter_lower": n_l,
        "filter_upper": n_l,
        "response": n_l,
        "shown_lower": m,
        "shown_upper": m,
    }
    return {name: size for name, size in sizes.items() if size}


def first_memory(design: BankDesign, start: Start) -> dict[str, FloatArray]:
    """Start from a box of the state; guess and y0 are not used, faults have declared ranges."""
    box = design.region
    if start.x_range is not None:
        box = np.column_stack(
            [np.maximum(start.x[:, 0], box[:, 0]), np.minimum(start.x[:, 1], box[:, 1])]
        )
    if np.any(box[:, 0] > box[:, 1]):
        raise ObsynthError("x_range lies outside of the region of the bank", option="x_range")
    ends = outward(box, design.precision).T
    return {name: np.array(part).ravel() for name, part in begun(design, [*ends]).items()}


def begun(design: BankDesign, ends: Sequence[Any]) -> dict[str, Any]:
    """Return the parts of the memory that are not zero for a state between two ends."""
    parts = {}
    rows = np.repeat(design.fault_rows, len(design.filters)).tolist()
    for side, end in zip(("lower", "upper"), ends, strict=True):
        parts[f"filter_{side}"] = end[rows]
        parts[f"shown_{side}"] = end[design.outputs.tolist()]
        if design.hidden:
            parts[f"hidden_{side}"] = end[design.hidden]
    return parts


@dataclass(frozen=True, eq=False)
class Corners:
    """Evaluates single equations at the corner of a box where they are smallest or largest."""

    design: BankDesign
    u: ca.SX
    theta: ca.SX

    def rate(
        self,
        row: int,
        side: int,
        low: ca.SX,
        high: ca.SX,
        own: ca.SX | None = None,
        faults: bool = True,
    ) -> ca.SX:
        """Return the least (side 0) or largest (1) derivative of a state over a box of states."""
        design = self.design
        arguments = {}
        for kind in UNKNOWN:
            signs = design.signs[kind][row]
            box = design.plant.box(kind)
            ends = (low, high) if kind == "x" else (ca.SX(box[:, 0]), ca.SX(box[:, 1]))
            corner = [ends[side if signs[j] >= 0 else 1 - side][j] for j in range(len(signs))]
            if kind == "x" and own is not None:
                corner[row] = own
            if kind == "f" and not faults:
                corner = [ca.SX(0)] * len(signs)
            if kind == "rho":
                measured = [s for s in design.plant.rho if s.measured]
                for k, signal in enumerate(measured):
                    corner[design.plant.rho.index(signal)] = self.theta[k]
            arguments[kind] = column(corner)
        value: ca.SX = design.plant.function()(u=self.u, **arguments)["rhs"][row]
        return value


def build_core(design: BankDesign) -> Core:
    """Build the bank: docs/methods/filter_bank.md, Equations of the step."""
    outputs = design.outputs.tolist()
    box = outward(design.region, design.precision)
    region, precision = ca.DM(box), design.precision

    def run(seen: Seen) -> Known:
        parts = seen.memory
        corners = Corners(design, seen.u, seen.theta)
        told = _from_outputs(design, seen.y)
        expected = parts["shown_lower"], parts["shown_upper"]
        shown = tuple(
            ca.vertcat(*(ca.if_else(bit, now[k], then[k]) for k, bit in enumerate(seen.used)))
            for now, then in zip(told, expected, strict=True)
        )
        contradicted = some(
            ca.logic_or(shown[0][k] > expected[1][k], shown[1][k] < expected[0][k])
            for k in range(len(outputs))
        )
        low, high = _states(design, parts, shown)
        low, high = ca.fmax(low, region[:, 0]), ca.fmin(high, region[:, 1])
        f = telling(fault_intervals(design, parts, shown))
        X, contained = _envelope(design, corners, low, high)
        moved, hull = _move_hidden(design, corners, parts, X)
        moved |= _move_filters(design, corners, parts, X, hull)
        for side, ends in zip(("lower", "upper"), X, strict=True):
            moved[f"shown_{side}"] = ca.vertcat(*(ends[i] for i in outputs))
        x = Ends(low, high)
        return Known(
            x.middle(design.precision),
            f.middle(design.precision),
            x,
            f,
            moved,
            sound=contained,
            empty=contradicted,
        )

    def begin(x: Ends, f: Ends, kept: Parts) -> Parts:
        response = ca.SX.zeros(len(design.gain) * len(design.filters))
        near = x.meet(Ends.of(box, precision))
        return {**begun(design, (near.lower, near.upper)), "response": response}

    return Core(run, begin, domain=box, bridges=True, mean_fault=True)


def build_ode(design: BankDesign) -> ca.Function:
    """Build the continuous form of the bank, with y(t) known at all times up to its noise."""
    plant = design.plant
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", max(part.stop for part in layout.values()))
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    corners = Corners(design, u, theta)
    parts = {name: memory[part] for name, part in layout.items()}
    low, high = _states(design, parts, _from_outputs(design, y))
    rates = {name: ca.SX(part.stop - part.start, 1) for name, part in layout.items()}
    rows = set(design.fault_rows.tolist())
    for o, (side, ends) in enumerate((("lower", low), ("upper", high))):
        hidden = [corners.rate(i, o, low, high, own=ends[i]) for i in design.hidden]
        if hidden:
            rates[f"hidden_{side}"] = ca.vertcat(*hidden)
        # What a measured state may be without a reading: these ends drift apart, never too near.
        own = [parts[f"shown_{side}"][k] for k in range(len(design.outputs))]
        pairs = zip(design.outputs.tolist(), own, strict=True)
        moves = [corners.rate(i, o, low, high, own=end) for i, end in pairs]
        rates[f"shown_{side}"] = ca.vertcat(*moves)
        balance = {i: corners.rate(i, o, low, high, faults=False) for i in rows}
        filters = zip(design.bank, ca.vertsplit(parts[f"filter_{side}"]), strict=True)
        drift = [balance[i] + rate * (ends[i] - z) for (i, _, rate), z in filters]
        rates[f"filter_{side}"] = ca.vertcat(*drift)
    filters = zip(design.bank, ca.vertsplit(parts["response"]), strict=True)
    rates["response"] = ca.vertcat(*(gain - rate * N for (_, gain, rate), N in filters))
    inputs = {"memory": memory, "u": u, "y": y, "theta": theta}
    return make_ode(inputs, ca.vertcat(*(rates[name] for name in layout)))


def _from_outputs(design: BankDesign, y: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the ends of the measured states that a measurement leaves."""
    wide = design.rounding * ca.fabs(y)
    scale = ca.DM(design.scale)
    return (y - ca.DM(design.noise[:, 1]) - wide) / scale, (
        y - ca.DM(design.noise[:, 0]) + wide
    ) / scale


def _states(design: BankDesign, parts: Parts, shown: tuple[ca.SX, ...]) -> tuple[ca.SX, ca.SX]:
    """Put measured and unmeasured states together."""
    outputs = design.outputs.tolist()
    ends = []
    for side, values in (("lower", shown[0]), ("upper", shown[1])):
        column = [
            values[outputs.index(i)]
            if i in outputs
            else parts[f"hidden_{side}"][design.hidden.index(i)]
            for i in range(len(design.plant.x))
        ]
        ends.append(ca.vertcat(*column))
    return ends[0], ends[1]


def fault_intervals(design: BankDesign, parts: Parts, shown: tuple[ca.SX, ...]) -> list[Ends]:
    """Return the intervals of every filter, (n_f,) each; all numbers while N is zero."""
    outputs, rates = design.outputs.tolist(), len(design.filters)
    found, far = [], LIMITS[design.precision].far
    for number in range(rates):
        low, high = [], []
        for j, i in enumerate(design.fault_rows.tolist()):
            k, place = outputs.index(i), j * rates + number
            N = parts["response"][place]
            below = shown[0][k] - parts["filter_upper"][place]
            above = shown[1][k] - parts["filter_lower"][place]
            slack = design.rounding * (ca.fabs(shown[0][k]) + ca.fabs(shown[1][k]))
            rises = design.gain[j] > 0.0
            started = N > 0.0 if rises else N < 0.0
            safe = ca.if_else(started, N, 1.0)
            ends = (below - slack, above + slack) if rises else (above + slack, below - slack)
            low.append(ca.if_else(started, ends[0] / safe, -far))
            high.append(ca.if_else(started, ends[1] / safe, far))
        found.append(Ends(ca.vertcat(*low), ca.vertcat(*high)))
    return found


def telling(found: Sequence[Ends]) -> Ends:
    """Return the first filter's intervals, or that farthest from zero, which proves a fault."""
    low, high = ca.SX(found[0].lower), ca.SX(found[0].upper)
    for j in range(low.numel()):
        away, silent = ca.SX(0), ca.logic_and(low[j] <= 0.0, high[j] >= 0.0)
        for other in found[1:]:
            distance = ca.fmax(other.lower[j], -other.upper[j])
            better = ca.logic_and(silent, distance > away)
            low[j] = ca.if_else(better, other.lower[j], low[j])
            high[j] = ca.if_else(better, other.upper[j], high[j])
            away = ca.fmax(away, distance)
    return Ends(low, high)


def _envelope(
    design: BankDesign, corners: Corners, low: ca.SX, high: ca.SX
) -> tuple[tuple[ca.SX, ca.SX], ca.SX]:
    """Return a box of all states until the next sample, and whether it is proved to hold them."""
    n = len(design.plant.x)
    region = ca.DM(outward(design.region, design.precision))

    def reached(X: tuple[ca.SX, ca.SX]) -> tuple[ca.SX, ca.SX]:
        fall = [ca.fmin(0.0, corners.rate(i, 0, *X)) for i in range(n)]
        rise = [ca.fmax(0.0, corners.rate(i, 1, *X)) for i in range(n)]
        slack = design.rounding * (ca.fabs(low) + ca.fabs(high))
        return (
            low + design.Ts * ca.vertcat(*fall) - slack,
            high + design.Ts * ca.vertcat(*rise) + slack,
        )

    X = low, high
    for _ in range(_PASSES):
        image = reached(X)
        first = low - _WIDER * (low - image[0]) - _EXTRA
        second = high + _WIDER * (image[1] - high) + _EXTRA
        X = ca.fmax(first, region[:, 0]), ca.fmin(second, region[:, 1])
    image = reached(X)
    image = ca.fmax(image[0], region[:, 0]), ca.fmin(image[1], region[:, 1])
    inner = (ca.logic_and(image[0][i] >= X[0][i], image[1][i] <= X[1][i]) for i in range(n))
    return image, every(inner)


def _move_hidden(
    design: BankDesign, corners: Corners, parts: Parts, X: tuple[ca.SX, ca.SX]
) -> tuple[dict[str, ca.SX], tuple[ca.SX, ca.SX]]:
    """Move the ends of the unmeasured states; return them and the hull of all states over it."""
    hull_low, hull_high = X[0] + 0.0, X[1] + 0.0
    ends: dict[str, list[ca.SX]] = {"hidden_lower": [], "hidden_upper": []}
    region = outward(design.region, design.precision)
    for place, i in enumerate(design.hidden):
        low, high = region[i]
        for side, name, sign in ((0, "hidden_lower", -1.0), (1, "hidden_upper", 1.0)):
            z = parts[name][place]
            first = corners.rate(i, side, *X, own=z)
            later = ca.fmin(ca.fmax(z + design.Ts * first, low), high)
            second = corners.rate(i, side, *X, own=later)
            worst = ca.fmax(first, second) if side else ca.fmin(first, second)
            slack = design.rounding * (ca.fabs(z) + design.Ts * ca.fabs(worst))
            new = z + design.Ts * worst + sign * slack
            ends[name].append(ca.fmin(ca.fmax(new, low), high))
            if side:
                hull_high[i] = ca.fmax(z, ends[name][-1])
            else:
                hull_low[i] = ca.fmin(z, ends[name][-1])
    moved = {name: ca.vertcat(*values) for name, values in ends.items() if values}
    return moved, (hull_low, hull_high)


def _move_filters(
    design: BankDesign,
    corners: Corners,
    parts: Parts,
    X: tuple[ca.SX, ca.SX],
    hull: tuple[ca.SX, ca.SX],
) -> dict[str, ca.SX]:
    """Move every filter by the exact exponential of -rate."""
    rows, response = design.fault_rows.tolist(), ca.vertsplit(parts["response"])
    largest = dict(zip(rows, np.abs(design.plant.box("f")).max(axis=1).tolist(), strict=True))
    share = [(np.exp(-r * design.Ts), -np.expm1(-r * design.Ts) / r) for *_, r in design.bank]
    moved: dict[str, ca.SX] = {}
    for side, name, sign in ((0, "filter_lower", -1.0), (1, "filter_upper", 1.0)):
        balances = {i: corners.rate(i, side, *hull, faults=False) for i in rows}
        values, filters = [], zip(design.bank, share, ca.vertsplit(parts[name]), strict=True)
        for ((i, _, rate), (decay, gathered), z), N in zip(filters, response, strict=True):
            balance, end = balances[i], X[side][i]
            slack = ca.fabs(z) + gathered * (ca.fabs(balance) + rate * ca.fabs(end))
            slack += largest[i] * ca.fabs(N)
            new = decay * z + gathered * (balance + rate * end)
            values.append(new + sign * design.rounding * slack)
        moved[name] = ca.vertcat(*values)
    moves = zip(design.bank, share, response, strict=True)
    moved["response"] = ca.vertcat(
        *(decay * N + gathered * gain for (_, gain, _), (decay, gathered), N in moves)
    )
    return moved


def bank_intervals(
    observer: Observer, memory: ArrayLike, y: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Return the fault intervals of every filter of a bank.

    Each holds the mean of the fault since the sets began, with the weights exp(-rate age); an alarm
    of any of them, zero outside of it, proves a fault. `Observer.step` decides by all of them too.

    Shapes: memory (..., n_memory), y (..., m).
    """
    if observer.method != "filter_bank":
        raise ObsynthError(
            f"the observer of the method {observer.method!r} is no bank of filters",
            method=observer.method,
        )
    design: BankDesign = observer.certificate.design
    parts, layout = np.asarray(memory, dtype=float), observer.memory_layout
    shown = np.asarray(y, dtype=float)[..., None]
    outputs, rates = design.outputs.tolist(), len(design.filters)
    places = [outputs.index(i) for i in design.fault_rows.tolist()]
    shape = (*parts.shape[:-1], len(places), rates)
    # what begins anew at its next call knows nothing yet
    N = (parts[..., layout["response"]] * (parts[..., layout["begin"]] < 0.5)).reshape(shape)
    found = []
    for noise, side in ((1, "upper"), (0, "lower")):
        ends = (shown[..., 0] - design.noise[:, noise]) / design.scale
        rest = ends[..., places][..., None] - parts[..., layout[f"filter_{side}"]].reshape(shape)
        open_end = np.full(shape, -np.inf if noise else np.inf)
        found.append(np.divide(rest, np.abs(N), out=open_end, where=N != 0.0))
    rises = design.gain[:, None] > 0.0
    return np.where(rises, found[0], -found[1]), np.where(rises, found[1], -found[0])
