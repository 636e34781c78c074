"""Bounds that move in z = S x: plants whose own coordinates have no Metzler error matrix.

Mutants: S^-1 with |S^-1| or without its signs in `image`, what S leaves of D left out of the drive,
disturbances and faults not carried into z, an end of `product`, of `speeds` or of `_reached`, the
share of rounding in `carried`, S^-1 inverted in doubles.
"""

import copy
import functools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from adaptive_runs import outside

import obsynth as ob
from obsynth.derive.rigour import allowance, exact, inverse
from obsynth.designs.core.errors import SolverTrouble
from obsynth.designs.set_adaptive import equations
from obsynth.designs.set_adaptive.coordinates import carried, product
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.record import SetDesign


def oscillator():
    """A mass on a spring whose velocity is shown, both counted from their least values."""
    plant = ob.Plant("oscillator")
    p, v = plant.states("p v", range=[(0, 4), (0, 8)])
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.process_faults("f", range=(-0.5, 0.5))
    noise, push = plant.disturbances("noise push", bound=[0.01, 0.02])
    plant.dynamics([v - 4, -4 * (p - 2) - (v - 4) / 5 + u + f + push])
    plant.outputs([v + noise])
    return plant


def behind_a_filter():
    """A force with a lag on an oscillator whose position is shown: the fault settles."""
    plant = ob.Plant("oscillator behind a lag")
    x, v, a = plant.states("x v a", range=[(-2, 2), (-4, 4), (-2, 2)])
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("f", of=u, range=(-0.5, 0.5))
    noise, push = plant.disturbances("noise push", range=[(-0.001, 0.003), (-0.02, 0.03)])
    plant.dynamics([v, -4 * x - v / 5 + a + push, u - a])
    plant.outputs([x + noise])
    return plant


def unstable():
    """A growing oscillation that no output shows but by what it does to another state."""
    plant = ob.Plant("growing")
    y, a, b = plant.states("y a b", range=(-2, 2))
    (u,) = plant.inputs("u", range=(-0.1, 0.1))
    (f,) = plant.process_faults("f", range=(-0.1, 0.1))
    (noise,) = plant.disturbances("noise", bound=0.002)
    plant.dynamics([-y + a - b, a / 4 - 2 * b + u + f, 2 * a + b / 4])
    plant.outputs([y + noise])
    return plant


def machine():
    """A permanent-magnet machine without a sensor of its speed; A depends on the currents."""
    plant = ob.Plant("machine")
    d, q, w = plant.states("i_d i_q w", range=[(-10, 10), (-10, 10), (-300, 300)])
    u = plant.inputs("u_d u_q", range=[(-0.5, 0.5), (-2, 2)])
    plant.actuator_faults("f", of=u[0], range=(-2, 2))
    n = plant.disturbances("n1:4", bound=[0.05, 0.05, 0.05])
    plant.dynamics(
        [(u[0] - 0.3 * d) * 500 + 4 * w * q, (u[1] - 0.3 * q - 0.4 * w) * 500 - 4 * w * d,
         (0.6 * q - 0.001 * w - n[2]) * 1000]
    )  # fmt: skip
    plant.outputs([d + n[0], q + n[1]])
    return plant


CASES = {
    "oscillator": (oscillator, {"gain_cap": 50.0, "Gamma": 200.0, "Ts": 0.01}, 350, 0.1),
    "lag": (behind_a_filter, {"gain_cap": 50.0, "Gamma": 200.0, "Ts": 0.02}, 500, 0.1),
    "growing": (unstable, {"gain_cap": 100.0, "Gamma": 200.0, "Ts": 0.01}, 700, 0.01),
    "machine": (machine, {"gain_cap": 1e5, "Gamma": 1e5, "Ts": 2e-5}, 400, 0.05),
}
SHARES = {"oscillator": (0, 0.6), "lag": (3, 0.7), "growing": (1, 0.6), "machine": (2, 0.1)}
"""Which of the states and faults, in shares of its range, is known how well at least."""


def near(plant, share):
    box = plant.box("x")
    middle, half = box.mean(axis=1), 0.5 * share * np.ptp(box, axis=1)
    return np.column_stack([middle - half, middle + half])


@functools.cache
def of(name):
    """What "auto" makes of a case."""
    return made_of(name, coordinates="auto")


