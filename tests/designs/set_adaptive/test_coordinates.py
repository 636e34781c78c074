"""Bounds that move in z = S x: plants whose own coordinates have no Metzler error matrix.

Mutants: S^-1 with |S^-1| or without its signs in `image`, what S leaves of D left out of the drive,
disturbances and faults not carried into z, an end of `product`, of `speeds` or of `_reached`, the
share of rounding in `carried`, S^-1 inverted in doubles.
"""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from adaptive_runs import CASES, made_of, of, oscillator, outside, unstable

import obsynth as ob
from obsynth.derive.rigour import allowance, exact, inverse
from obsynth.designs.set_adaptive import equations, step
from obsynth.designs.set_adaptive.equations import carried, product
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

SHARES = {"oscillator": (0, 0.6), "lag": (3, 0.7), "growing": (1, 0.6), "machine": (2, 0.1)}
"""Which of the states and faults, in shares of its range, is known how well at least."""


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return request.param, *of(request.param)


@pytest.fixture(scope="module")
def lag():
    return of("lag")[0]


@pytest.mark.long
def test_what_own_coordinates_cannot_is_designed_and_contained(case):
    """Ends of disturbances, inputs and faults held, jumping or anything: nothing outside."""
    name, observer, plant, steps, box = case
    assert observer.certificate.check().valid
    wrong, seen, widths = outside(observer, plant, range(12), steps, box)
    assert wrong == 0
    assert seen > 8 * steps
    which, share = SHARES[name]
    ranges = np.concatenate([np.ptp(plant.box("x"), axis=1), np.ptp(plant.box("f"), axis=1)])
    assert 2.0 * widths[which] < share * ranges[which]


@pytest.mark.parametrize("digits", [1, 2])
def test_coordinates_of_few_digits_are_as_safe(lag, digits):
    """What they leave of D is carried by the drive. Mutant: it is left out."""
    S = np.round(lag.gains["S"], digits)
    observer, plant, steps, box = made_of("lag", coordinates=S)
    assert observer.record["coordinates"]["S"] == S.tolist()
    wrong, _, widths = outside(observer, plant, range(8), steps if digits == 2 else 150, box)
    assert wrong == 0
    assert digits == 1 or widths[3] < 0.4


def test_in_its_own_coordinates_it_is_refused_by_name():
    method = SetAdaptiveObserver(gain_cap=50.0)
    with pytest.raises(
        ob.InfeasibleDesign, match="what p does to v is as low as -4; no output shows p"
    ) as refusal:
        method.design(oscillator())
    assert refusal.value.entry == (1, 0)
    assert 'coordinates="auto"' in str(refusal.value)
    with pytest.raises(ob.StructureError, match="may be negative"):
        method.problem(unstable(), 0.1)


def test_states_of_any_sign_need_no_option():
    """Mutant: their own coordinates, in which bounds of A x say nothing."""
    plain, told = (made_of("growing", coordinates=c)[0] for c in (None, "auto"))
    assert plain.record["coordinates"]["S"] == told.record["coordinates"]["S"]


# -- the drive, point by point ---------------------------------------------------------


def numbers_of(pair):
    return [np.array(ca.evalf(ca.SX(part))).ravel() for part in pair]


@pytest.mark.parametrize("name", ["lag", "machine"])
@pytest.mark.parametrize("seed", range(3))
def test_the_drive_holds_what_moves_z_and_is_attained(name, seed):
    """S x' - D S x over the ends of the disturbances, for states that are known: its ends are c.

    Mutants: W1 in place of S W1, own left out of S A - own, L C x fed from the wrong end.
    """
    observer, plant, *_ = of(name)
    design, rng = observer.certificate.design, np.random.default_rng(seed)
    S, D = np.array(design.coordinates.S), design.coordinates.D
    box = plant.box("x")
    x = rng.uniform(*box.T)
    u = rng.uniform(*plant.box("u").T)
    y = ca.SX(design.C @ x)
    states = equations.ends(design, y, y, False)
    known = (ca.SX(x), ca.SX(x))
    found = equations.drives(design, states, (y, y), ca.SX(u), ca.SX(0, 1), known)
    low, high = (numbers_of((drive.c,))[0] for drive in found)
    size = numbers_of((found[0].size,))[0] * design.rounding
    w_box, f = plant.box("w"), plant.function()
    corners = np.array(np.meshgrid(*w_box)).reshape(len(w_box), -1).T
    zero = np.zeros(len(plant.f))
    moved = [np.array(f(x, u, [], zero, w, [], [])[0]).ravel() for w in corners]
    forced = np.array([S @ rate - D @ (S @ x) for rate in moved])
    assert (low - size <= forced).all()
    assert (forced <= high + size).all()
    assert (np.abs(forced.min(axis=0) - low) <= size + 1e-9 * np.abs(low)).all()
    assert (np.abs(forced.max(axis=0) - high) <= size + 1e-9 * np.abs(high)).all()
    # states and readings between ends, and so A: every point in between is held
    low, high = x - rng.uniform(0, 1, len(x)), x + rng.uniform(0, 1, len(x))
    shown = [ca.SX(design.C @ end) for end in (low, high)]
    states, wide = equations.ends(design, *shown, False), (ca.SX(low), ca.SX(high))
    outer = equations.drives(design, states, tuple(shown), ca.SX(u), ca.SX(0, 1), wide)
    low_c, high_c = (numbers_of((drive.c,))[0] for drive in outer)
    size = numbers_of((outer[0].size,))[0] * design.rounding
    for point in np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(len(x), -1).T:
        w = rng.uniform(*w_box.T)
        moved = S @ np.array(f(point, u, [], zero, w, [], [])[0]).ravel() - D @ (S @ point)
        assert (low_c - size <= moved).all()
        assert (moved <= high_c + size).all()
    # what moves x itself, with the ends of the faults
    states = equations.ends(design, y, y, False)
    speed = numbers_of(equations.speeds(design, states, ca.SX(u), ca.SX(0, 1), known))
    ends = [
        np.array(f(x, u, [], e, w, [], [])[0]).ravel() for w in corners for e in plant.box("f").T
    ]
    slack = 1e-9 * (1.0 + np.abs(ends).max(axis=0))
    assert (np.abs(np.min(ends, axis=0) - speed[0]) <= slack).all()
    assert (np.abs(np.max(ends, axis=0) - speed[1]) <= slack).all()
    assert (speed[0] <= np.min(ends, axis=0)).all()


