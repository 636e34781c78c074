"""Plants as people type them: certified at the first try, as closely as a search elsewhere did."""

import functools
import time

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.general.method import GeneralUIO

# Sampling time in s; half width / half range of the faults, core's own; which are quick
PLANTS = {
    "cruise_control": (0.1, [0.674], True),
    "pvtol": (0.02, [0.105, 0.194], False),
    "cart_pole": (0.01, [0.112], False),
    "flexible_joint": (0.01, [0.413], False),
    "dc_motor": (0.01, [0.187], True),
    "battery": (1, [0.512], False),
    "kinematic_bicycle": (0.05, [0.378], False),
    "surface_pmsm": (1e-4, [0.058], True),
    "klatt_engell_reactor": (0.001, [0.098], False),
    "heat_exchanger": (0.2, [0.010], False),
    "forced_oscillator": (0.01, [0.408], True),
}
CASES = [
    pytest.param(name, marks=[] if quick else [pytest.mark.long])
    for name, (_, _, quick) in PLANTS.items()
]


def made(name):
    Ts = PLANTS[name][0]
    return getattr(ob.plants, name)().discretise("euler", Ts=sp.nsimplify(Ts))


@functools.cache
def designed(name):
    start = time.process_time()
    observer = ob.BoundedErrorUIO(bounds="peak").design(made(name))
    return observer, time.process_time() - start


def shares(observer, widths):
    box = np.vstack([observer.model.box("x"), observer.model.box("f").reshape(-1, 2)])
    return widths / (0.5 * np.diff(box, axis=1)[:, 0])


@pytest.mark.parametrize("name", CASES)
def test_peak_bounds_at_the_first_try(name):
    """Half widths of the faults within 3 % of the reference or better, and a proof of all."""
    observer, seconds = designed(name)
    found = shares(observer, observer.performance["core_half_widths"])
    wanted = np.array(PLANTS[name][1])
    assert np.all(found[-len(wanted) :] <= 1.03 * wanted)
    assert observer.certificate.valid
    # half a minute on a loaded machine is 10 s on a quiet one
    assert seconds < 30.0


def wandering(plant, rng, count, steps):
    """Admissible runs of a plant that keep to its box: bang-bang noise, faults at their rates.

    Yields (x, f, u, d, w, y, alive) at every instant, columns are runs.
    """
    kinds = {kind: plant.box(kind).reshape(-1, 2) for kind in "xufw"}
    low, high = (kinds["x"][:, [k]] for k in (0, 1))
    nominal = np.array([0.0 if s.nominal is None else float(s.nominal) for s in plant.x])
    start = np.clip(nominal[:, None], low, high)
    x = np.clip(start + 0.1 * (high - low) * rng.uniform(-0.5, 0.5, (len(low), count)), low, high)
    rates = np.array([0.0 if s.constant else float(s.rate) for s in plant.f])[:, None]
    f = np.zeros((len(rates), count))
    u0 = np.array([0.0 if s.nominal is None else float(s.nominal) for s in plant.u])[:, None]
    room = np.minimum(kinds["u"][:, [1]] - u0, u0 - kinds["u"][:, [0]])
    sign, d = np.ones_like(f), np.zeros((len(plant.d), count))
    w = np.zeros((len(plant.w), count))
    function, none = plant.function().map(count), np.zeros((0, count))
    alive = np.ones(count, dtype=bool)
    u = np.repeat(u0, count, axis=1)
    for k in range(steps):
        ends = rng.integers(0, 2, w.shape)
        fresh = np.where(ends == 1, kinds["w"][:, [1]], kinds["w"][:, [0]])
        held = (np.arange(count) % 2 == 1) & (rng.random(w.shape) > 0.05) & (k > 0)
        w = np.where(held, w, fresh)
        if k % 20 == 0:
            u = u0 + 0.3 * room * rng.uniform(-1, 1, (len(u0), count))
        d = np.where(rng.random(d.shape) < 0.1, 0.01 * rng.standard_normal(d.shape), d)
        following, y = (np.array(part) for part in function(x, u, d, f, w, none, none))
        yield x, f, u, d, w, y, alive
        sign = np.where(rng.random(sign.shape) < 0.02, -sign, sign)
        moved = f + sign * rates
        out = (moved > kinds["f"][:, [1]]) | (moved < kinds["f"][:, [0]])
        sign, f = np.where(out, -sign, sign), np.where(out, f, moved)
        alive = alive & np.all((following >= low) & (following <= high), axis=0)
        if not alive.any():
            return
        x = np.where(alive, following, np.clip(following, low, high))


def watched(observer, seed, count=40, steps=250):
    """How many sets miss the truth, and of how many; states and faults together."""
    plant, rng = observer.model, np.random.default_rng(seed)
    box = plant.box("x")
    nominal = np.array([0.0 if s.nominal is None else float(s.nominal) for s in plant.x])
    still = np.zeros((len(plant.f), 2))
    memory = observer.memory0(np.clip(nominal, *box.T), x_range=box, f_range=still)
    memory = np.repeat(memory[:, None], count, axis=1)
    step = observer.step.map(count)
    missed = total = 0
    before = None
    for x, f, u, _, _, y, alive in wandering(plant, rng, count, steps):
        memory, _, _, low, high, f_low, f_high, status = (
            np.array(part) for part in step(memory, u, y)
        )
        speaks = f if observer.fault_delay == 0 else before
        before = f
        if speaks is None:
            continue
        truth = np.vstack([x, speaks])
        lower, upper = np.vstack([low, f_low]), np.vstack([high, f_high])
        counts = alive & (status.ravel() == 0)
        missed += int(((truth < lower) | (truth > upper))[:, counts].sum())
        total += int(counts.sum()) * len(truth)
    return missed, total


