"""The bounds enclose in the floating point in which the step is evaluated."""

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.derive.rigour import UNIT, exact
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.certificate import Certificate
from obsynth.designs.core.step import Step
from obsynth.designs.interval.claims import claims
from obsynth.designs.interval.record import IntervalDesign
from obsynth.designs.interval.rows import Rows
from obsynth.designs.interval.step import build_core

BOX = np.tile([0.5, 1.5], (3, 1))


@pytest.fixture(scope="module")
def single(example):
    return ob.IntervalObserver(precision="single").design(example)


def tight_data(plant, rng, many, steps):
    """Corners everywhere: the truth runs along the bounds."""
    shape = (steps + 1, many)
    box = plant.box("w")
    side = rng.choice([-1.0, 1.0], (many, len(box)))
    w = box.mean(axis=1) + 0.5 * (box[:, 1] - box[:, 0]) * (1.0 - 1e-12) * side
    x0 = rng.choice([-1.0, 1.0], (many, 2)) * (1.0 - 1e-12)
    f = np.repeat(rng.uniform(-1.0, 1.0, (1, many, 1)), steps + 1, axis=0)
    return x0, np.broadcast_to(w, (*shape, len(box))), f, np.zeros((*shape, 0))


def run_tight(observer, run_many, step, many, steps, seed=1):
    data = tight_data(observer.model, np.random.default_rng(seed), many, steps)
    box = np.tile([-1.0, 1.0], (2, 1))
    none = np.zeros((0, many))
    return run_many(observer, *data, lambda k, y: none, box, step=step)


def example_data(plant, rng, many, steps):
    shape = (steps + 1, many)
    w = 0.01 * (1.0 - 1e-12) * rng.choice([-1.0, 1.0], (*shape, 5))
    rho = (1.0 - 1e-12) * rng.choice([-1.0, 1.0], (*shape, 2))
    f = np.cos(0.5 * np.arange(steps + 1))[:, None, None] * rng.uniform(-1, 1, (1, many, 1))
    return 1.0 + 0.5 * (1.0 - 1e-12) * rng.choice([-1.0, 1.0], (many, 3)), w, f, rho


def rounded(feedback):
    """The input that the actuators make is the number that the step is told."""
    return lambda k, y: feedback(k, y).astype(np.float32).astype(float)


def test_the_numpy_step_is_the_step(designs, numpy_step, paper_seeds, run_many, feedback):
    observer = designs["d1"]
    data = paper_seeds(range(5), 30)
    one = run_many(observer, *data, feedback, BOX)
    two = run_many(observer, *data, feedback, BOX, step=numpy_step(observer.step, np.float64))
    assert np.array_equal(one.x_lower, two.x_lower)
    assert np.array_equal(one.f_upper[1:], two.f_upper[1:])
    assert np.array_equal(one.status, two.status)


def test_single_precision_encloses(single, tight_plant, run_many, numpy_step, feedback):
    rng = np.random.default_rng(2)
    data = example_data(single.model, rng, 100, 100)
    run = run_many(single, *data, rounded(feedback), BOX, step=numpy_step(single.step))
    assert run.x_inside().all() and run.f_inside().all()
    observer = ob.IntervalObserver(precision="single").design(tight_plant)
    run = run_tight(observer, run_many, numpy_step(observer.step), 200, 60)
    assert run.x_inside().all() and run.f_inside().all()


def test_a_step_for_double_does_not_enclose_in_single(tight_plant, run_many, numpy_step):
    observer = ob.IntervalObserver().design(tight_plant)
    run = run_tight(observer, run_many, numpy_step(observer.step), 200, 60)
    assert not run.x_inside().all()
    run = run_tight(observer, run_many, None, 200, 60)
    assert run.x_inside().all() and run.f_inside().all()


