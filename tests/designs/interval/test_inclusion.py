"""States and faults inside their intervals at tolerance 0, and mutants that are not."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.derive.rigour import nearest
from obsynth.designs.core.step import Step
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.designs.interval.step import build_core

SHRINK = 1.0 - 1e-12
NOISES = ("uniform", "bang-bang", "corner")
SCHEDULES = ("box", "vertices", "paper")
VARIANTS = {
    "vertex, contracted": {},
    "vertex": {"contraction": False},
    "paper, contracted": {"bound": "paper"},
    "paper": {"bound": "paper", "contraction": False},
}


def drawn(rng, box, shape, kind):
    """Values in a box that is shrunk by 1e-12 of itself: uniform, at its ends, at one corner."""
    middle, half = box.mean(axis=1), 0.5 * (box[:, 1] - box[:, 0]) * SHRINK
    size = (*shape, len(box))
    if kind == "uniform":
        return middle + half * rng.uniform(-1.0, 1.0, size)
    if kind == "corner":
        return middle + half * np.broadcast_to(rng.choice([-1.0, 1.0], (shape[1], len(box))), size)
    return middle + half * rng.choice([-1.0, 1.0], size)


def scheduled(rng, box, shape, kind):
    if kind == "paper":
        k = np.arange(shape[0])
        path = np.column_stack([np.sin(0.2 * k), np.cos(0.1 * k)])
        return np.broadcast_to(path[:, None], (*shape, 2)) * SHRINK
    return drawn(rng, box, shape, "uniform" if kind == "box" else "bang-bang")


def steps_of_faults(rng, shape):
    """Jumps at random instants between random levels."""
    jumps = rng.uniform(-1.0, 1.0, shape) * (rng.uniform(size=shape) < 0.2)
    return np.clip(np.cumsum(jumps, axis=0), -1.0, 1.0)[..., None]


def start(rng, box, many, corner):
    sides = rng.choice([-1.0, 1.0], (many, len(box)))
    if not corner:
        sides = rng.uniform(-1.0, 1.0, (many, len(box)))
    return box.mean(axis=1) + 0.5 * (box[:, 1] - box[:, 0]) * SHRINK * sides


def example_data(plant, seed, many, noise, schedule, steps=100):
    rng = np.random.default_rng(seed)
    shape = (steps + 1, many)
    box = np.tile([0.5, 1.5], (3, 1))
    return (
        start(rng, box, many, corner=noise != "uniform"),
        drawn(rng, plant.box("w"), shape, noise),
        steps_of_faults(rng, shape),
        scheduled(rng, plant.box("rho"), shape, schedule),
    )


def complete(run):
    return run.x_inside().all() and run.f_inside().all()


@pytest.fixture(scope="module")
def variants(example):
    gains = (np.diag([1.0, -1.0]), [0.4, -1])
    return {
        name: ob.IntervalObserver(gains=gains, **options).design(example)
        for name, options in VARIANTS.items()
    }


BOX = np.tile([0.5, 1.5], (3, 1))


@pytest.mark.long
@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize(
    ("noise", "schedule"),
    [("uniform", "box"), ("bang-bang", "vertices"), ("corner", "paper"), ("bang-bang", "box")],
)
def test_fifty_seeds(name, noise, schedule, variants, example, run_many, feedback):
    data = example_data(example, 1, 50, noise, schedule)
    run = run_many(variants[name], *data, feedback, BOX)
    assert complete(run)
    assert not run.status[1:].any()
    # a set reported one step late is caught: it is narrower than the motion of one step
    late = (run.x_lower[:-1] <= run.x[1:]) & (run.x[1:] <= run.x_upper[:-1])
    assert late.mean() < 0.7
    late = (run.f_lower[1:] <= run.f[1:]) & (run.f[1:] <= run.f_upper[1:])
    assert late.mean() < 0.97


@pytest.mark.long
@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_thousand_seeds(noise, schedule, variants, example, run_many, feedback):
    data = example_data(example, 2, 1000, noise, schedule)
    for observer in variants.values():
        run = run_many(observer, *data, feedback, BOX)
        assert complete(run)
        assert not run.status[1:].any()


def two_faults_run(run_many, observer, seed, noise, many, steps=60, step=None, size=1.0):
    plant = observer.model
    rng = np.random.default_rng(seed)
    shape = (steps + 1, many)
    u = size * rng.uniform(-2.0, 2.0, (steps + 1, 2, many))
    return run_many(
        observer,
        start(rng, np.tile([-1.0, 1.0], (5, 1)), many, corner=noise != "uniform"),
        drawn(rng, plant.box("w"), shape, noise),
        3.0 * size * steps_of_faults(rng, shape),
        drawn(rng, plant.box("rho"), shape, "bang-bang" if noise == "corner" else "uniform"),
        lambda k, y: u[k],
        x_range=np.tile([-1.0, 1.0], (5, 1)),
        d=10.0 * size * steps_of_faults(rng, shape),
        step=step,
    )


@pytest.fixture(scope="module")
def mixed(two_faults):
    return {
        # faults of 3 and 10 take the states out of their ranges, so that nothing may begin anew
        contraction: ob.IntervalObserver(contraction=contraction, horizon=100).design(two_faults)
        for contraction in (True, False)
    }


@pytest.mark.parametrize("noise", NOISES)
@pytest.mark.parametrize("contraction", [True, False])
def test_asymmetric_noise_and_negative_gains(noise, contraction, mixed, run_many):
    observer = mixed[contraction]
    inner = observer.gains["K0"] @ np.linalg.inv(observer.gains["R0"])
    assert inner.min() < -0.1
    run = two_faults_run(run_many, observer, 3, noise, 50)
    assert complete(run)
    assert not (run.status[1:] % 16).any()


@pytest.mark.long
@pytest.mark.parametrize("noise", NOISES)
def test_asymmetric_noise_over_a_thousand_seeds(noise, mixed, run_many):
    for observer in mixed.values():
        assert complete(two_faults_run(run_many, observer, 4, noise, 1000))


def test_steady_half_widths_hold_and_are_not_far(mixed, variants, run_many, example, feedback):
    for observer in variants.values():
        data = example_data(example, 5, 50, "bang-bang", "vertices")
        run = run_many(observer, *data, feedback, BOX)
        observed = np.concatenate(
            [
                0.5 * (run.x_upper - run.x_lower)[60:].max(axis=(0, 1)),
                0.5 * (run.f_upper - run.f_lower)[60:].max(axis=(0, 1)),
            ]
        )
        assert np.all(observed <= observer.half_widths)
        # x2 does not depend on where the state is, so the prediction is what is observed
        assert observer.half_widths[1] == pytest.approx(observed[1], rel=1e-4)
    for observer in mixed.values():
        run = two_faults_run(run_many, observer, 6, "bang-bang", 50, size=0.2)
        assert np.abs(run.x).max() < 6.0
        observed = 0.5 * (run.x_upper - run.x_lower)[40:].max(axis=(0, 1))
        assert np.all(observed <= observer.half_widths[:5])


def mutated(observer, mutate):
    """A step made from the observer's design with one mistake in it."""
    design = IntervalDesign.from_record(observer.record)
    mutate(design)
    return Step(observer.certificate.contract.guard(design), build_core(design)).build()