def made_of(name, **options):
    plant, given, steps, share = CASES[name]
    made = plant()
    observer = SetAdaptiveObserver(**given, **options).design(made)
    return observer, made, steps, near(made, share)


@pytest.fixture(scope="module", params=CASES)
def case(request):
    return request.param, *of(request.param)


@pytest.fixture(scope="module")
def lag():
    return of("lag")[0]


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
    wrong, _, widths = outside(observer, plant, range(12), steps, box)
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
    with pytest.raises(ob.StructureError, match='or coordinates="auto"'):
        method.design(unstable())


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


# -- claims, files, code -----------------------------------------------------------------


def changed(record, way, value):
    record = copy.deepcopy(dict(record))
    place = record
    for key in way[:-1]:
        place = place[key]
    place[way[-1]] = value(place[way[-1]])
    return record


@pytest.mark.parametrize(
    ("way", "value", "falls"),
    [
        (("coordinates", "D", 0, 1), lambda d: -1e-9, "metzler"),
        (("coordinates", "D", 0, 0), lambda d: 0.5 * d, "decay"),
        (("coordinates", "D", 2, 2), lambda d: 1e6 * d, "transition"),
        (("coordinates", "rate", 1, 1), lambda r: 0.99 * r, "speed"),
        (("coordinates", "rate", 2, 0), lambda r: 0.99 * r, "speed"),
        (("coordinates", "input_rate", 2, 0), lambda r: 0.99 * r, "speed"),
        (("alpha",), lambda a: 1.001 * a, "decay"),
        (("alpha_step",), lambda a: 1.001 * a, "decay_step"),
        (("C", 0, 0), lambda c: -c, "signs"),
    ],
)
def test_a_spoilt_record_is_not_proved(lag, certify, way, value, falls):
    failed = {c.name for c in certify(changed(lag.record, way, value), "full") if not c.holds}
    assert falls in failed


def test_coordinates_without_an_inverse_are_no_design(lag, certify):
    with pytest.raises(ob.CertificateError, match="no inverse"):
        certify(changed(lag.record, ("coordinates", "S", 1), lambda row: [0.0, 0.0, 0.0]))
    with pytest.raises(ob.CertificateError, match="S has shape"):
        certify(changed(lag.record, ("coordinates", "S"), lambda rows: rows[:2]))


def test_without_its_coordinates_a_design_is_none_of_its_plant(lag, certify):
    """Mutant: the plant's own coordinates need no states that are not negative."""
    certificate = certify({**lag.record, "coordinates": None}, "full")
    assert {"signs", "derivation"} <= {c.name for c in certificate if not c.holds}


def test_claims_file_and_code(lag, tmp_path):
    names = [claim.name for claim in lag.certificate.check()]
    assert names == [
        "signs", "boxes", "metzler", "decay", "decay_step", "coordinates", "transition", "law",
        "model", "bounds", "speed",
    ]  # fmt: skip
    lag.save(tmp_path / "design.json")
    loaded = ob.load(tmp_path / "design.json")
    assert loaded.certificate.check().valid
    memory = lag.memory0([0.1, 0.0, 0.2], x_range=[(0, 0.2), (-0.1, 0.1), (0, 0.4)])
    for k in range(5):
        pair = [one.step(memory, [0.1], [0.1 + 0.001 * k]) for one in (lag, loaded)]
        assert all(np.array_equal(np.array(a), np.array(b)) for a, b in zip(*pair, strict=True))
        memory = pair[0][0]
    assert isinstance(lag.certificate.design, SetDesign)


def test_generated_c_equals_the_step(tmp_path):
    project = ob.generate_c(of("oscillator")[0], tmp_path / "c", vectors=200)
    if project.comparison is None:
        pytest.skip("no C compiler")
    assert project.comparison.vectors == 200


def test_a_given_gain_has_its_own_modes(lag):
    """L is the plant's: with S or with "auto" the same gain gives the same D."""
    L, S = lag.gains["L"], lag.gains["S"]
    options = dict(CASES["lag"][1])
    for coordinates in ("auto", S):
        again = SetAdaptiveObserver(coordinates=coordinates, **options).analyse(
            behind_a_filter(), {"L": L}
        )
        assert again.certificate.valid
        found = np.sort(np.diag(again.record["coordinates"]["D"]))
        assert found == pytest.approx(np.sort(np.diag(lag.record["coordinates"]["D"])), rel=1e-6)
    with pytest.raises(ob.InfeasibleDesign, match="no real modes"):
        SetAdaptiveObserver(coordinates="auto", **options).analyse(
            behind_a_filter(), {"L": np.zeros((3, 1))}
        )


