"""Plants for the contractor, and trials of one step: boxes, truths in them, and what follows.

Truths lie in random boxes of states and faults at random or at corners, disturbances and rates at
their ends; from each follow the next state, its reading and the next fault.
"""

import functools
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import sympy as sp
from tapes import NUMPY, tape

import obsynth as ob
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.contractor import Contractor
from obsynth.designs.core.equations import Before

R = sp.Rational
TRIALS = 3000


# -- plants ------------------------------------------------------------------------------------


def tanks():
    """Four levels, the fourth unmeasured, an unbounded unknown input, faults without ranges."""
    return ob.plants.quadruple_tank().discretise("euler", Ts=1.0)


def pmsm():
    """A machine with an unknown load torque, sums and products of currents and speed."""
    plant = ob.Plant("machine")
    i_d, i_q, speed = plant.states("i_d i_q w", range=[(-10, 10), (-10, 10), (-300, 300)])
    u = plant.inputs("u_d u_q", range=(-200, 200))
    plant.actuator_faults("f", of=u[1], range=(-20, 20), rate=1000)
    (load,) = plant.unknown_inputs("load")
    n = plant.disturbances("n1:4", bound=[0.05, 0.05, 0.5])
    plant.dynamics(
        [
            (u[0] - R(3, 10) * i_d) / R(2, 1000) + 4 * speed * i_q,
            (u[1] - R(3, 10) * i_q - R(4, 10) * speed) / R(2, 1000) - 4 * speed * i_d,
            (R(6, 10) * i_q - speed / 1000 - load) * 1000,
        ]
    )
    plant.outputs([i_d + n[0], i_q + n[1], speed + n[2]])
    return plant.discretise("euler", Ts=1e-4)


def cart_pole():
    """Positions measured; sines, cosines and a quotient whose sign is open in most variables."""
    plant = ob.Plant("cart pole")
    x, v, th, om = plant.states("x v theta omega", range=[(-1, 1), (-3, 3), (-0.5, 0.5), (-3, 3)])
    (F,) = plant.inputs("F", range=(-10, 10))
    n = plant.disturbances("w1 w2", bound=[0.001, 0.001])
    M, m, arm, g = 1, R(1, 10), R(1, 2), R(981, 100)
    turning = (g * sp.sin(th) + sp.cos(th) * (-F - m * arm * om**2 * sp.sin(th)) / (M + m)) / (
        arm * (R(4, 3) - m * sp.cos(th) ** 2 / (M + m))
    )
    push = (F + m * arm * (om**2 * sp.sin(th) - turning * sp.cos(th))) / (M + m)
    plant.dynamics([v, push, om, turning])
    plant.outputs([x + n[0], th + n[1]])
    return plant.discretise("euler", Ts=0.01)


def flexible_joint():
    """The gallery's robot: a sine, two of four states measured, an actuator fault."""
    plant = ob.Plant("flexible joint robot")
    names = "th_m w_m th_l w_l"
    tm, wm, tl, wl = plant.states(names, range=[(-3, 3), (-10, 10), (-3, 3), (-10, 10)])
    (u,) = plant.inputs("u", range=(-3, 3))
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=1)
    n = plant.disturbances("w1:3", bound=[0.002, 0.02])
    plant.dynamics(
        [
            wm,
            R(486, 10) * (tl - tm) - R(125, 100) * wm + R(216, 10) * u,
            wl,
            R(195, 10) * (tm - tl) - R(333, 100) * sp.sin(tl),
        ]
    )
    plant.outputs([tm + n[0], wm + n[1]])
    return plant.discretise("euler", Ts=0.01)


def mixed_rows():
    """Outputs of several states with coefficients of both signs, noise shared between them."""
    plant = ob.Plant("mixed rows")
    a, b, c = plant.states("a b c", range=[(-2, 2), (-1, 3), (-4, 4)])
    (u,) = plant.inputs("u", range=(-1, 1))
    n1, n2, n3 = plant.disturbances("n1:4", range=[(-0.1, 0.2), (-0.05, 0.05), (0, 0.1)])
    plant.dynamics([a / 2 + sp.sin(b) / 3 + u / 9, b / 3 - a * c / 20 + n3, c / 4 + a / 7], Ts=1)
    plant.outputs([2 * a - b / 3 + n1, a + b + 3 * c / 7 + n1 - 2 * n2, -c / 3 + n2])
    return plant


