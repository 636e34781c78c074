"""The run-time functions of the bank: envelopes between samples, unmeasured states, filters."""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from obsynth.derive.rigour import outward
from obsynth.designs.core.given import Start
from obsynth.designs.core.stepping import (
    all_finite,
    fill,
    finite_or,
    known_signals,
    make_step,
    select,
    slices,
    status_word,
)
from obsynth.designs.filter_bank.record import UNKNOWN, BankDesign
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_PASSES = 3
_WIDER = 1.05
_EXTRA = 1e-12


def memory_sizes(design: BankDesign) -> dict[str, int]:
    """Return the parts of the memory vector.

    ``hidden`` are the two ends of the unmeasured states, ``filter`` those of the filters (faults
    first, then rates: entry l + j * number of rates), ``response`` their response to a unit
    fault, ``shown`` what the outputs' states are known to be if the next measurement is missing.
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
        "left": 1,
        "initialised": 1,
    }
    return {name: size for name, size in sizes.items() if size}


def first_memory(design: BankDesign, start: Start) -> dict[str, FloatArray]:
    """Start from a box of the state; guess and y0 are not used, faults have declared ranges."""
    if start.x_range is None:
        return _parts(design, design.region)
    box = np.column_stack(
        [
            np.maximum(start.x_range[:, 0], design.region[:, 0]),
            np.minimum(start.x_range[:, 1], design.region[:, 1]),
        ]
    )
    if np.any(box[:, 0] > box[:, 1]):
        raise ObsynthError("x_range lies outside of the region of the bank", option="x_range")
    return _parts(design, box)


def _parts(design: BankDesign, x_box: FloatArray) -> dict[str, FloatArray]:
    """Return the parts of the memory that are not zero for a state in a box."""
    x_box = outward(x_box, design.precision)
    parts = {}
    for side, ends in zip(("lower", "upper"), x_box.T, strict=True):
        if design.hidden:
            parts[f"hidden_{side}"] = ends[design.hidden]
        parts[f"filter_{side}"] = np.repeat(ends[design.fault_rows], len(design.filters))
        parts[f"shown_{side}"] = ends[design.outputs]
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
        """Return the least (side 0) or largest (1) derivative of a state over a box of states.

        Shapes: low, high (n, 1).
        """
        design = self.design
        arguments = {}
        for kind in UNKNOWN:
            signs = design.signs[kind][row]
            box = design.plant.box(kind)
            ends = (low, high) if kind == "x" else (ca.SX(box[:, 0]), ca.SX(box[:, 1]))
            column = [ends[side if signs[j] >= 0 else 1 - side][j] for j in range(len(signs))]
            if kind == "x" and own is not None:
                column[row] = own
            if kind == "f" and not faults:
                column = [ca.SX(0)] * len(signs)
            if kind == "rho":
                measured = [s for s in design.plant.rho if s.measured]
                for k, signal in enumerate(measured):
                    column[design.plant.rho.index(signal)] = self.theta[k]
            arguments[kind] = ca.vertcat(*column) if column else ca.SX(0, 1)
        rhs = design.plant.function()
        value: ca.SX = rhs(
            arguments["x"],
            self.u,
            ca.SX(0, 1),
            arguments["f"],
            arguments["w"],
            arguments["p"],
            arguments["rho"],
        )[0][row]
        return value


def build_step(design: BankDesign) -> ca.Function:
    """Build `Observer.step`.

    Over a step every state stays in an envelope X with X_0 + [0, Ts] f(X) inside X (checked each
    time; without that check nothing is known). The unmeasured states then move by their own
    equation, others at the worst end of the envelope: for a flow that falls with its own state,
    z + Ts min(F(z), F(z + Ts F(z))) is below the true solution. Every filter gets the balance of
    its state without fault, from below and from above, and its exact exponential.
    """
    plant = design.plant
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    y_finite = all_finite(y)
    u_used, theta_used, u_finite, covered = known_signals(plant, u, theta)
    corners = Corners(design, u_used, theta_used)

    initialised = memory[layout["initialised"]] > 0.5
    region = ca.DM(outward(design.region, design.precision))
    told = _from_outputs(design, finite_or(y, [0.0] * y.numel()))
    inside = ca.SX(1)
    for k, i in enumerate(design.outputs.tolist()):
        inside = ca.logic_and(inside, told[1][k] >= design.region[i, 0])
        inside = ca.logic_and(inside, told[0][k] <= design.region[i, 1])
    inside = ca.logic_and(ca.if_else(y_finite, inside, 1), covered)
    again = ca.logic_and(memory[layout["left"]] > 0.5, inside)
    memory_now = select(again, ca.SX(fill(layout, _parts(design, design.region))), memory)
    parts = {name: memory_now[part] for name, part in layout.items()}

    expected = parts["shown_lower"], parts["shown_upper"]
    consistent = ca.SX(1)
    for k in range(len(design.outputs)):
        agrees = ca.logic_and(told[0][k] <= expected[1][k], told[1][k] >= expected[0][k])
        consistent = ca.logic_and(consistent, agrees)
    consistent = ca.if_else(y_finite, consistent, 1)
    shown = tuple(select(y_finite, now, then) for now, then in zip(told, expected, strict=True))
    low, high = _states(design, parts, shown)
    low, high = ca.fmax(low, region[:, 0]), ca.fmin(high, region[:, 1])

    f_lower, f_upper, sound = _fault_intervals(design, parts, shown)
    consistent = ca.logic_and(consistent, sound)

    X, contained = _envelope(design, corners, low, high)
    moved, hull = _move_hidden(design, corners, parts, X)
    moved |= _move_filters(design, corners, parts, X, hull)
    moved["shown_lower"] = ca.vertcat(*(X[0][i] for i in design.outputs.tolist()))
    moved["shown_upper"] = ca.vertcat(*(X[1][i] for i in design.outputs.tolist()))
    moved["left"] = 1 - ca.logic_and(ca.logic_and(inside, u_finite), contained)
    moved["initialised"] = ca.SX(1)
    packed = ca.vertcat(*(moved[name] for name in layout))

    def claimed(value: ca.SX, sign: float) -> ca.SX:
        return ca.vertcat(
            *(ca.if_else(initialised, value[i], sign * ca.inf) for i in range(value.numel()))
        )

    inputs = {"memory": memory, "u": u, "y": y}
    if theta.numel():
        inputs["theta"] = theta
    return make_step(
        inputs,
        {
            "memory": select(initialised, packed, memory),
            "xhat": (low + high) / 2.0,
            "fhat": (f_lower + f_upper) / 2.0,
            "x_lower": claimed(low, -1.0),
            "x_upper": claimed(high, 1.0),
            "f_lower": claimed(f_lower, -1.0),
            "f_upper": claimed(f_upper, 1.0),
            "status": status_word(
                {
                    "not_initialised": ca.logic_not(initialised),
                    "non_finite_input": ca.logic_not(ca.logic_and(y_finite, u_finite)),
                    "outside_domain": ca.logic_not(inside),
                    "inconsistent_measurement": ca.logic_not(consistent),
                    "fault_not_valid": ca.logic_not(ca.logic_and(initialised, inside)),
                }
            ),
        },
    )


def build_ode(design: BankDesign) -> ca.Function:
    """Build the continuous form of the bank, with y(t) known at all times up to its noise."""
    plant = design.plant
    layout = slices(memory_sizes(design))
    memory = ca.SX.sym("memory", layout["initialised"].stop)
    u, y = ca.SX.sym("u", len(plant.u)), ca.SX.sym("y", len(plant.output))
    theta = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
    corners = Corners(design, u, theta)
    parts = {name: memory[part] for name, part in layout.items()}
    low, high = _states(design, parts, _from_outputs(design, y))
    rates = {name: ca.SX(part.stop - part.start, 1) for name, part in layout.items()}
    for side, ends in (("lower", low), ("upper", high)):
        o = 0 if side == "lower" else 1
        hidden = [corners.rate(i, o, low, high, own=ends[i]) for i in design.hidden]
        if hidden:
            rates[f"hidden_{side}"] = ca.vertcat(*hidden)
        drift = []
        for j, i in enumerate(design.fault_rows.tolist()):
            balance = corners.rate(i, o, low, high, faults=False)
            for k, rate in enumerate(design.filters.tolist()):
                z = parts[f"filter_{side}"][j * len(design.filters) + k]
                drift.append(balance + rate * (ends[i] - z))
        rates[f"filter_{side}"] = ca.vertcat(*drift)
    response = [
        float(gain) - rate * parts["response"][j * len(design.filters) + k]
        for j, gain in enumerate(design.gain.tolist())
        for k, rate in enumerate(design.filters.tolist())
    ]
    rates["response"] = ca.vertcat(*response)
    inputs = {"memory": memory, "u": u, "y": y}
    if theta.numel():
        inputs["theta"] = theta
    return ca.Function(
        "ode",
        list(inputs.values()),
        [ca.densify(ca.vertcat(*(rates[name] for name in layout)))],
        list(inputs),
        ["dmemory"],
    )


def _from_outputs(design: BankDesign, y: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Return the ends of the measured states that a measurement leaves."""
    wide = design.rounding * ca.fabs(y)
    scale = ca.DM(design.scale)
    return (y - ca.DM(design.noise[:, 1]) - wide) / scale, (
        y - ca.DM(design.noise[:, 0]) + wide
    ) / scale