@pytest.mark.parametrize("seed", range(3))
def test_a_product_of_intervals_is_attained_at_its_corners(seed):
    """Mutants: one of the four corners left out."""
    rng = np.random.default_rng(seed)
    M, x = (np.sort(rng.normal(size=(2, *shape)), axis=0) for shape in ((3, 3), (3,)))
    found = numbers_of(product(tuple(map(ca.SX, M)), tuple(map(ca.SX, x))))
    terms = np.array([a * b for a in M for b in x])
    assert found[0] == pytest.approx(terms.min(axis=0).sum(axis=1), rel=1e-14)
    assert found[1] == pytest.approx(terms.max(axis=0).sum(axis=1), rel=1e-14)


def test_the_longer_sums_of_a_step_count_in_its_rounding():
    design = made_of("oscillator", coordinates="auto", precision="single")[0].certificate.design
    assert design.rounding == allowance("single", 8, design.Ts * design.mu)


def test_every_number_of_the_frame_is_the_exact_one_rounded_once():
    """Ill-conditioned coordinates, whose inverse in doubles is wrong in every digit but seven."""
    design = of("lag")[0].certificate.design
    S = np.array([[1.0, 1.0, 0.0], [1.0, 1.0 + 2.0**-30, 1.0], [0.0, 1.0, 1.0 / 3.0]])
    spoilt = replace(design, coordinates=replace(design.coordinates, S=S))
    back, rows = inverse(exact(S)), exact(S)
    wanted = {
        "back": back,
        "C": exact(design.C) @ back,
        "G": rows @ exact(design.G),
        "W1": rows @ exact(design.W1),
        "own": exact(spoilt.coordinates.D) @ rows + exact(design.L) @ exact(design.C),
    }
    for name, value in wanted.items():
        error = exact(getattr(spoilt.frame, name)) - value
        assert (abs(error) <= abs(value) * exact(2.0**-53)).all(), name


@pytest.mark.parametrize("seed", range(4))
def test_what_is_carried_back_holds_every_corner_exactly(seed):
    """Mutants: an end of `image` at the wrong side; the share of rounding zero or negative."""
    rng = np.random.default_rng(seed)
    S = rng.normal(size=(3, 3))
    back = inverse(exact(S))
    low = rng.normal(size=3)
    high = low + rng.choice([0.0, 1e-3], 3)
    T = np.array(
        [[float(x) for x in row] for row in [[int(c.p) / int(c.q) for c in r] for r in back]]
    )
    ends = [np.array(end).ravel() for end in carried(T, ca.DM(low), ca.DM(high), 2.0**-42)]
    corners = exact(np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1))
    images = back @ corners
    assert (exact(ends[0])[:, None] <= images).all()
    assert (images <= exact(ends[1])[:, None]).all()
    attained = np.array([[float(int(c.p) / int(c.q)) for c in row] for row in images])
    assert np.abs(attained.min(axis=1) - ends[0]).max() < 1e-10
    assert np.abs(attained.max(axis=1) - ends[1]).max() < 1e-10


@pytest.mark.parametrize("seed", range(4))
def test_what_states_show_is_outside_of_the_exact_one(lag, seed):
    """Mutants: what rounding may do not added, or taken off."""
    rng = np.random.default_rng(seed)
    C = rng.uniform(0.1, 1.0, (1, 3)) * [[1, 0, 0]]
    design = replace(lag.certificate.design, C=C)
    low = rng.normal(size=3)
    high = low + rng.uniform(0, 1, 3)
    found = step._shown(design, (ca.SX(low), ca.SX(high)))
    ends = numbers_of(found)
    assert (exact(ends[0]) < exact(C) @ exact(low)).all()
    assert (exact(ends[1]) > exact(C) @ exact(high)).all()
    assert np.abs(ends[0] - C @ low).max() < 1e-11
    assert np.abs(ends[1] - C @ high).max() < 1e-11