def loose():
    """A disturbance without a bound in one row and one output, a state without a range."""
    plant = ob.Plant("loose")
    a, b = plant.states("a b", range=[(0.5, 4), (-1, 1)])
    (level,) = plant.states("level")
    (u,) = plant.inputs("u", range=(0, 1))
    (f,) = plant.process_faults("f", range=(-0.2, 0.3), rate=0.05)
    (wild,) = plant.disturbances("wild")
    tame, n = plant.disturbances("tame n", bound=[0.1, 0.02])
    plant.dynamics(
        [
            a - sp.sqrt(a) / 5 + u / 8 + f / 4 + tame / 3,
            b / 2 + sp.exp(-a) / 4 + wild,
            level + a / 3 - u + tame,
        ],
        Ts=1,
    )
    plant.outputs([a + n, b + wild, level - 2 * a + n])
    return plant


def gains():
    """Faults whose gains depend on the state, an unknown parameter and hidden scheduling."""
    plant = ob.Plant("gains")
    x, z = plant.states("x z", range=[(1, 6), (-3, 3)])
    (u,) = plant.inputs("u", range=(0, 20))
    (theta,) = plant.scheduling("theta", range=(0, 1))
    (hidden,) = plant.scheduling("hidden", range=(-0.5, 0.5), measured=False)
    (k,) = plant.params("k", range=(0.9, 1.1))
    f, g = plant.process_faults("f g", range=[(-0.3, 0.2), (-1, 1)], rate=[0.1, 0.2])
    (n,) = plant.disturbances("n", bound=0.01)
    plant.dynamics(
        [
            x - (1 + theta) * k * x / 10 + f * x / 2 + u / 50 + n,
            z / 2 + hidden * z / 4 + g / (1 + x) + f / 20 + sp.cos(z) / 8,
        ],
        Ts=1,
    )
    plant.outputs([x + n, z - n])
    return plant


def corners():
    """Saturations, absolute values, a dead zone by cases, quotients and a hidden pole outside."""
    plant = ob.Plant("corners")
    a, b, c = plant.states("a b c", range=[(-2, 2), (0.1, 5), (-1, 1)])
    (u,) = plant.inputs("u", range=(-2, 2))
    (f,) = plant.actuator_faults("f", of=u, range=(-0.5, 0.5), rate=0.1)
    n = plant.disturbances("n1:3", bound=[0.01, 0.02])
    dead = sp.Piecewise((a - 1, a > 1), (a + 1, a < -1), (0, True))
    plant.dynamics(
        [
            a - dead / 3 + sp.Max(-1, sp.Min(1, u)) / 10 + f / 10,
            b - b / (1 + b + b**2 / 4) / 5 + sp.Abs(a) / 20 + n[0],
            c / 2 + a * c / (3 + b) + sp.atan2(a, 2 + b) / 6,
        ],
        Ts=1,
    )
    plant.outputs([a + n[1], b + a / 5 + n[0]])
    return plant


def turning():
    """Faults whose gains pass zero inside of the box, one of them with a turn more."""
    plant = ob.Plant("turning")
    x, z = plant.states("x z", range=[(-2, 2), (-3, 3)])
    f, g = plant.process_faults("f g", range=[(-1, 1), (-0.5, 0.4)], rate=[0.1, 0.2])
    n = plant.disturbances("n1 n2", bound=0.02)
    plant.dynamics(
        [R(7, 10) * x + x * f / 2 + z / 20 + n[0], R(6, 10) * z + sp.sin(2 * z) * g / 3 + n[1]],
        Ts=1,
    )
    plant.outputs([x + n[0], z + n[1]])
    return plant


def vessel():
    """In continuous time: strips, ranges and rates."""
    plant = ob.Plant("vessel")
    x, z = plant.states("x z", range=[(3, 7), (-1, 1)])
    (u,) = plant.inputs("u", range=(0, 20))
    (f,) = plant.process_faults("f", range=(-0.3, 0.3), rate=2)
    (n,) = plant.disturbances("n", bound=0.01)
    plant.dynamics([-x + f * x + u + n, -z + x / 9])
    plant.outputs([x - z / 2 + n])
    return plant


def by_hand():
    """Steady half widths that a few lines of arithmetic give; the gain of h varies."""
    plant = ob.Plant("by hand")
    a, b, c, e = plant.states("a b c e", range=[(-9, 9), (-9, 9), (-4, 4), (-9, 9)])
    f, g, h = plant.process_faults("f g h", range=[(-5, 5), (-9, 9), (-2, 2)], rate=[0.01, 1, 1])
    v, w = plant.disturbances("v w", bound=[0.1, 0.2])
    sine = sp.sin(c)
    plant.dynamics(
        [a / 2 - b / 4 + f / 3, b / 5 - g, c / 2 + sine / 10 + a / 10, (2 + sine) * h], Ts=1
    )
    plant.outputs([a + v, b + w, e + v])
    return plant