def _states(
    design: BankDesign, parts: dict[str, ca.SX], shown: tuple[ca.SX, ...]
) -> tuple[ca.SX, ca.SX]:
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


def _fault_intervals(
    design: BankDesign, parts: dict[str, ca.SX], shown: tuple[ca.SX, ...]
) -> tuple[ca.SX, ca.SX, ca.SX]:
    """Return the intervals of the first filter, inside the declared ranges, and whether they are.

    The mean of the fault lies in the declared range too, so an empty intersection is a
    contradiction.
    """
    outputs, rates = design.outputs.tolist(), len(design.filters)
    lows, highs, sound = [], [], ca.SX(1)
    for j, i in enumerate(design.fault_rows.tolist()):
        first, second = interval(parts, shown, outputs.index(i), j * rates, design.rounding)
        low, high = outward(design.plant.box("f"), design.precision)[j]
        fits = ca.logic_and(first <= high, second >= low)
        sound = ca.logic_and(sound, fits)
        lows.append(ca.if_else(fits, ca.fmax(first, low), first))
        highs.append(ca.if_else(fits, ca.fmin(second, high), second))
    return ca.vertcat(*lows), ca.vertcat(*highs), sound


def interval(
    parts: dict[str, ca.SX], shown: tuple[ca.SX, ...], k: int, place: int, rounding: float
) -> tuple[ca.SX, ca.SX]:
    """Return ((y_low - z_upper) / N, (y_high - z_lower) / N), all numbers while N is zero."""
    N = parts["response"][place]
    below = shown[0][k] - parts["filter_upper"][place]
    above = shown[1][k] - parts["filter_lower"][place]
    slack = rounding * (ca.fabs(shown[0][k]) + ca.fabs(shown[1][k]))
    started = N > 0.0
    safe = ca.if_else(started, N, 1.0)
    return (
        ca.if_else(started, (below - slack) / safe, -ca.inf),
        ca.if_else(started, (above + slack) / safe, ca.inf),
    )