def swapped(name):
    def mutate(design):
        rows = getattr(design, name)
        design.__dict__[name] = Rows(rows.sizes, rows.lower, rows.upper, rows.radius)

    return mutate


def mirrored_noise(name):
    """The box of the noise with its sign turned: the same on symmetric noise."""

    def mutate(design):
        rows = getattr(design, name)

        def turn(tables, others):
            changed = [t.copy() for t in tables]
            for table, other in zip(changed, others, strict=True):
                table[:, -1] = -other[:, -1]
            return tuple(changed)

        design.__dict__[name] = Rows(
            rows.sizes, turn(rows.upper, rows.lower), turn(rows.lower, rows.upper), rows.radius
        )

    return mutate


def without_noise(name):
    def mutate(design):
        rows = getattr(design, name)
        middle = [
            np.column_stack([u[:, :-1], (u[:, -1] + v[:, -1]) / 2])
            for u, v in zip(rows.upper, rows.lower, strict=True)
        ]
        lower = [
            np.column_stack([v[:, :-1], m[:, -1]]) for v, m in zip(rows.lower, middle, strict=True)
        ]
        design.__dict__[name] = Rows(rows.sizes, tuple(middle), tuple(lower), rows.radius)

    return mutate


def one_vertex(name):
    def mutate(design):
        rows = getattr(design, name)
        design.__dict__[name] = Rows(rows.sizes, rows.upper[:1], rows.lower[:1], rows.radius)

    return mutate


def without_rotation(design):
    """z taken for x: the rows of the identity in place of H2'."""
    free = design.decoupled
    rotated = replace(free, T2=free.T2[:, ::-1] if len(free.T2) else free.T2)
    design.__dict__["decoupled"] = rotated


MUTANTS = {
    "swapped prediction": swapped("prediction_rows"),
    "swapped state": swapped("state_rows"),
    "swapped fault": swapped("estimate_rows"),
    "swapped share": swapped("share_rows"),
    "one vertex for r": one_vertex("prediction_rows"),
    "one vertex for f": one_vertex("share_rows"),
    "no rotation": without_rotation,
}
# The bounds of a plant with spread matrices have room to hide a wrong noise in.
NOISE_MUTANTS = {
    "sign of the noise in r": mirrored_noise("prediction_rows"),
    "sign of the noise in x": mirrored_noise("state_rows"),
    "sign of theta in f": mirrored_noise("estimate_rows"),
    "sign of theta in the share": mirrored_noise("share_rows"),
    "no noise in r": without_noise("prediction_rows"),
    "no noise in x": without_noise("state_rows"),
    "no noise in f": without_noise("estimate_rows"),
    "no noise in the share": without_noise("share_rows"),
}