PLANTS = {
    p.__name__: p
    for p in (
        tanks,
        pmsm,
        cart_pole,
        flexible_joint,
        mixed_rows,
        loose,
        gains,
        corners,
        turning,
        vessel,
    )
}


@functools.cache
def made(name, w=1.0, rate=1.0):
    """A plant, or one that is told of smaller disturbances or rates."""
    plant = PLANTS[name]()
    if w == rate == 1.0:
        return plant
    data = plant.to_dict()
    for signal in data.get("continuous", data)["signals"]:
        if signal["role"] == "disturbance" and signal["upper"] is not None:
            signal["lower"], signal["upper"] = w * signal["lower"], w * signal["upper"]
        if signal["rate"] is not None:
            signal["rate"] *= rate
    return ob.Plant.from_dict(data)


# -- trials ------------------------------------------------------------------------------------


class Narrow(Contractor):
    """Mutant: an image that is 0.2 % narrower."""

    def image(self, before):
        found = super().image(before)
        middle, half = 0.5 * (found.lower + found.upper), 0.5 * (found.upper - found.lower)
        return Ends(middle - 0.998 * half, middle + 0.998 * half)


def finite(box, reach=10.0):
    """Ranges to draw from where none are declared."""
    return np.where(np.isfinite(box), box, [-reach, reach]).reshape(-1, 2)


def signals(rng, box, count, ends):
    """Columns of a signal; of any size where it has no bound."""
    found = drawn(rng, finite(box), count, ends)
    free = ~np.isfinite(box.reshape(-1, 2)).all(axis=1)
    size = 10.0 ** rng.uniform(-3, 1.5, found.shape)
    return np.where(free[:, None], rng.choice([-1.0, 1.0], found.shape) * size, found)


@dataclass
class Trials:
    """Boxes before, truths in them, and what follows, columns are trials.

    x, f: boxes (n, 2, N); x0, f0: truths; u: inputs; rho: measured scheduling
    x1, f1: the next state and fault; y: the reading of x1
    fair: trials in which the next state is one that the ranges allow
    """

    plant: Any
    x: Any
    f: Any
    x0: Any
    f0: Any
    u: Any
    rho: Any
    x1: Any
    f1: Any
    y: Any
    fair: Any


def drawn(rng, box, count, ends):
    """Columns in a box, at its ends with a probability."""
    low, high = (box[:, [0]], box[:, [1]]) if box.ndim == 2 else (box[:, 0], box[:, 1])
    share = rng.uniform(0, 1, (len(box), count))
    share = np.where(rng.random(share.shape) < ends, np.round(share), share)
    return np.clip(low + share * (high - low), low, high)


def boxes(rng, whole, count, size):
    """Boxes in a box, their widths from a ten thousandth of its width on."""
    low, high = whole[:, [0]], whole[:, [1]]
    wide = size * (high - low) * 10.0 ** rng.uniform(-4, 0, (len(whole), count))
    at = low + rng.uniform(0, 1, wide.shape) * (high - low - wide)
    return np.stack([at, np.minimum(at + wide, high)], axis=1)


def trials(plant, Ts=0.01, seed=0, count=TRIALS, size=0.5, ends=0.7, kind=np.float64):
    """Draw boxes, truths and what follows from the equations alone.

    kind: of the numbers that a step is given: ends, inputs, scheduling and readings
    """

    def stored(numbers):
        return numbers.astype(kind).astype(float)

    rng = np.random.default_rng(seed)
    x = stored(boxes(rng, finite(plant.box("x")), count, size))
    f = stored(boxes(rng, finite(plant.box("f")), count, size))
    x0, f0 = drawn(rng, x, count, ends), drawn(rng, f, count, ends)
    kinds = ("u", "d", "w", "p", "rho")
    first, second = (
        {kind: signals(rng, plant.box(kind), count, ends) for kind in kinds} for _ in range(2)
    )
    for name in ("u", "rho"):
        first[name] = np.clip(
            stored(first[name]), *plant.box(name).reshape(-1, 2, 1).transpose(1, 0, 2)
        )
    call = plant.function().map(count)

    def at(state, fault, given):
        d, w, p, rho = (given[kind] for kind in kinds[1:])
        return [np.array(v) for v in call(state, given["u"], d, fault, w, p, rho)]

    x1 = at(x0, f0, first)[0]
    if plant.Ts is None:
        x1 = drawn(rng, finite(plant.box("x")), count, ends)
    rates = np.array([np.inf if s.rate is None else float(s.rate) for s in plant.f])
    rates = rates[:, None] * (1.0 if plant.Ts is not None else Ts)
    f_box = finite(plant.box("f"))
    ends_of_f = np.maximum(f0 - rates, f_box[:, [0]]), np.minimum(f0 + rates, f_box[:, [1]])
    f1 = drawn(rng, np.stack(ends_of_f, axis=1), count, ends)
    y = stored(at(x1, f1, second)[1])
    curved = Contractor(plant, Ts).equations.curved
    box = np.where(curved[:, None], plant.box("x"), [-np.inf, np.inf])
    fair = ((x1 >= box[:, [0]]) & (x1 <= box[:, [1]])).all(axis=0)
    measured = [k for k, s in enumerate(plant.rho) if s.measured]
    return Trials(plant, x, f, x0, f0, first["u"], first["rho"][measured], x1, f1, y, fair)


