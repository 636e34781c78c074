"""The interval observer under the guard: gaps in readings and inputs, turns of the copies."""

from dataclasses import replace

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core import contractor as contractor_module
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.step import Step
from obsynth.designs.interval.step import build_core

HORIZON = 15
KINDS = ("held", "bang-bang", "uniform")
SHRINK = 1.0 - 1e-12


def make_product():
    """Matrices that depend on a measured state, an input that may be missing."""
    p = ob.Plant("product")
    x = p.states("x1:3", range=[(-1, 1), (-2, 2)])
    (u,) = p.inputs("u", range=(-0.5, 0.5), nominal=0)
    (f,) = p.faults("f")
    w = p.disturbances("w1:3", bound=[0.1, 0.05])
    p.dynamics([x[0] / 2 + f, x[1] / 4 + x[0] * x[1] / 8 + u + w[0]], Ts=1)
    p.outputs([x[0] + w[1]])
    return p


@pytest.fixture(scope="module")
def plants(tight_plant, two_faults):
    return {"tight": tight_plant, "two faults": two_faults, "product": make_product()}


def drawn(rng, box, steps, kind):
    """Values in a box, (steps, n, .): an end held, jumps between ends, or anything."""
    middle, half = box.mean(axis=1), 0.5 * SHRINK * np.diff(box, axis=1)[:, 0]
    shape = (1 if kind == "held" else steps, len(box))
    sides = rng.uniform(-1, 1, shape) if kind == "uniform" else rng.choice([-1.0, 1.0], shape)
    return middle + half * np.broadcast_to(sides, (steps, len(box)))


def run(plant, step, memory, seed, steps, gaps):
    """Return instants with the truth outside or an untrue status, of one admissible run."""
    rng = np.random.default_rng(seed)
    kinds = [rng.choice(KINDS) if seed % 3 else "held" for _ in range(3)]
    w, rho, u = (
        drawn(rng, plant.box(kind).reshape(-1, 2), steps, how)
        for kind, how in zip(("w", "rho", "u"), kinds, strict=True)
    )
    u = 0.4 * u
    f, d = (
        drawn(rng, np.tile([-0.2, 0.2], (len(plant.names(kind)), 1)), steps, rng.choice(KINDS))
        for kind in ("f", "d")
    )
    truth, x, wrong, last = plant.function(), np.zeros(len(plant.x)), 0, None
    gap, level = rng.random(steps), rng.choice([-1.0, 1.0]) * SHRINK
    for k in range(steps):
        if plant.name == "product":  # the fault keeps x1 at an end of its range, or inside
            f[k] = (level if seed % 2 else rng.uniform(-1, 1)) - x[0] / 2
        rest = d[k], f[k], w[k], [], rho[k]
        y = np.array(truth(x, u[k], *rest)[1]).ravel()
        given_y, given_u = y.copy(), u[k].copy()
        blind, deaf = gaps and gap[k] < 0.12, gaps and u.size > 0 and 0.1 < gap[k] < 0.15
        if blind:
            given_y[rng.integers(y.size) :] = np.nan
        if deaf:
            given_u[0] = np.inf
        out = [np.array(v).ravel() for v in step(memory, given_u, given_y)]
        memory, status = out[0], int(out[7][0])
        good = np.all(out[3] <= x) and np.all(x <= out[4])
        good &= last is None or bool(np.all(out[5] <= last) and np.all(last <= out[6]))
        wrong += not (good and status & ~16 == 32 * blind + 2 * deaf)
        last = f[k]
        x = np.array(truth(x, u[k], *rest)[0]).ravel()
        box = plant.box("x")
        assert np.all(box[:, 0] <= x) and np.all(x <= box[:, 1])
    return wrong


def wrong(observer, seeds=8, gaps=True, narrow=0.0, steps=90):
    """Over several runs; `narrow` takes a share of the box from which the core begins."""
    plant, design = observer.model, observer.certificate.design
    core = build_core(design)

    def begin(x, f, kept):
        lost = 0.5 * narrow * (x.upper - x.lower)
        return core.begin(Ends(x.lower + lost, x.upper - lost), f, kept)

    guard = observer.certificate.contract.guard(design)
    step = Step(guard, replace(core, begin=begin)).build() if narrow else observer.step
    memory = observer.memory0(np.zeros(len(plant.x)))
    return sum(run(plant, step, memory, seed, steps, gaps) for seed in range(seeds))


@pytest.mark.long
@pytest.mark.parametrize("contraction", [True, False])
@pytest.mark.parametrize("cuts", [None, (), ("strips",)])
@pytest.mark.parametrize("name", ["tight", "two faults", "product"])
def test_no_admissible_run_leaves_the_sets(name, cuts, contraction, plants):
    """Status 32 and 2 where something is missing, never void; the truth inside, always."""
    options = {"cuts": cuts, "contraction": contraction, "horizon": HORIZON}
    assert wrong(ob.IntervalObserver(**options).design(plants[name])) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["tight", "two faults", "product"])
def test_no_admissible_run_leaves_the_sets_long(name, plants):
    observer = ob.IntervalObserver(horizon=HORIZON).design(plants[name])
    assert wrong(observer, seeds=100, steps=150) == 0


@pytest.mark.parametrize("name", ["tight", "product"])
def test_a_core_that_begins_in_a_smaller_box_is_seen(name, plants):
    """Mutant: 1 % of the box left out."""
    observer = ob.IntervalObserver(horizon=HORIZON).design(plants[name])
    assert wrong(observer, seeds=30, narrow=0.01) > 0


@pytest.mark.parametrize("name", ["tight", "product"])
def test_strips_of_less_noise_are_seen(name, plants, monkeypatch):
    """Mutant: 97 % of the noise."""
    right = contractor_module.Strip
    monkeypatch.setattr(
        contractor_module, "Strip", lambda row, a, b: right(row, 0.97 * a, 0.97 * b)
    )
    assert wrong(ob.IntervalObserver(horizon=HORIZON).design(plants[name])) > 0


@pytest.mark.parametrize("name", ["tight", "two faults", "product"])
def test_sets_are_narrow_again_soon_after_a_gap(name, plants):
    """No longer than decaying takes: a core that begins anew at every call would not be."""
    observer = ob.IntervalObserver().design(plants[name])
    plant = observer.model
    memory = observer.memory0(np.zeros(len(plant.x)))
    u, y = np.zeros(len(plant.u)), np.zeros(len(plant.output_names))
    widths = []
    for k in range(80):
        given = np.full_like(y, np.nan) if k == 40 else y
        out = [np.array(v).ravel() for v in observer.step(memory, u, given)]
        memory = out[0]
        widths.append(out[4] - out[3])
    np.testing.assert_allclose(widths[79], widths[39], rtol=0.01, atol=1e-9)
    assert np.all(np.isfinite(widths[41]))
