"""What the data say by themselves: no point that the equations allow is cut away, few others stay.

The trials that look for a lost point also find contractors that are told less than there is.
"""

import functools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from contracted import PLANTS, TRIALS, Narrow, cut, drawn, finite, following, lost, made, trials

import obsynth as ob
from obsynth.designs.core.contractor import CUTS, Contractor
from obsynth.designs.core.core import Core, Known
from obsynth.designs.core.guard import Guard, Watch
from obsynth.designs.core.step import Step
from obsynth.designs.core.stepping import fill
from obsynth.evaluate.truth import Call, dense


@functools.cache
def tried(name):
    return trials(made(name), seed=sum(map(ord, name)))


@functools.cache
def of(name, kind=Contractor, w=1.0, rate=1.0, cuts=CUTS):
    return kind(made(name, w, rate), 0.01, cuts)


# -- nothing is lost ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", PLANTS)
def test_no_point_that_the_equations_allow_is_cut_away(name):
    """Mutants: an open sign taken for a known one; nine tenths of a radius; ends of a strip's other
    states exchanged; a rate left out at the lower end.
    """
    given, contractor = tried(name), of(name)
    assert given.fair.sum() > 0.25 * TRIALS
    assert lost(contractor, given) == [0, 0, 0]
    some = np.random.default_rng(1).integers(0, 2, given.y.shape).astype(float)
    assert lost(contractor, given, some) == [0, 0, 0]


@pytest.mark.long
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("size", [1.0, 1e-3])
def test_no_point_is_cut_away_in_many_trials(name, size):
    contractor = of(name)
    for seed in range(8):
        for ends in (0.3, 1.0):
            given = trials(made(name), seed=seed, count=20_000, size=size, ends=ends)
            assert lost(contractor, given) == [0, 0, 0]


@pytest.mark.parametrize("name", PLANTS)
def test_a_contractor_that_is_told_less_loses_points(name):
    """Mutants: w times .97, rates times .7, an image .2 % narrower, a model off by 2e-5."""
    given, plant = tried(name), made(name)
    assert lost(of(name, w=0.97), given)[0] > 100
    if any(s.rate is not None for s in plant.f):
        assert lost(of(name, rate=0.7), given)[2] > 100
    if plant.Ts is not None:
        assert lost(of(name, Narrow), given)[0] > 100
    shift = 2e-5 * np.diff(finite(plant.box("x")), axis=1)
    assert lost(of(name), replace(given, x1=given.x1 + shift))[0] > 100


@pytest.mark.parametrize("name", ["mixed_rows", "corners", "tanks"])
def test_outputs_stay_in_what_the_ranges_show(name):
    """Rounded outwards, and attained at corners."""
    plant, contractor, rng = made(name), of(name), np.random.default_rng(8)
    shown, none = contractor.shown(plant.box("x")), np.zeros((0, TRIALS))
    x, w = (drawn(rng, plant.box(kind), TRIALS, 1.0) for kind in ("x", "w"))
    d, f, p = (np.zeros((len(plant.names(kind)), TRIALS)) for kind in ("d", "f", "p"))
    u = np.zeros((len(plant.u), TRIALS))
    y = np.array(plant.function().map(TRIALS)(x, u, d, f, w, p, none)[1])
    assert (shown[:, 0] <= y.min(axis=1)).all()
    assert (y.max(axis=1) <= shown[:, 1]).all()
    np.testing.assert_allclose(np.stack([y.min(axis=1), y.max(axis=1)], axis=1), shown, rtol=1e-12)


