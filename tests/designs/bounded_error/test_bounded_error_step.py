"""The step under its guard: admissible runs with gaps, how a bound begins, states without range."""

from dataclasses import replace
from itertools import product

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.bounded_error.step import equations, first_bound
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.signals import Limits
from obsynth.designs.core.step import Step


def cart() -> ob.Plant:
    """A position without a range, measured; a speed with drag, which is not; a fault."""
    plant = ob.Plant("cart")
    (x,) = plant.states("x", unit="m")
    (v,) = plant.states("v", range=(-3, 3))
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("f", of=u, range=(-0.3, 0.3), rate=0.2)
    w = plant.disturbances("w1 w2", bound=[0.01, 0.02])
    plant.dynamics([v, u - v / 2 - v**3 / 40 + w[1]])
    plant.outputs([x + w[0]])
    return plant.discretise("euler", Ts=0.05)


@pytest.fixture(scope="module", params=["peak", "ellipsoid"])
def carried(request):
    if request.param == "ellipsoid":
        return request.getfixturevalue("enclosed")
    return ob.BoundedErrorUIO(bounds="peak", horizon=30, form="corrected").design(cart())


@pytest.fixture(scope="module")
def enclosed():
    return ob.BoundedErrorUIO(horizon=30, form="corrected").design(cart())


BOX = np.array([[-0.5, 0.5], [-1.0, 1.0]])


def march(observer, kind, seed, steps=150, gaps=True, step=None):
    """Run plant and step with admissible signals; return (holds, status) of every instant.

    kind: held extremes, extremes that switch at every instant, or uniform disturbances
    """
    rng = np.random.default_rng(seed)
    model, step = observer.model, step or observer.step
    move, w_box = model.function(), model.box("w")
    rate = np.array([s.rate for s in model.f])
    x, f = rng.choice([0, 1], 2), np.zeros(1)
    x = BOX[[0, 1], x]
    memory = observer.memory0(rng.uniform(*BOX.T), x_range=BOX)
    held = w_box[range(2), rng.integers(0, 2, 2)]
    push, told = 1.0, []
    for k in range(steps):
        if kind == "held":
            w = held if k % 60 else w_box[range(2), rng.integers(0, 2, 2)]
            held = w
        else:
            w = (
                w_box[range(2), rng.integers(0, 2, 2)]
                if kind == "switching"
                else rng.uniform(*w_box.T)
            )
        u, y = np.array([np.sin(0.05 * k)]), np.array([x[0] + w[0]])
        given = [u.copy(), y.copy()]
        if gaps and rng.random() < 0.05:
            given[rng.integers(0, 2)][:] = np.nan
        out = [np.array(v).ravel() for v in step(memory, *given)]
        memory, status = out[0], int(out[7][0])
        holds = np.all((out[3] <= x) & (x <= out[4])) and np.all((out[5] <= f) & (f <= out[6]))
        told.append((bool(holds), status))
        x = np.array(move(x, u, [], f, w, [], [])[0]).ravel()
        push = -push if rng.random() < 0.03 else push
        f = np.clip(f + push * rate, -0.3, 0.3)
    return told


@pytest.mark.parametrize("kind", ["held", "switching", "uniform"])
def test_admissible_runs_with_gaps_are_inside(carried, kind):
    told = [one for seed in range(4) for one in march(carried, kind, seed)]
    assert all(holds for holds, _ in told)
    assert all(status & (1 | 4 | 8) == 0 for _, status in told)
    assert any(status & 32 for _, status in told) and any(status & 2 for _, status in told)


@pytest.mark.long
def test_bounds_that_are_too_small_are_noticed(carried):
    """Mutant: the step of a design with a tenth of the proved bounds; only strips beside it."""
    design, contract = carried.certificate.design, carried.certificate.contract
    design = replace(design, options={**design.options, "cuts": ("strips",), "horizon": 10**9})
    if hasattr(design.bound, "P"):
        bound = replace(design.bound, inverse_diagonal=0.01 * design.bound.inverse_diagonal)
    else:
        bound = replace(design.bound, b=0.1 * design.bound.b)
    own = contract.certify(design, "lmi").observer()
    core = contract.build_core(replace(design, bound=bound))
    mutant = Step(contract.guard(design), core).build()
    for step, wrong in ((own.step, False), (mutant, True)):
        told = [march(own, "switching", seed, 300, False, step) for seed in range(4)]
        assert any(not holds or status & 8 for run in told for holds, status in run) == wrong