@functools.cache
def cutting(contractor):
    """The cuts of one step as a function of numbers."""
    plant = contractor.plant
    n, n_f = len(plant.x), len(plant.f)
    size = len(plant.u) + sum(s.measured for s in plant.rho)
    x, f = ca.SX.sym("x", n, 2), ca.SX.sym("f", n_f, 2)
    known, y = ca.SX.sym("known", size), ca.SX.sym("y", len(plant.output_names))
    used = ca.SX.sym("used", y.numel())
    before = Before(Ends(x[:, 0], x[:, 1]), Ends(f[:, 0], f[:, 1]), known)
    X = Ends.of(contractor.domain)
    late = before.faults
    if plant.Ts is not None:
        X = X.meet(contractor.image(before))
    X = contractor.measure(X, y, ca.vertsplit(used))
    if plant.Ts is not None:
        late = contractor.invert(before, X)
    now = contractor.drift(late).meet(Ends.of(plant.box("f").reshape(-1, 2)))
    outputs = [ca.horzcat(box.lower, box.upper) for box in (X, late, now)]
    return ca.Function("cut", [x, f, known, y, used], [ca.cse(ca.densify(o)) for o in outputs])


def in_single(function, given):
    """Run the instructions of a function in single precision, columns by columns."""
    count, kind = given[0].shape[1], np.float32
    rows = [part.astype(kind) for part in given]
    with np.errstate(all="ignore"):
        found = tape(function, rows, NUMPY, lambda value: np.full(count, value, dtype=kind))
    return np.array([np.broadcast_to(np.asarray(row, dtype=float), (count,)) for row in found])


def cut(contractor, given, used=1.0):
    """Return X (n, 2, N), F' and F (n_f, 2, N) for all trials."""
    count = given.x.shape[2]

    def flat(box):
        return box.transpose(0, 2, 1).reshape(len(box), 2 * count)

    known = np.vstack([given.u, given.rho])
    told = np.broadcast_to(used, given.y.shape)
    y = np.where(told > 0, given.y, 0.0)
    if contractor.precision == "single":
        columns = [box.reshape(-1, count, order="F") for box in (given.x, given.f)]
        rows = in_single(cutting(contractor), [*columns, known, y, told])
        sizes = np.cumsum([2 * len(given.x), 2 * len(given.f)])
        parts = np.split(rows, sizes)
        return [part.reshape(-1, 2, count, order="F") for part in parts]
    function = cutting(contractor).map(count)
    found = function(flat(given.x), flat(given.f), known, y, told)
    return [np.array(v).reshape(-1, count, 2).transpose(0, 2, 1) for v in found]


def away(box, truth):
    return ((truth < box[:, 0]) | (truth > box[:, 1])).any(axis=0)


def lost(contractor, given, used=1.0):
    """Fair trials in which a truth is cut away: the state, the fault before, the fault now."""
    X, late, now = cut(contractor, given, used)
    pairs = (X, given.x1), (late, given.f0), (now, given.f1)
    return [int((away(box, truth) & given.fair).sum()) for box, truth in pairs]


def following(plant, given, column, rng, count=4000):
    """What can follow from one trial's boxes, sampled densely: next states and faults."""
    kinds = ("d", "w", "p", "rho")
    many = {kind: drawn(rng, finite(plant.box(kind), 0.0), count, 0.6) for kind in kinds}
    measured = [k for k, s in enumerate(plant.rho) if s.measured]
    many["rho"][measured] = given.rho[:, [column]]
    x, f = (drawn(rng, box[:, :, column], count, 0.6) for box in (given.x, given.f))
    u = np.repeat(given.u[:, [column]], count, axis=1)
    d, w, p, rho = (many[kind] for kind in kinds)
    return np.array(plant.function().map(count)(x, u, d, f, w, p, rho)[0]), f
