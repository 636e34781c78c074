"""Steps in single precision beside a plant in doubles, many runs at once."""

import itertools

import casadi as ca
import numpy as np
from tapes import NUMPY, TYPES, tape

from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS


def numpy_step(function, precision):
    """The step, instruction by instruction in numbers of a precision, for columns of runs."""
    kind = TYPES[precision]
    instance = function if function.is_a("SXFunction") else function.expand()

    def run(*columns):
        given = [[row.astype(kind) for row in part] for part in columns]
        count = columns[0].shape[1]
        with np.errstate(all="ignore"):
            found = tape(instance, given, NUMPY, lambda value: np.full(count, value, dtype=kind))
        sizes = np.cumsum([0, *(instance.numel_out(i) for i in range(instance.n_out()))])
        rows = np.array([np.broadcast_to(row, count).astype(float) for row in found])
        return [rows[a:b] for a, b in itertools.pairwise(sizes.tolist())]

    return run


def constants(function):
    """The numbers that stand in the instructions of a function."""
    instance = function if function.is_a("SXFunction") else function.expand()
    return {
        instance.instruction_constant(k)
        for k in range(instance.n_instructions())
        if instance.instruction_id(k) == ca.OP_CONST
    }


def inputs(scenario, k, y):
    """Inputs of every run, (n_u, lanes), numbers of single precision."""
    given = scenario.inputs
    lanes = y.shape[1]
    if scenario.feedback:
        u = np.column_stack([np.ravel(given(k, y[:, lane])) for lane in range(lanes)])
    else:
        u = np.tile(np.ravel(given(k) if callable(given) else given[k])[:, None], lanes)
    return u.astype(np.float32).astype(float)


def truth(plant, scenario, lanes, seed, steps):
    """States (N+1, n, lanes), inputs, faults and readings of runs within what is assumed.

    Noise and unknown inputs jump between the ends of their ranges, or stay at one; faults move as
    fast as they may between theirs; inputs are numbers of single precision.
    """
    rng, n = np.random.default_rng(seed), len(plant.x)
    x = np.array(scenario.x0, dtype=float)[:, None] + np.zeros((n, lanes))
    if scenario.x_range is not None:
        low, high = np.asarray(scenario.x_range, dtype=float).T[:, :, None]
        x = np.clip(x + 0.1 * (high - low) * rng.choice([-1.0, 1.0], (n, lanes)), low, high)
    # doubles round the plant's motion too, so that the very ends would be beyond them
    w_box = (1.0 - 1e-9) * np.where(np.isfinite(plant.box("w")), plant.box("w"), [-0.1, 0.1])
    p_box = plant.box("p").reshape(-1, 2)
    held = rng.choice([0, 1], (len(w_box), lanes))
    p = p_box[:, :1] + np.diff(p_box, axis=1) * rng.choice([0, 1], (len(p_box), lanes))
    f_box = plant.box("f").reshape(-1, 2)
    rates = np.array([np.inf if s.rate is None else float(s.rate) for s in plant.f])
    still = np.array([s.constant for s in plant.f], dtype=bool)
    low = np.where(np.isfinite(f_box[:, 0]), 0.3 * f_box[:, 0], -0.1)[:, None]
    high = np.where(np.isfinite(f_box[:, 1]), 0.3 * f_box[:, 1], 0.1)[:, None]
    f, way = np.zeros((len(f_box), lanes)), rng.choice([-1.0, 1.0], (len(f_box), lanes))
    d = np.zeros((len(plant.d), lanes))
    function = plant.function().map(lanes)
    rho = np.zeros((len(plant.rho), lanes))
    u = np.zeros((len(plant.u), lanes))
    found = {"x": [], "u": [], "f": [], "y": []}
    for k in range(steps + 1):
        side = np.where(rng.random(held.shape) < 0.3, 1 - held, held)
        w = np.take_along_axis(w_box, side, axis=1)
        d = 0.02 * np.where(d > 0.0, -1.0, 1.0) * rng.random(d.shape)
        u = inputs(scenario, k, np.array(function(x, u, d, f, w, p, rho)[1]))
        after, y = (np.array(part) for part in function(x, u, d, f, w, p, rho))
        for name, value in (("x", x), ("u", u), ("f", f), ("y", y)):
            found[name].append(value)
        step = np.where(np.isfinite(rates), rates, 0.5 * (high - low)[:, 0])[:, None]
        moved = f + way * step * rng.choice([0.0, 1.0], f.shape) * ~still[:, None]
        way = np.where((moved > high) | (moved < low), -way, way)
        x, f = after, np.clip(moved, low, high)
    return {name: np.array(value) for name, value in found.items()}


def follow(observer, scenario, runs, precision):
    """What the step says along runs, by the names of its outputs, (N+1, rows, lanes)."""
    step = numpy_step(observer.step, precision)
    lanes = runs["x"].shape[2]
    start = observer.memory0(scenario.guess, scenario.x_range)
    memory = np.repeat(np.asarray(start, dtype=float)[:, None], lanes, axis=1)
    said = {name: [] for name in STEP_OUTPUTS}
    for u, y in zip(runs["u"], runs["y"], strict=True):
        found = dict(zip(STEP_OUTPUTS, step(memory, u, y), strict=True))
        memory = found["memory_next"]
        for name, value in found.items():
            said[name].append(value)
    return {name: np.array(value) for name, value in said.items() if name != "memory_next"}


def outside(observer, runs, said):
    """How many states and faults are outside of sets, and the share of calls that are void.

    As long as a run has kept to the declared ranges that matter.
    """
    late, certificate = observer.fault_delay, observer.certificate
    domain = certificate.contract.guard(certificate.design).contractor.domain
    status = said["status"][:, 0].astype(int)
    x, f = runs["x"], runs["f"]
    low, high = domain.T[:, None, :, None]
    kept = np.logical_and.accumulate(((x >= low) & (x <= high)).all(axis=1))[:, None]
    away = (((x < said["x_lower"]) | (x > said["x_upper"])) & kept).sum()
    valid = (status & STATUS["fault_not_valid"] == 0)[late:, None] & kept[late:]
    lower, upper = said["f_lower"][late:], said["f_upper"][late:]
    then = f[: len(lower)]
    lost = (((then < lower) | (then > upper)) & valid).sum()
    void = (status & STATUS["void"] != 0) & kept[:, 0]
    assert kept.mean() > 0.5
    return int(away + lost), float(void.mean())


def mean_widths(said):
    """Mean half widths of the second half of runs, states then faults."""
    half = len(said["status"]) // 2
    ends = [(said[f"{k}_upper"][half:] - said[f"{k}_lower"][half:]) * 0.5 for k in "xf"]
    return np.concatenate([part.mean(axis=(0, 2)) for part in ends])