def levels(design, xi):
    """What s has to be at least for errors xi, (n + n_f,), by the definitions."""
    return np.full(len(xi), max(xi @ P @ xi for P in design.bound.P))


def begun(design, x_box, f_box, z, fhat):
    x, f = Ends.of(x_box), Ends.of(f_box)
    kept = {"z": ca.SX(z), "fhat": ca.SX(fhat)}
    return np.array(ca.evalf(first_bound(design, x, f, kept))).ravel()


@pytest.mark.parametrize("which", ["base", "cart"])
def test_a_bound_begins_above_every_corner(which, base, enclosed):
    """Corners of boxes around estimates anywhere; a box with one side attains it.

    Mutants: boxes narrowed by 1 %; the middle of T x in place of its distance to z.
    """
    design = (base if which == "base" else enclosed).certificate.design
    n, n_f = len(design.A), len(design.rate)
    noise = np.abs(design.E) @ (np.abs(design.W2) @ design.w_radius)
    rng = np.random.default_rng(0)
    for trial in range(30):
        size = rng.uniform(0, 2, (n + n_f, 1))
        if trial % 2:
            size *= np.arange(n + n_f)[:, None] == trial // 2 % (n + n_f)
        box = rng.normal(size=(n + n_f, 1)) + size * [-1, 1]
        guess = box.mean(axis=1) + (0 if trial % 2 else rng.normal(size=n + n_f))
        z, fhat = design.T @ guess[:n], guess[n:]
        s = begun(design, box[:n], box[n:], z, fhat)
        needed = []
        for corner in product(*box):
            xi = np.concatenate([design.T @ corner[:n] - z, corner[n:] - fhat])
            needed.append(levels(design, xi))
            for signs in product((-1, 1), repeat=int(np.count_nonzero(noise))):
                e = xi.copy()
                e[:n][noise > 0] += np.array(signs) * noise[noise > 0]
                needed.append(levels(design, e))
        assert np.all(s >= np.max(needed, axis=0))
        if trial % 2 and not np.any(noise):
            np.testing.assert_allclose(s, np.max(needed, axis=0), rtol=1e-9, atol=1e-9)


def test_a_bound_begins_with_numbers_for_unbounded_boxes(enclosed):
    everything = np.full((3, 2), [-np.inf, np.inf])
    s = begun(enclosed.certificate.design, everything[:2], everything[2:], np.zeros(2), np.zeros(1))
    assert np.all(np.isfinite(s)) and np.all(s > 1e90)


def test_only_states_that_enter_nonlinearly_are_clipped(enclosed):
    """Far away the position enters as it is, the speed as the nearest of its range."""
    move = equations(enclosed.certificate.design)
    far = np.array(move([1e4, 0], 0, 0, 1e4)[2]).ravel()
    assert far[0] == 1e4
    fast = np.array(move([0, 10.0], 0, 0, 0)[2]).ravel()
    np.testing.assert_allclose(fast, np.array(move([0, 3.0], 0, 0, 0)[2]).ravel())


def test_estimates_may_lie_where_the_bound_was_derived():
    x, f, _ = Limits.of(cart())
    assert x.tolist() == [[-1e6, 1e6], [-3, 3]]
    np.testing.assert_allclose(f, [[-0.9, 0.9]])


def test_a_bound_begins_anew_where_the_estimate_leaves_the_ranges(carried):
    """Mutant: `sound` left out."""
    layout = carried.memory_layout
    memory = carried.memory0([0.0, 0.0], x_range=BOX)
    # the general class goes on affinely: there the limits are a range away
    z, far = ("z", 3.5) if "z" in layout else ("prediction", 9.5)
    for speed, anew in ((0.0, 0), (far, 1)):
        given = np.array(carried.step(memory, [0], [0])[0]).ravel()
        given[layout[z].start : layout[z].start + 2] = [0.0, speed]
        after = np.array(carried.step(given, [0], [0])[0]).ravel()
        assert after[layout["begin"]] == anew


def test_a_state_that_enters_nonlinearly_needs_its_range():
    plant = ob.Plant("no range")
    x, v = plant.states("x v")
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([x / 2 + v / 4, -(v**3)], Ts=1)
    plant.outputs([x + w])
    with pytest.raises(ob.StructureError, match=r"^state v has no finite range"):
        ob.BoundedErrorUIO().design(plant)