@pytest.mark.long
@pytest.mark.parametrize("mutant", MUTANTS)
def test_mutants_leave_the_truth_outside(mutant, mixed, run_many):
    observer = mixed[False]
    step = mutated(observer, MUTANTS[mutant])
    escapes = [
        not complete(two_faults_run(run_many, observer, 7, noise, 50, step=step))
        for noise in NOISES
    ]
    assert any(escapes)


def test_the_unchanged_design_is_no_mutant(mixed, run_many):
    observer = mixed[False]
    step = mutated(observer, lambda design: None)
    assert complete(two_faults_run(run_many, observer, 7, "corner", 50, step=step))


@pytest.fixture(scope="module")
def tight(tight_plant):
    return ob.IntervalObserver().design(tight_plant)


def tight_run(run_many, observer, noise, step=None):
    rng = np.random.default_rng(8)
    box = np.tile([-1.0, 1.0], (2, 1))
    shape = (61, 400)
    return run_many(
        observer,
        start(rng, box, 400, corner=True),
        drawn(rng, observer.model.box("w"), shape, noise),
        steps_of_faults(rng, shape),
        np.zeros((*shape, 0)),
        lambda k, y: np.zeros((0, 400)),
        x_range=box,
        step=step,
    )


def test_bounds_of_a_tight_plant_are_attained(tight, run_many):
    runs = {noise: tight_run(run_many, tight, noise) for noise in NOISES}
    assert all(complete(run) for run in runs.values())
    gap = runs["corner"].x_upper[50:] - runs["corner"].x[50:]
    assert gap.min(axis=(0, 1)) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert gap.min() >= 0.0


@pytest.mark.parametrize("mutant", NOISE_MUTANTS)
def test_a_wrong_noise_leaves_the_truth_outside(mutant, tight, run_many):
    step = mutated(tight, NOISE_MUTANTS[mutant])
    assert not all(complete(tight_run(run_many, tight, noise, step)) for noise in NOISES)


ONE_STEP = ("prediction_rows", "share_rows", "state_rows")


def largest_deviation(design, name):
    """Rows against every corner of the noise and every vertex, for fixed y, r, u: (over, under).

    `over` is by how much a corner exceeds the bounds, `under` by how much the bounds exceed all
    corners.
    """
    rng = np.random.default_rng(9)
    model, free = design.model, design.decoupled
    Phi, W, S, T2, F_left = (nearest(m) for m in (free.Phi, free.W, design.S, free.T2, free.F_left))
    W1, W2 = nearest(model.W1), nearest(model.W2)
    box = model.plant.box("w")
    corners = np.array(list(itertools.product(*box)))
    n, n_u = model.n, len(model.plant.u)
    rows = getattr(design, name)
    over, under = -np.inf, -np.inf
    for _ in range(20):
        y, r, u = (rng.uniform(-1, 1, k) for k in (len(model.C), len(S), n_u))
        x = (y - corners @ W2.T) @ Phi.T + W @ S @ r
        values = []
        for vertex in map(nearest, model.vertices):
            moved = x @ vertex[:, :n].T + vertex[:, n : n + n_u] @ u + vertex[:, -1]
            moved = moved + corners @ W1.T
            values.append(
                {
                    "prediction_rows": moved @ (design.P @ T2).T,
                    "share_rows": -moved @ F_left[: design.n_f].T,
                    "state_rows": x,
                }[name]
            )
        stacked = np.concatenate(values)
        known = {"r_upper": r, "r_lower": r, "y": y, "u": u, "one": [1.0]}
        s = np.concatenate([known[key] for key in rows.sizes])
        upper = np.max([nearest(t) @ s for t in rows.upper], axis=0)
        lower = np.min([nearest(t) @ s for t in rows.lower], axis=0)
        ends = np.concatenate([stacked.max(axis=0) - upper, lower - stacked.min(axis=0)])
        over, under = max(over, ends.max()), max(under, -ends.min())
    return over, under


@pytest.mark.parametrize("name", ONE_STEP)
def test_one_step_is_exactly_the_hull_of_all_corners(name, mixed, designs):
    for observer in (mixed[False], designs["d0"]):
        design = IntervalDesign.from_record(observer.record)
        if name == "prediction_rows":
            # without the output injection, which is zero for the truth only
            design.__dict__["L"] = np.zeros_like(design.L)
        over, under = largest_deviation(design, name)
        assert over == pytest.approx(0.0, abs=1e-12)
        assert under == pytest.approx(0.0, abs=1e-12)


# x has one set of coefficients, so there is no vertex to leave out
PAIRS = [
    (name, mutate)
    for name in ONE_STEP
    for mutate in (swapped, mirrored_noise, without_noise, one_vertex)
    if (name, mutate) != ("state_rows", one_vertex)
]


@pytest.mark.parametrize(("name", "mutate"), PAIRS)
def test_one_step_sees_the_mutants(name, mutate, mixed):
    design = IntervalDesign.from_record(mixed[False].record)
    design.__dict__["L"] = np.zeros_like(design.L)
    mutate(name)(design)
    over, _ = largest_deviation(design, name)
    assert over > 1e-4