def test_without_widening_double_does_not_enclose(tight_plant, run_many):
    observer = ob.IntervalObserver().design(tight_plant)
    design = IntervalDesign.from_record(observer.record)
    for name in ("prediction_rows", "share_rows", "state_rows", "estimate_rows"):
        rows = getattr(design, name)
        rows.__dict__["slack"] = lambda precision, rows=rows: np.zeros(rows.radius.shape)
    # noise at the very corners: nothing is left for rounding
    many, steps = 200, 60
    x0, w, f, rho = tight_data(observer.model, np.random.default_rng(3), many, steps)
    box = observer.model.box("w")
    w = np.where(w > box.mean(axis=1), box[:, 1], box[:, 0])
    step = Step(observer.certificate.contract.guard(design), build_core(design)).build()
    none, sides = np.zeros((0, many)), np.tile([-1.0, 1.0], (2, 1))
    run = run_many(observer, x0, w, f, rho, lambda k, y: none, sides, step=step)
    assert not run.x_inside().all()


@pytest.mark.long
def test_a_million_steps_in_single_precision(single, tight_plant, run_many, numpy_step, feedback):
    step, steps = numpy_step(single.step), 0
    for seed in range(4):
        data = example_data(single.model, np.random.default_rng(seed), 5000, 50)
        run = run_many(single, *data, rounded(feedback), BOX, step=step)
        assert run.x_inside().all() and run.f_inside().all()
        steps += run.x.shape[0] * run.x.shape[1]
    assert steps >= 1_000_000
    observer = ob.IntervalObserver(precision="single").design(tight_plant)
    run = run_tight(observer, run_many, numpy_step(observer.step), 10_000, 50)
    assert run.x_inside().all() and run.f_inside().all()


@pytest.mark.parametrize("precision", ["double", "single"])
def test_the_first_box_is_rounded_outwards(precision, two_faults, numpy_step):
    """Mutant: the box narrowed, or r taken without its widening."""
    observer = ob.IntervalObserver(precision=precision).design(two_faults)
    design = IntervalDesign.from_record(observer.record)
    box = np.array([[-0.1, 0.3], [0.7, 0.9], [-1 / 3, 1 / 3], [0.1, 0.1], [-2.3, 1.7]])
    kind = np.float64 if precision == "double" else np.float32
    X = Ends(ca.SX.sym("lower", 5), ca.SX.sym("upper", 5))
    begun = build_core(design).begin(X, Ends.unbounded(1), {})
    ends = [begun["r_lower"], begun["r_upper"]]
    first = numpy_step(ca.Function("first", [X.lower, X.upper], ends), kind)
    low, high = (v[:, 0].astype(float) for v in first(*(box.T.astype(kind)[:, :, None])))
    rows = exact(design.P) @ design.decoupled.T2
    for i, row in enumerate(rows):
        ends = [
            sorted((c * a, c * b))
            for c, (a, b) in zip(row, exact(box.astype(kind).astype(float)), strict=True)
        ]
        least, largest = sum(e[0] for e in ends), sum(e[1] for e in ends)
        size = sum(abs(e) for pair in ends for e in pair)
        assert exact(low)[i] <= least
        assert largest <= exact(high)[i]
        # two rounded sums, of five products and of the widening, no more
        far = exact(np.array(24 * UNIT[precision])).item() * size
        assert least - exact(low)[i] < far and exact(high)[i] - largest < far


@pytest.mark.parametrize(("units", "holds"), [(6, True), (3, True), (2, False), (0, False)])
def test_a_widening_below_what_rounding_costs_is_no_proof(single, monkeypatch, units, holds):
    """(t + 3) u per absolute term are needed; mutants: fewer units in the claim, or in the step."""
    real = Rows.slack

    def narrower(self, precision):
        every = np.stack([*self.upper, *self.lower])
        taken = np.abs(every).max(axis=0) * exact(np.array(6 - units, dtype=float)).item()
        return real(self, precision) - np.array(taken * exact(UNIT[precision]).item(), dtype=float)

    monkeypatch.setattr(Rows, "slack", narrower)
    claim = Certificate((*claims(single.certificate.design),), None, None)["rounding"]
    assert claim.holds is holds