@pytest.mark.parametrize("name", ["cruise_control", "forced_oscillator"])
def test_sets_hold_what_noise_and_faults_at_their_ends_do(name):
    missed, total = watched(designed(name)[0], 0, count=20, steps=120)
    assert missed == 0 and total > 4000


WAYS = {
    "peak": {},
    "peak alone": {"cuts": ()},
    "ellipsoid alone": {"bounds": "ellipsoid", "cuts": ()},
    "divided": {"faults": "divided"},
}


@pytest.mark.long
@pytest.mark.parametrize("name", PLANTS)
@pytest.mark.parametrize("way", WAYS)
def test_no_set_misses_in_many_instants(name, way):
    """Over a million instants of states and faults in all, those that stay in the box."""
    if way == "divided" and name not in SEVEN:
        pytest.skip("a fault that stands in an output, or that no output shows a call later")
    observer = GeneralUIO(**WAYS[way]).design(made(name))
    missed = total = seed = 0
    while total < 60_000 and seed < 12:
        more = watched(observer, seed, count=60, steps=300)
        missed, total, seed = missed + more[0], total + more[1], seed + 1
    assert missed == 0
    assert total > 3_000


def in_units(factor):
    """The flexible joint in other units of every second state, input, fault and reading."""
    plant = ob.Plant("flexible joint in other units")
    a, b = sp.Rational(factor), 1 / sp.Rational(factor)
    names, ranges = "th_m w_m th_l w_l", [3, 10, 3, 10]
    units = [a, 1, b, 1]
    x = plant.states(names, range=[(-r * u, r * u) for r, u in zip(ranges, units, strict=True)])
    (u,) = plant.inputs("u", range=(-3 * b, 3 * b), nominal=0)
    plant.actuator_faults("f", of=u, range=(-b, b), rate=b)
    w = plant.disturbances("w1:3", bound=[sp.Rational(2, 1000) * a, sp.Rational(2, 100)])
    m, wm, q, wl = (s / k for s, k in zip(x, units, strict=True))
    R = sp.Rational
    rows = [wm, R(486, 10) * (q - m) - R(125, 100) * wm + R(216, 10) * u / b, wl]
    rows.append(-R(195, 10) * (q - m) - R(333, 100) * sp.sin(q))
    plant.dynamics([r * k for r, k in zip(rows, units, strict=True)])
    plant.outputs([x[0] + w[0], x[1] + w[1]])
    return plant.discretise("euler", Ts=sp.Rational(1, 100))


@pytest.mark.long
@pytest.mark.parametrize("factor", ["1/10000", "100", "10000"])
def test_units_do_not_matter(factor):
    """Widths of peak sets move by less than 2 %, of ellipsoids by less than 1e-4."""
    for bounds, most in (("peak", 0.02), ("ellipsoid", 1e-4)):
        method = GeneralUIO(bounds=bounds)
        plain, other = (method.design(in_units(k)) for k in ("1", factor))
        one, two = (shares(o, o.half_widths) for o in (plain, other))
        assert two == pytest.approx(one, rel=most)
        if bounds == "ellipsoid":
            one, two = (shares(o, o.performance["core_half_widths"]) for o in (plain, other))
            assert two == pytest.approx(one, rel=most)


@pytest.mark.long
def test_four_tanks_are_bounded_more_closely_than_by_a_prediction_alone():
    """2.940 by an independent search, 3.26 for the observer that predicts first."""
    plant = ob.plants.quadruple_tank().discretise("euler", Ts=1.0)
    observer = ob.BoundedErrorUIO(bounds="peak", weights=(1,) * 6).design(plant)
    assert observer.performance["sum_half_widths"] <= 2.95


@pytest.mark.parametrize("n", [5, pytest.param(16, marks=pytest.mark.long)])
def test_tanks_in_a_row_have_no_vertices_to_pay_for(n):
    start = time.process_time()
    plant = ob.plants.tanks_in_a_row(n).discretise("euler", Ts=0.5)
    observer = ob.BoundedErrorUIO(bounds="peak").design(plant)
    assert time.process_time() - start < {5: 6.0, 16: 20.0}[n]
    assert shares(observer, observer.performance["core_half_widths"])[-1] < 0.12


SEVEN = {
    "pvtol": ([0.19, 0.96], True),
    "cart_pole": ([0.54], True),
    "dc_motor": ([0.50], True),
    "surface_pmsm": ([0.12], True),
    "cruise_control": ([1.0], False),
    "kinematic_bicycle": ([1.0], False),
    "forced_oscillator": ([1.0], False),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if PLANTS[n][2] else [pytest.mark.long]) for n in SEVEN]
)
def test_faults_of_any_size_are_divided_out(name):
    wanted, told = SEVEN[name]
    observer = ob.IntervalObserver().design(made(name))
    found = shares(observer, observer.half_widths)[-len(wanted) :]
    assert np.all(found <= np.array(wanted) * 1.01)
    assert told == bool(found.min() < 1.0)
    missed, total = watched(observer, 1, count=20, steps=100)
    assert missed == 0 and total > 200
