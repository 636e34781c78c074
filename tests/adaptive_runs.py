"""Admissible runs side by side: constant faults, disturbances and inputs at any of their ends."""

import numpy as np

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