def _envelope(
    design: BankDesign, corners: Corners, low: ca.SX, high: ca.SX
) -> tuple[tuple[ca.SX, ca.SX], ca.SX]:
    """Return a box that holds all states until the next sample, and whether that is proved.

    Passes X -> X_0 + [0, Ts] f(X), widened; the last one has to lie in what it was made from.
    """
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
    contained = ca.SX(1)
    for i in range(n):
        inner = ca.logic_and(image[0][i] >= X[0][i], image[1][i] <= X[1][i])
        contained = ca.logic_and(contained, inner)
    return image, contained


def _move_hidden(
    design: BankDesign, corners: Corners, parts: dict[str, ca.SX], X: tuple[ca.SX, ca.SX]
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
    parts: dict[str, ca.SX],
    X: tuple[ca.SX, ca.SX],
    hull: tuple[ca.SX, ca.SX],
) -> dict[str, ca.SX]:
    """Move every filter by the exact exponential of -rate."""
    rates = design.filters.tolist()
    largest = np.abs(design.plant.box("f")).max(axis=1)
    moved: dict[str, ca.SX] = {}
    for side, name, sign in ((0, "filter_lower", -1.0), (1, "filter_upper", 1.0)):
        values = []
        for j, i in enumerate(design.fault_rows.tolist()):
            balance = corners.rate(i, side, *hull, faults=False)
            for k, rate in enumerate(rates):
                decay, gathered = np.exp(-rate * design.Ts), -np.expm1(-rate * design.Ts) / rate
                z = parts[name][j * len(rates) + k]
                end = X[side][i]
                slack = ca.fabs(z) + gathered * (ca.fabs(balance) + rate * ca.fabs(end))
                slack += largest[j] * parts["response"][j * len(rates) + k]
                new = decay * z + gathered * (balance + rate * end)
                values.append(new + sign * design.rounding * slack)
        moved[name] = ca.vertcat(*values)
    response = []
    for j, gain in enumerate(design.gain.tolist()):
        for k, rate in enumerate(rates):
            decay, gathered = np.exp(-rate * design.Ts), -np.expm1(-rate * design.Ts) / rate
            response.append(decay * parts["response"][j * len(rates) + k] + gathered * gain)
    moved["response"] = ca.vertcat(*response)
    return moved