# -- few others stay ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "size", "largest"),
    [
        ("tanks", 0.5, 1.001),
        ("pmsm", 0.3, 1.1),
        ("cart_pole", 0.3, 1.1),
        ("flexible_joint", 0.5, 1.01),
        ("mixed_rows", 0.3, 1.01),
        ("gains", 0.3, 1.01),
        ("corners", 0.01, 1.05),
        ("corners", 0.3, 2.0),
    ],
)
def test_images_are_sharp(name, size, largest):
    """Widths against the hull of dense samples; rows with an unbounded input apart.

    Mutant: the natural form in place of corners and mean values.
    """
    plant, contractor, rng = made(name), of(name), np.random.default_rng(3)
    given = trials(plant, seed=11, count=15, size=size)
    X, _, _ = cut(contractor, given, 0.0)
    usable, domain = contractor.equations.usable, contractor.domain
    ratios = []
    for k in np.flatnonzero(given.fair).tolist():
        x, _ = following(plant, given, k, rng)
        low, high = (np.clip(end(x, axis=1), *domain.T) for end in (np.min, np.max))
        ratios.append(((X[:, 1, k] - X[:, 0, k]) / (high - low))[usable])
    assert len(ratios) >= 3
    assert np.max(ratios) <= largest
    assert np.median(ratios) <= 1.001
    assert np.min(ratios) >= 1.0


@pytest.mark.parametrize(
    ("name", "row", "size", "largest"),
    [
        ("pmsm", 1, 0.1, 1.01),
        ("flexible_joint", 1, 0.1, 1.01),
        ("loose", 0, 0.1, 1.01),
        ("gains", 0, 0.4, 2.0),
    ],
)
def test_the_inversion_is_sharp(name, row, size, largest):
    """Faults of samples whose next state lies in X, against what the inversion leaves.

    Mutants: the row taken with the fault in its range in place of zero; the slope over the whole
    domain where it depends on the state (gains).
    """
    plant, contractor, rng = made(name), of(name), np.random.default_rng(5)
    given = trials(plant, seed=12, count=40, size=size)
    X, late, _ = cut(contractor, given)
    ratios = []
    for k in np.flatnonzero(given.fair).tolist():
        x, f = following(plant, given, k, rng, count=20_000)
        inside = (x[row] >= X[row, 0, k]) & (x[row] <= X[row, 1, k])
        if np.unique(f[0, inside]).size > 100:
            ratios.append((late[0, 1, k] - late[0, 0, k]) / np.ptp(f[0, inside]))
    assert len(ratios) >= 8
    assert np.median(ratios) <= 1.001
    assert np.max(ratios) <= largest


def test_two_sweeps_of_strips_come_near_the_smallest_box():
    """Against linear programs over the box and all strips at once.

    Mutant: one sweep.
    """
    from scipy.optimize import linprog

    given = tried("mixed_rows")
    contractor = of("mixed_rows")
    X, _, _ = cut(contractor, given)
    images, _, _ = cut(of("mixed_rows", cuts=("ranges", "image")), given)
    ratios = []
    for k in np.flatnonzero(given.fair)[:60].tolist():
        rows, limits = [], []
        for i, strip in enumerate(contractor.strips):
            rows += [strip.row, -strip.row]
            limits += [given.y[i, k] - strip.low, strip.high - given.y[i, k]]
        for j, axis in enumerate(np.eye(3)):
            ends = [
                linprog(sign * axis, np.array(rows), limits, bounds=images[:, :, k]).fun
                for sign in (1.0, -1.0)
            ]
            ratios.append((X[j, 1, k] - X[j, 0, k]) / (-ends[1] - ends[0]))
    assert np.min(ratios) >= 1.0 - 1e-9
    assert np.median(ratios) <= 1.001
    assert np.quantile(ratios, 0.9) <= 1.3


# -- what is left alone ------------------------------------------------------------------------


def test_rows_that_nothing_bounds_have_no_image_and_no_strip():
    usable = {name: of(name).equations.usable.tolist() for name in PLANTS}
    assert usable["tanks"] == [True, True, False, True]
    assert usable["pmsm"] == [True, True, False]
    assert usable["loose"] == [True, False, True]
    assert usable["vessel"] == [False, False]
    assert all(all(usable[n]) for n in ("cart_pole", "flexible_joint", "gains", "corners"))
    strips = of("loose").strips
    assert [strip is None for strip in strips] == [False, True, False]
    assert of("tanks").equations.invertible == [(0, 0), (0, 3), (1, 1)]
    assert of("gains").equations.invertible == [(0, 0), (0, 1), (1, 1)]


def test_states_are_held_to_a_range_only_where_a_derivative_depends_on_them():
    assert of("flexible_joint").equations.curved.tolist() == [False, False, True, False]
    assert np.isinf(of("loose").domain[2]).all()
    assert of("loose").domain[0].tolist() == [0.5, 4.0]


