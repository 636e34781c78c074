"""Plants for coordinates of their own, and admissible runs side by side: everything at any end."""

import functools

import numpy as np

import obsynth as ob

KINDS = ("held", "bang-bang", "uniform")
NEAR = 1.0 - 1e-12


def drawn(rng, steps, box):
    """Values in a box, one end held, jumps between both or anything; (steps, signals)."""
    columns = []
    for low, high in box:
        kind = rng.choice(KINDS)
        if kind == "uniform":
            columns.append(rng.uniform(low, high, steps))
            continue
        length = steps if kind == "held" else int(rng.integers(1, max(2, steps // 2)))
        columns.append(np.repeat(rng.choice([low, high], -(-steps // length)), length)[:steps])
    return np.array(columns).reshape(len(box), steps).T


def outside(observer, plant, seeds, steps, near, inputs=None, moving=False, law=None, substeps=4):
    """Instants with a state or a fault outside of its set or a status, and the last half widths.

    near (n, 2): box in which the runs begin and which is told; inputs: their box, by default the
    declared one; law: inputs from k and readings in their place; moving: faults that jump. With
    filters the means over the memory are held against the sets.
    """
    near, B, Ts = np.asarray(near, dtype=float), len(seeds), float(observer.model.Ts)
    u_box = plant.box("u") if inputs is None else np.asarray(inputs, dtype=float)
    rngs = [np.random.default_rng(seed) for seed in seeds]
    w = NEAR * np.array([drawn(rng, steps, plant.box("w")) for rng in rngs])
    u = np.array([drawn(rng, steps, u_box) for rng in rngs])
    f = np.array([drawn(rng, steps, plant.box("f")) for rng in rngs])
    f = f if moving else np.repeat(f[:, :1], steps, axis=1)
    x = np.array([near[np.arange(len(near)), rng.integers(0, 2, len(near))] for rng in rngs])
    memory = np.tile(observer.memory0(near.mean(axis=1), x_range=near)[:, None], B)
    step, flow = observer.step.map(B), plant.discretise("rk4", Ts / substeps).function().map(B)
    none, box = np.zeros((0, B)), plant.box("x")
    inside, wrong, seen = np.ones(B, dtype=bool), 0, 0
    for k in range(steps):
        inside &= ((x >= box[:, 0]) & (x <= box[:, 1])).all(axis=1)
        args = (f[:, k].T, w[:, k].T, none, none)
        y = np.array(flow(x.T, u[:, k].T, none, *args)[1])
        now = u[:, k].T if law is None else law(k, y)
        results = [np.array(part) for part in step(memory, now, y)]
        memory, (x_low, x_high, f_low, f_high), status = results[0], results[3:7], results[7]
        truth = (x < x_low.T) | (x > x_high.T)
        bad = truth.any(axis=1) | (status[0] != 0)
        if not moving:
            now_f = f[:, k]
            bad |= ((now_f < f_low.T) | (now_f > f_high.T)).any(axis=1)
        wrong, seen = wrong + int((bad & inside).sum()), seen + int(inside.sum())
        for _ in range(substeps):
            x = np.array(flow(x.T, now, none, *args)[0]).T
    widths = 0.5 * np.concatenate([x_high - x_low, f_high - f_low])[:, inside]
    return wrong, seen, widths.mean(axis=1) if inside.any() else None


def oscillator():
    """A mass on a spring whose velocity is shown, both counted from their least values."""
    plant = ob.Plant("oscillator")
    p, v = plant.states("p v", range=[(0, 4), (0, 8)])
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.process_faults("f", range=(-0.5, 0.5))
    noise, push = plant.disturbances("noise push", bound=[0.01, 0.02])
    plant.dynamics([v - 4, -4 * (p - 2) - (v - 4) / 5 + u + f + push])
    plant.outputs([v + noise])
    return plant


def behind_a_filter():
    """A force with a lag on an oscillator whose position is shown: the fault settles."""
    plant = ob.Plant("oscillator behind a lag")
    x, v, a = plant.states("x v a", range=[(-2, 2), (-4, 4), (-2, 2)])
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("f", of=u, range=(-0.5, 0.5))
    noise, push = plant.disturbances("noise push", range=[(-0.001, 0.003), (-0.02, 0.03)])
    plant.dynamics([v, -4 * x - v / 5 + a + push, u - a])
    plant.outputs([x + noise])
    return plant


def unstable():
    """A growing oscillation that no output shows but by what it does to another state."""
    plant = ob.Plant("growing")
    y, a, b = plant.states("y a b", range=(-2, 2))
    (u,) = plant.inputs("u", range=(-0.1, 0.1))
    (f,) = plant.process_faults("f", range=(-0.1, 0.1))
    (noise,) = plant.disturbances("noise", bound=0.002)
    plant.dynamics([-y + a - b, a / 4 - 2 * b + u + f, 2 * a + b / 4])
    plant.outputs([y + noise])
    return plant


def machine():
    """A permanent-magnet machine without a sensor of its speed; A depends on the currents."""
    plant = ob.Plant("machine")
    d, q, w = plant.states("i_d i_q w", range=[(-10, 10), (-10, 10), (-300, 300)])
    u = plant.inputs("u_d u_q", range=[(-0.5, 0.5), (-2, 2)])
    plant.actuator_faults("f", of=u[0], range=(-2, 2))
    n = plant.disturbances("n1:4", bound=[0.05, 0.05, 0.05])
    plant.dynamics(
        [(u[0] - 0.3 * d) * 500 + 4 * w * q, (u[1] - 0.3 * q - 0.4 * w) * 500 - 4 * w * d,
         (0.6 * q - 0.001 * w - n[2]) * 1000]
    )  # fmt: skip
    plant.outputs([d + n[0], q + n[1]])
    return plant


CASES = {
    "oscillator": (oscillator, {"gain_cap": 50.0, "Gamma": 200.0, "Ts": 0.01}, 350, 0.1),
    "lag": (behind_a_filter, {"gain_cap": 50.0, "Gamma": 200.0, "Ts": 0.02}, 500, 0.1),
    "growing": (unstable, {"gain_cap": 100.0, "Gamma": 200.0, "Ts": 0.01}, 700, 0.01),
    "machine": (machine, {"gain_cap": 1e5, "Gamma": 1e5, "Ts": 2e-5}, 400, 0.05),
}


def near(plant, share):
    box = plant.box("x")
    middle, half = box.mean(axis=1), 0.5 * share * np.ptp(box, axis=1)
    return np.column_stack([middle - half, middle + half])


@functools.cache
def of(name):
    """What "auto" makes of a case."""
    return made_of(name, coordinates="auto")


def made_of(name, **options):
    plant, given, steps, share = CASES[name]
    made = plant()
    observer = ob.SetAdaptiveObserver(**given, **options).design(made)
    return observer, made, steps, near(made, share)