def test_the_continuous_form_holds_the_state(lag):
    """Plant and observer integrated together; mutant: x of the drive without its ranges."""
    from scipy.integrate import solve_ivp

    f, box = behind_a_filter().function(), near(behind_a_filter(), 0.1)
    x0, fault, w = box[:, 0], [0.3], [0.003, -0.02]
    start = lag.memory0(box.mean(axis=1), x_range=box)

    def rates(t, z):
        x, u = z[:3], [0.5 * np.sin(t)]
        made = np.array(f(x, u, [], fault, w, [], [])[0]).ravel()
        return np.concatenate([made, np.array(lag.ode(z[3:], u, [x[0] + w[0]])).ravel()])

    found = solve_ivp(rates, (0, 3), np.concatenate([x0, start]), rtol=1e-8, atol=1e-10)
    memory, layout = found.y[3:], lag.memory_layout
    z = lag.gains["S"] @ found.y[:3]
    assert (memory[layout["xi_m"]] <= z + 1e-7).all()
    assert (z <= memory[layout["xi_M"]] + 1e-7).all()
    assert (memory[layout["theta_M"]] <= 0.3 + 1e-9).all()
    assert (memory[layout["theta_m"]] >= 0.3 - 1e-9).all()


# -- the option ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"coordinates": "modal"}, "coordinates"),
        ({"coordinates": [[1.0, np.nan], [0.0, 1.0]]}, "coordinates"),
        ({"coordinates": True}, "coordinates"),
        ({"coordinates": "auto", "robust": True}, "coordinates has no effect"),
        ({"coordinates": np.eye(2), "form": "printed"}, "coordinates has no effect"),
    ],
)
def test_options_without_effect_or_meaning_are_refused(options, words):
    with pytest.raises(ob.ObsynthError, match=words) as refusal:
        SetAdaptiveObserver(**options)
    assert refusal.value.option == "coordinates"


def test_coordinates_that_do_not_fit_the_plant_are_refused():
    for S, words in ((np.eye(2), r"shape \(2, 2\).*x, v, a"), (np.ones((3, 3)), "x, v, a apart")):
        with pytest.raises(ob.ObsynthError, match=words):
            SetAdaptiveObserver(coordinates=S).design(behind_a_filter())
    with pytest.raises(ob.ObsynthError, match="leave coordinates out"):
        SetAdaptiveObserver(coordinates="auto").problem(behind_a_filter(), 0.1)
    with pytest.raises(SolverTrouble, match="raise gain_cap"):
        SetAdaptiveObserver(coordinates="auto", gain_cap=0.01).design(behind_a_filter())


def test_what_has_a_design_of_its_own_is_left_in_its_coordinates(tanks, cooperative):
    observer = SetAdaptiveObserver(gain_cap=0.5, Ts=0.05, coordinates="auto").design(tanks)
    assert observer.record["coordinates"] is None
    assert observer.gains["L"].tolist() == cooperative.gains["L"].tolist()


def test_modes_that_no_output_shows_have_to_be_real_and_decay():
    plant = ob.Plant("hidden oscillation")
    a, b, c = plant.states("a b c", range=(-1, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([-a + f, -b - 2 * c, 2 * b - c])
    plant.outputs([a])
    with pytest.raises(SolverTrouble, match="real and decay"):
        SetAdaptiveObserver(coordinates="auto").design(plant)
    quiet = ob.Plant("hidden decay")
    a, b = quiet.states("a b", range=(-1, 1))
    (f,) = quiet.faults("f", range=(-1, 1))
    quiet.dynamics([-a + f, a - 2 * b])
    quiet.outputs([a])
    observer = SetAdaptiveObserver(coordinates="auto", gain_cap=10.0).design(quiet)
    assert min(np.abs(np.diag(observer.record["coordinates"]["D"]) + 2.0)) < 1e-9