def test_outputs_that_are_not_constant_rows_have_no_strip():
    plant = ob.Plant("outputs")
    x, z = plant.states("x z", range=(1, 2))
    (u,) = plant.inputs("u", range=(0, 1))
    (theta,) = plant.scheduling("theta", range=(0, 1))
    (s,) = plant.process_faults("s", range=(-1, 1))
    plant.dynamics([x / 2 + s / 9, z / 2], Ts=1)
    plant.outputs([x + z, theta * x, x**2, x + u, x + s, x + 1, 3 * z])
    found = Contractor(plant, 1.0).strips
    assert [strip is None for strip in found] == [False, *[True] * 5, False]


# -- how narrow sets become --------------------------------------------------------------------

LAWS = {
    "tanks": (lambda k: [10 + np.sin(k / 50), 10 + np.cos(k / 80)], [170, 170, 52.5, 52.5]),
    "pmsm": (lambda k: [0.0, 5.0], [0, 0, 12.5]),
    "flexible_joint": (lambda k: [0.5 * np.sin(k / 30)], [0, 0, 0, 0]),
}
KNOWN = {
    ("tanks", "all"): {0: 0.090877, 1: 0.099767, 2: 0.1, 4: 1.275055, 5: 2.647676},
    ("tanks", "strips"): {0: 0.1, 1: 0.1, 2: 0.1, 3: 47.5},
    ("pmsm", "all"): {1: 0.049196, 2: 0.5, 3: 1.379225},
    ("pmsm", "strips"): {0: 0.05, 1: 0.05, 2: 0.5, 3: 20.0},
    ("flexible_joint", "all"): {1: 0.02, 2: 3.0, 4: 1.0},
    ("flexible_joint", "strips"): {0: 0.002, 1: 0.02, 2: 3.0, 4: 1.0},
}
"""Mean half widths of sets without any core, of an independent implementation, to 2 %.

Left out are those that hang on the trajectory (i_d, an unmeasured level on its way) and those of
states that enter linearly, which that implementation held to their ranges.
"""


def blind(n, n_f):
    """A core that knows nothing."""
    zeros = ca.SX.zeros(n), ca.SX.zeros(n_f)
    return Core(lambda seen: Known(*zeros, None, None, {}), lambda x, f, kept: {})


@pytest.mark.parametrize(("name", "cuts"), KNOWN)
def test_mean_half_widths_are_those_of_another_implementation(name, cuts):
    plant, (law, x0) = made(name), LAWS[name]
    n, n_f = len(plant.x), len(plant.f)
    named = None if cuts == "all" else ("ranges", "strips")
    watch = Watch.of({"horizon": 10**6, "recovery": 1, "cuts": named})
    guard = Guard(plant, {}, watch, 0, 1.0)
    step = Call(dense(Step(guard, blind(n, n_f)).build()))
    truth = Call(dense(plant.function()))
    parts = guard.first({}, plant.box("x"), plant.box("f").reshape(-1, 2))
    step.args[0][:] = fill(guard.layout(), parts)
    rng, x = np.random.default_rng(1), np.array(x0, dtype=float)
    w, widths, steps = plant.box("w"), [], 4000 if cuts == "all" else 50
    for k in range(steps):
        truth.args[0][:], truth.args[1][:] = x, law(k)
        truth.args[4][:] = rng.uniform(w[:, 0], w[:, 1])
        truth.evaluate()
        step.args[1][:], step.args[2][:] = truth.args[1], truth.results[1]
        step.evaluate()
        memory, _, _, low, high, f_low, f_high, status = step.results
        assert status[0] == 0
        assert (low <= x).all() and (x <= high).all() and (f_low <= 0).all() and (f_high >= 0).all()
        widths.append(0.5 * np.concatenate([high - low, f_high - f_low]))
        step.args[0][:], x = memory, truth.results[0].copy()
    found = np.mean(widths[steps // 2 :], axis=0)
    for place, known in KNOWN[name, cuts].items():
        assert found[place] == pytest.approx(known, rel=0.02), place
    promised = guard.widths(None)
    assert (np.array(widths[-1]) <= promised * (1 + 1e-9)).all()
