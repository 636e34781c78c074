"""What rounding adds to the intervals of the QPV observer, and what holding readings means."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from singles import numpy_step
from tapes import errors

import obsynth as ob
from methods import METHODS
from obsynth.designs.core.core import Seen
from obsynth.designs.qpv import claims as proofs
from obsynth.designs.qpv.claims import guarantee
from obsynth.designs.qpv.equations import build_update
from obsynth.designs.qpv.record import ASSUMED
from obsynth.designs.qpv.rounding import needed, of_step, settle
from obsynth.designs.qpv.step import build_core

ENTRY = METHODS["qpv_observer"]


@pytest.fixture(scope="module")
def observer():
    return ENTRY.method.design(ENTRY.plant())


@pytest.fixture(scope="module")
def design(observer):
    return observer.certificate.design


@pytest.fixture(scope="module")
def single():
    return replace(ENTRY.method, precision="single").design(ENTRY.plant())


def admissible(design, count, seed=0):
    """States of X, estimates with errors of E, readings with noise, many of them at the ends."""
    rng, plant = np.random.default_rng(seed), design.plant
    n, root = len(design.P), np.linalg.cholesky(np.linalg.inv(design.P))
    ball = rng.normal(size=(2, n, count))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True) * rng.choice([1.0, 1.0, 2.0], (2, 1, count))
    x = design.region.c[:, None] + np.linalg.cholesky(design.region.Q) @ ball[0]
    share = rng.random((3, count))
    share = np.where(rng.random(share.shape) < 0.4, np.round(share), share)
    (u_box,), (w_box,) = plant.box("u"), plant.box("w")
    u, w = (box[0] + np.diff(box) * s for box, s in zip((u_box, w_box), share[:2], strict=True))
    return [x - root @ ball[1], u[None], x[:1] + w, share[2:]]


def worst(design, delta):
    return np.sqrt(np.einsum("ik,ij,jk->k", delta, design.P, delta).max())


def test_one_step_is_rounded_by_less_than_the_allowance_counts(design):
    """Against 300 bits, at states of X and errors of E. Mutant: half the unit roundoff."""
    delta = errors(build_update(design), admissible(design, 100), "double")[: len(design.P)]
    rho = needed(design) * -np.expm1(-0.5 * design.noise.rate * design.Ts)
    assert needed(design) <= design.rounding < 1.01 * needed(design)
    assert 0 < worst(design, delta) <= rho < 12 * worst(design, delta)


@pytest.mark.parametrize("count", [4000, pytest.param(1_000_000, marks=pytest.mark.long)])
def test_one_step_in_single_precision_is_within_its_bound(single, count):
    """At most 4 times what is seen of the state. Mutants: doubles; no rounding of readings."""
    design = single.certificate.design
    assert needed(design) <= design.rounding < 0.01
    seen, update = np.zeros(len(design.P)), build_update(design)
    steps = [numpy_step(update, precision) for precision in ("single", "double")]
    for seed in range(max(1, count // 100_000)):
        points = admissible(design, min(count, 100_000), seed)
        points = [p.astype("f4").astype(float) if k != 2 else p for k, p in enumerate(points)]
        found, exact = (step(*points)[0] for step in steps)
        seen = np.maximum(seen, np.abs(found - exact).max(axis=1))
    assert (seen <= of_step(design)).all()
    assert of_step(design)[0] <= 4.0 * seen[0]


def test_the_first_level_holds_for_the_numbers_of_single_precision(single):
    """A guess is rounded, and V with it up. Mutants: of the guess as given; to the nearest."""
    design = single.certificate.design
    for guess in np.random.default_rng(3).uniform(4.9, 5.1, 50):
        memory = single.memory0([guess], x_range=[(4.95, 5.05)], f_range=[(-0.03, 0.03)])
        state = memory[:2]
        assert np.array_equal(state, state.astype(np.float32))
        ends = np.array([[4.95, -0.03], [4.95, 0.03], [5.05, -0.03], [5.05, 0.03]]) - state
        level = np.float32(memory[single.memory_layout["level"]][0])
        assert np.einsum("ki,ij,kj->k", ends, design.P, ends).max() <= float(level)


@pytest.mark.long
def test_a_design_whose_rounding_has_no_room_is_refused_with_both_half_widths():
    """A level of which single precision keeps nothing. Mutant: no limit of the allowance."""
    with pytest.raises(ob.InfeasibleDesign, match=r"no room: take precision='double'") as refused:
        far(10**5, "single")
    assert "in single precision, +-0." in str(refused.value)
    assert far(10**5, "double").certificate.valid


def far(middle, precision):
    """A vessel whose level moves little about a large number."""
    plant = ob.Plant("far")
    (x,) = plant.states("x", range=(middle - 1, middle + 1), nominal=middle)
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.process_faults("f", range=(-1e-6, 1e-6))
    (w,) = plant.disturbances("w", bound=0.001)
    plant.dynamics([-(x - middle) + f * x + u + w])
    plant.outputs([x + w])
    return ob.QPVObserver(precision=precision).design(plant)


def test_the_allowance_holds_what_all_steps_add(design):
    """Root of V, moved by rho after every sample. Mutants: rho of one step alone, exp(-rate Ts)
    in place of its root."""
    share = np.exp(-design.noise.rate * design.Ts)
    value = needed(design)
    rho = value * -np.expm1(-0.5 * design.noise.rate * design.Ts)
    delta = of_step(design)
    assert np.sqrt(delta @ np.abs(design.P) @ delta) <= rho * (1 + 1e-9)
    for first in (0.0, 0.3, 1.0):
        level, root = first**2, first
        for _ in range(5000):
            level = 1 - share + share * level
            root = np.sqrt(1 - share + share * root**2) + rho
            assert root <= np.sqrt(level) + value * (1 + 1e-3)
    # and most of it is needed where nothing drives V
    root = 0.0
    for _ in range(20_000):
        root = np.sqrt(share) * root + rho
    assert 0.9 * value < root <= value


def test_innovations_are_as_large_as_the_matrices_may_be(design):
    """Mutants: the middle of C alone, of H alone."""
    assert design.noise is not None
    data = design.data
    for name in ("C_radius", "H_radius"):
        wider = replace(design)
        vars(wider)["data"] = replace(data, **{name: getattr(data, name) + 1.0})
        assert (of_step(wider) > of_step(design)).any(), name


def test_the_error_set_has_room_for_it(design):
    """Mutants: a claim about E itself; whatever is stored."""
    assert proofs.prove_rounding(design).holds
    assert not proofs.prove_rounding(replace(design, rounding=0.7)).holds
    assert not proofs.prove_rounding(replace(design, rounding=0.9 * design.rounding)).holds


@pytest.mark.long
def test_the_error_set_is_solved_for_with_room_in_single_precision(noiseless):
    """Without, its claim does not hold. Mutant: no second solution."""
    design = noiseless.certificate.design
    options = {**design.options, "precision": "single"}
    assert not proofs.prove_rounding(settle(replace(design, options=options))).holds
    single = ob.QPVObserver(
        region=design.region,
        E_x=[1.5],
        initial_error=[1.0, 0.3],
        alpha=0.8,
        gain_cap=30.0,
        performance_output=[[0, 1]],
        precision="single",
    ).design(noiseless.certificate.design.plant)
    assert single.certificate.valid and single.certificate.design.rounding < 1e-3


def test_no_bound_is_an_assumption_that_is_said(design):
    """A gain that rounds too much: the design is not refused for it."""
    wild = settle(replace(design, L=design.L * 2.0**45))
    assert wild.rounding == ASSUMED
    assert "which is not proved" in guarantee(wild).assumptions[1]
    assert "rounding" not in {claim.name for claim in proofs.claims(wild)}
    single = replace(design, options={**design.options, "precision": "single"}, rounding=ASSUMED)
    with pytest.raises(ob.CertificateError, match="in single precision is assumed in the stored"):
        single.check()


def test_a_reading_that_is_held_counts_as_a_disturbance(observer, design):
    """The motion that the guarantee of the step names: y_k = x(t) + w(t) all through a sample.

    Mutant: a disturbance that leaves its range to explain the reading (y_k off by .05).
    """
    step, plant = observer.step, design.plant
    rng = np.random.default_rng(4)

    def missed(spread):
        x, f, theta, u, h = 5.03, 0.03, 0.4, 7.0, design.Ts
        memory = observer.memory0([5.0], x_range=[(4.95, 5.05)], f_range=[(-0.05, 0.05)])
        outside, quiet = 0, 0
        for k in range(700):
            y = x + spread * (1.0 if k % 400 < 200 else -1.0) * rng.uniform(0.7, 0.9)
            found = step(memory=memory, u=u, y=y, theta=theta)
            quiet += int(float(found["status"]) == 0)
            low, high = float(found["x_lower"]), float(found["x_upper"])
            inside = float(found["f_lower"]) <= f <= float(found["f_upper"])
            outside += int(not (low <= x <= high and inside))
            memory = found["memory_next"]
            # x' = -(1 + theta) x + f x + u + w with w = y - x, held y, in closed form
            a, b = -(1 + theta) + f - 1, u + y
            x = (x + b / a) * np.exp(a * h) - b / a
            assert spread > 0.01 or abs(y - x) <= plant.box("w")[0, 1]
        return outside, quiet

    outside, quiet = missed(0.01)
    assert (outside, quiet) == (0, 700)
    assert missed(0.05)[0] > 0


def test_sets_of_single_precision_hold_the_motions_of_the_guarantee(single):
    """Six of them beside the step in NumPy's float32.

    Mutant: a disturbance that leaves its range to explain the reading (y_k off by .03).
    """
    step, h = numpy_step(single.step, "single"), single.certificate.design.Ts
    bound = single.model.box("w")[0, 1]

    def missed(spread, steps):
        rng = np.random.default_rng(4)
        x = 5.0 + rng.uniform(-0.04, 0.04, (1, 6))
        f = np.array([[0.04, -0.04, 0.03, -0.03, 0.0, 0.02]])
        theta, u = np.full((1, 6), 0.375), np.full((1, 6), 7.0)
        memory = single.memory0([5.0], x_range=[(4.95, 5.05)], f_range=[(-0.05, 0.05)])
        memory, outside, quiet = np.tile(memory[:, None], 6), 0, 0
        for k in range(steps):
            y = x + spread * (1.0 if k % 60 < 40 else -1.0) * rng.uniform(0.5, 0.7, x.shape)
            memory, _, _, *found = step(memory, u, y, theta)
            low, high, least, most, status = found
            quiet += int((status == 0).sum())
            outside += int((~((low <= x) & (x <= high) & (least <= f) & (f <= most))).sum())
            # x' = -(1 + theta) x + f x + u + w with w = y - x, held y, in closed form
            a, b = -(1 + theta) + f - 1, u + y
            x = (x + b / a) * np.exp(a * h) - b / a
            assert spread > 0.01 or (abs(y - x) <= bound).all()
        return outside, quiet

    assert missed(0.01, 80) == (0, 480)
    assert missed(0.05, 80)[0] > 0


@pytest.mark.parametrize("level", [0.0, 0.25, 1.0])
def test_intervals_are_wider_by_the_allowance(design, level):
    """sqrt(V) + allowance times the half widths of E. Mutants: taken off; ends as rounded."""
    design = replace(design, rounding=1e-3)
    state, n = design.region.c, len(design.plant.x)
    parts = {"xhat": state[:n], "fhat": state[n:], "level": level}
    seen = Seen(
        {k: ca.SX(ca.DM(v)) for k, v in parts.items()}, *map(ca.SX, (7.0, 0.4, state[0])), [1]
    )
    known = build_core(design).run(seen)
    ends = ca.vertcat(known.x.lower, known.f.lower, known.x.upper, known.f.upper)
    low, high = np.array(ca.evalf(ends)).reshape(2, -1)
    wanted = (np.sqrt(level) + 1e-3) * np.sqrt(design.inverse_diagonal)
    # the root, the product and the end are rounded themselves
    wanted += 8 * 2.0**-53 * (np.abs(state) + wanted)
    for half in (high - state, state - low):
        assert (half >= wanted).all()
        assert half == pytest.approx(wanted, rel=1e-6, abs=1e-9)
