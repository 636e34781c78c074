"""The step of the general class: its stages, their rounding, and sets that hold what moves."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from methods import motor, observer_of
from obsynth.derive.forms.extended import extend
from obsynth.derive.structure.following import follow, hidden_somewhere
from obsynth.designs.core.equations import curved_states
from obsynth.designs.general.claims import claims
from obsynth.designs.general.method import GeneralUIO, bound_peak
from obsynth.designs.general.model import read
from obsynth.designs.general.rounding import needed, settle
from obsynth.designs.general.step import stages, steady
from obsynth.symbolic.errors import ObsynthError


def cubic():
    """Two states and a fault; everything polynomial, the box easily left by estimates."""
    plant = ob.Plant("cubic")
    x, z = plant.states("x z", range=[(-1, 1), (-3, 3)])
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    plant.actuator_faults("f", of=u, range=(-1, 1), rate=0.02)
    w = plant.disturbances("w1:3", range=[(-0.05, 0.15), (-0.05, 0.05)])
    tenth = sp.Rational(1, 10)
    plant.dynamics([x / 2 - x**3 * tenth + z * tenth + w[0] / 4, z * (1 - x**2) / 3 + u], Ts=1)
    plant.outputs([x + x**2 * tenth + w[1], z + w[0]])
    return plant


@pytest.fixture(scope="module")
def design():
    return GeneralUIO().solve(GeneralUIO().read(cubic()))


def test_the_stages_are_the_equations_inside_and_affine_outside(design):
    """Mutants: rows or outputs without their continuation; v0 at zero."""
    first, second, third = stages(design)
    assert curved_states(design.extended.plant, noise=True).tolist() == [True, True, False]
    middle, N = design.middle, design.size
    C0, A0 = middle[N:, :N], middle[:N, :N]
    w1 = 0.05
    u, y = np.array([0.3]), np.array([0.7, -0.4])
    for x in ([0.4, -1.0, 0.2], [1.7, -1.0, 4.0], [-1.5, 3.5, 0.0]):
        x = np.array(x)
        inner = np.array([np.clip(x[0], -1, 1), np.clip(x[1], -3, 3), x[2]])
        a, b, f = inner
        rows = np.array([a / 2 - a**3 / 10 + b / 10 + w1 / 4, b * (1 - a**2) / 3 + u[0] + f, f])
        shown = np.array([a + a**2 / 10, b + w1])
        rows, shown = rows + A0 @ (x - inner), shown + C0 @ (x - inner)
        assert np.array(first(x, u, y)).ravel() == pytest.approx(x)
        found, nu = (np.array(part).ravel() for part in second(x, u, y))
        assert nu == pytest.approx(y - shown, rel=1e-12)
        assert found == pytest.approx(x + design.Z @ (y - shown), rel=1e-12)
        assert np.array(third(x, u, nu)).ravel() == pytest.approx(rows, rel=1e-12)


def test_rounding_allowances_hold_what_rounding_does(design):
    """Exact rationals beside doubles. Mutant: a tenth of what a stage needs."""
    third = stages(design)[2]
    found = needed(design)
    rng = np.random.default_rng(0)
    box = np.array([[-1, 1], [-3, 3], [-3, 3]])
    worst = np.zeros(3)
    exact_w = Fraction(0.05)
    for _ in range(3000):
        x, u = rng.uniform(box[:, 0], box[:, 1]), rng.uniform(-1, 1, 1)
        a, b, f = map(Fraction, x)
        rows = [
            a / 2 - a**3 / 10 + b / 10 + exact_w / 4,
            b * (1 - a**2) / 3 + Fraction(u[0]) + f,
            f,
        ]
        have = np.array(third(x, u, np.ones(2))).ravel()
        apart = [abs(Fraction(v) - row) for v, row in zip(have.tolist(), rows, strict=True)]
        worst = np.maximum(worst, [float(v) for v in apart])
    assert np.all(worst <= found.p)
    assert np.all(found.p[:2] <= 20 * worst[:2])
    settled = settle(design).rounding
    assert np.all(settled.p >= found.p) and np.all(settled.c >= found.c)


def test_stored_boxes_hold_the_declared_ones(design):
    """Mutants: only one end compared."""

    def holds(**parts):
        return {c.name: c.holds for c in claims(replace(design, **parts))}["boxes"]

    assert holds()
    assert not holds(v_radius=design.v_radius * 0.999)
    for k in range(len(design.v_centre)):
        for sign in (-1, 1):
            centre = design.v_centre.copy()
            centre[k] += sign * 0.01
            assert not holds(v_centre=centre)


def test_core_half_widths_are_the_bounds(design):
    widths = steady(design)
    assert np.all(widths >= design.bound.b[design.size :])
    assert widths == pytest.approx(design.bound.b[design.size :], rel=1e-12)


def test_a_fault_that_no_output_tells_from_a_state_counts_as_a_disturbance():
    plant = ob.Plant("integrator")
    x, z = plant.states("x z", range=(-5, 5))
    (u,) = plant.inputs("u", range=(-1, 1))
    g, f = plant.faults("g f", range=[(-0.1, 0.1), (-1, 1)], rate=[0.01, 0.05])
    w = plant.disturbances("w1:3", bound=0.05)
    plant.dynamics([x * sp.Rational(9, 10) + u + f, z * sp.Rational(8, 10) + x / 9], Ts=1)
    plant.outputs([x + g + w[0], z + w[1]])
    model = GeneralUIO().read(plant)
    assert model.design.unfollowed == ()
    blind = ob.Plant("blind")
    (x,) = blind.states("x", range=(-5, 5))
    g, f = blind.faults("g f", range=[(-0.1, 0.1), (-1, 1)], rate=[0.01, 0.05])
    (w,) = blind.disturbances("w", bound=0.05)
    blind.dynamics([x * sp.Rational(9, 10) + f + g], Ts=1)
    blind.outputs([x + w])
    model = GeneralUIO().read(blind)
    assert len(model.design.unfollowed) == 1
    observer = ob.BoundedErrorUIO(bounds="peak").design(blind)
    assert np.isfinite(observer.half_widths).all()
    assert model.design.unfollowed == ("g",)
    assert any(text.startswith("g counts as") for text in observer.guarantee.claims)


def alike():
    """Two faults that act alike, one that comes without a rate, one that is constant."""
    plant = ob.Plant("alike")
    x, z = plant.states("x z", range=(-5, 5))
    g, f, jump = plant.faults(
        "g f jump", range=[(-0.1, 0.1), (-1, 1), (-0.1, 0.1)], rate=[0.01, 0.05, None]
    )
    (drift,) = plant.faults("drift", range=(-0.1, 0.1), constant=True)
    w = plant.disturbances("w1:3", bound=0.05)
    plant.dynamics([x / 2 + f + g, z / 2 + x * z / 99 + jump + drift], Ts=1)
    plant.outputs([x + w[0], z + w[1]])
    return plant


def sliding(most=2):
    """A state that does not decay, seen through a slope that vanishes at -2 and 2."""
    plant = ob.Plant("sliding")
    v, r = plant.states("v r", range=[(-most, most), (-3, 3)], nominal=[0.5, 0])
    w = plant.disturbances("w1 w2", bound=[0.01, 0.02])
    plant.dynamics([v * sp.Rational(101, 100) + w[0], r / 2 + v - v**3 / 12], Ts=1)
    plant.outputs([r + w[1]])
    return plant


@pytest.mark.parametrize("bounds", ["peak", "ellipsoid"])
def test_where_no_gain_serves_is_said_by_the_names_of_the_signals(bounds):
    """Mutants: the nominal point alone; what the search tried in place of why it had to fail."""
    with pytest.raises(ob.SolverTrouble) as refusal:
        GeneralUIO(bounds=bounds).design(sliding())
    assert "where v = -2, the error of v does not decay (a mode 1.01)" in str(refusal.value)
    assert "no output shows it (y1)" in str(refusal.value) and "measure v" in str(refusal.value)
    assert hidden_somewhere(extend(sliding(sp.Rational(3, 2)))) is None


def said(observer):
    """What the guarantee says of every fault."""
    claimed, names = observer.guarantee.claims, observer.model.names("f")
    return {name: [text for text in claimed if text.startswith(f"{name} ")] for name in names}


def test_what_is_made_of_a_fault_and_why_stands_in_the_guarantee():
    """As `follow` has it, from what is stored. Mutants: one reason for all; no other look at g."""
    observer = GeneralUIO(bounds="ellipsoid").design(alike())
    reasons = follow(alike()).reasons
    assert "do not tell it from f" in reasons["g"]
    (g,), (f,), (jump,), (drift,) = told = said(observer).values()
    assert g.startswith("g counts as a disturbance") and g.endswith(reasons["g"])
    assert jump.startswith("jump counts as a disturbance") and jump.endswith("; it has no rate")
    assert f.startswith("f is followed as a state, by 0.05 per sample")
    assert drift.startswith("drift is followed as a state, constant")
    contract, record = GeneralUIO.CONTRACT, observer.certificate.design.to_record()
    again = contract.guarantee(contract.record.from_record(record)).claims
    assert {text for (text,) in told} <= set(again)
    for way in ("bounded", "divided"):
        found = said(GeneralUIO(faults=way).design(vanishing()))["f"]
        assert found[0].endswith(f'as faults="{way}" asks')


@pytest.mark.parametrize("bounds", ["peak", "ellipsoid"])
def test_faults_without_a_rate_are_divided_out_of_themselves(bounds):
    """Held for disturbances nothing is known of them. Mutant: the first way that finds a gain."""
    plant = ob.Plant("leak")
    (x,) = plant.states("x", range=(1, 5), nominal=2)
    plant.faults("f", range=(-1, 3))
    w = plant.disturbances("w1 w2", bound=0.02)
    plant.dynamics([x / 2 + x * plant.f[0].symbol / 9 + w[0]], Ts=1)
    plant.outputs([x + w[1]])
    observer = GeneralUIO(bounds=bounds).design(plant)
    assert observer.fault_delay == 1 and observer.half_widths[1] < 1.0
    assert said(observer)["f"][0].endswith("it has no rate")
    assert observer.certificate.design.options["faults"] == "followed"
    # another than the first is not mixed with faults that are followed
    assert GeneralUIO(bounds="ellipsoid").design(alike()).fault_delay == 0


def test_a_constant_fault_is_followed_by_peak_bounds():
    """Nothing drives it. Mutant: Riccati gains for the disturbances alone, which are none."""
    plant = ob.Plant("drifting")
    (x,) = plant.states("x", range=(-5, 5))
    plant.faults("drift", range=(-0.1, 0.1), constant=True)
    w = plant.disturbances("w1:3", bound=0.05)
    plant.dynamics([x / 2 + plant.f[0].symbol + x**2 / 99 + w[1]], Ts=1)
    plant.outputs([x + w[0]])
    design = GeneralUIO().solve(GeneralUIO().read(plant))
    assert design.extended.followed == ("drift",) and design.bound.b[3] < 0.1


def marched(observer, steps, seed, cuts_u=1.0):
    """Bang-bang noise and faults at their rate; how often a set misses, and the worst share."""
    plant = observer.model
    rng = np.random.default_rng(seed)
    box, w_box = plant.box("x"), plant.box("w")
    f_box, rates = plant.box("f"), np.array([s.rate for s in plant.f])
    x, f, sign = np.zeros(len(box)), np.zeros(len(f_box)), np.ones(len(f_box))
    memory = observer.memory0(x + 0.1, x_range=np.column_stack([x - 0.2, x + 0.2]))
    nothing = np.zeros(0)
    missed, worst = 0, np.zeros(len(box) + len(f_box))
    d = np.zeros(len(plant.d))
    function = plant.function()
    p = plant.box("p").mean(axis=1) if len(plant.p) else nothing
    for k in range(steps):
        u = cuts_u * np.sin(k / 9) * np.ones(len(plant.u))
        w = w_box[np.arange(len(w_box)), rng.integers(0, 2, len(w_box))]
        following, y = function(x, u, d, f, w, p, nothing)
        out = observer.step(memory, u, np.array(y).ravel())
        memory, low, high = out[0], np.array(out[3]).ravel(), np.array(out[4]).ravel()
        f_low, f_high = np.array(out[5]).ravel(), np.array(out[6]).ravel()
        low, high = np.concatenate([low, f_low]), np.concatenate([high, f_high])
        truth = np.concatenate([x, f])
        assert int(out[7]) == 0
        missed += int(np.any((truth < low) | (truth > high)))
        if k > steps // 2:
            share = np.abs(truth - 0.5 * (low + high)) / (0.5 * (high - low))
            worst = np.maximum(worst, share)
        x = np.array(following).ravel()
        sign = np.where(rng.random(len(sign)) < 0.02, -sign, sign)
        sign = np.where(
            (f + sign * rates > f_box[:, 1]) | (f + sign * rates < f_box[:, 0]), -sign, sign
        )
        f = f + sign * rates
        assert np.all((x >= box[:, 0]) & (x <= box[:, 1]))
    return missed, worst


@pytest.mark.parametrize("cuts", [(), None])
def test_sets_hold_states_and_faults_that_do_their_worst(design, cuts):
    """Mutant: half widths smaller by a third."""
    given = replace(design, options=GeneralUIO(cuts=cuts).options())
    contract = GeneralUIO.CONTRACT
    observer = contract.certify(bound_peak(settle(given))).observer()
    for seed in range(3):
        missed, worst = marched(observer, 400, seed, 0.4)
        assert missed == 0
        assert worst.max() > 0.6


def test_a_parameter_and_a_load_of_any_size_are_covered():
    observer = observer_of("general_uio")
    plant = observer.model
    rng = np.random.default_rng(5)
    for b in (0.09, 0.11):
        x, f = np.zeros(2), np.zeros(1)
        memory = observer.memory0(x, x_range=[(-1, 1), (-1, 1)])
        for k in range(120):
            u, d = np.array([3 * np.sin(k / 11)]), np.array([0.3 * rng.standard_normal()])
            w = 0.9 * plant.box("w")[np.arange(3), rng.integers(0, 2, 3)]
            following, y = plant.function()(x, u, d, f, w, [b], [])
            out = observer.step(memory, u, np.array(y).ravel())
            memory = out[0]
            assert int(out[7]) == 0
            for value, low, high in ((x, out[3], out[4]), (f, out[5], out[6])):
                assert np.all((np.array(low).ravel() <= value) & (value <= np.array(high).ravel()))
            x = np.clip(np.array(following).ravel(), -39, 39)
            f = np.clip(f + 0.08 * np.sign(np.sin(k / 25)), -4, 4)


def test_given_gains_are_taken_as_the_field_writes_them():
    model = read(motor())
    design = GeneralUIO().solve(model)
    again = GeneralUIO().fix(model, {"L": design.L})
    assert np.allclose(again.Z, design.Z, rtol=1e-9, atol=1e-12)
    assert again.bound.b == pytest.approx(design.bound.b, rel=1e-6)
    with pytest.raises(ObsynthError, match="load away"):
        GeneralUIO().fix(model, {"L": design.L * 1.1})


def test_faults_of_any_size_are_divided_out():
    """Mutants: the fault's set not delayed; its gain at the estimate alone."""
    observer = ob.IntervalObserver().design(motor())
    plant = observer.model
    assert observer.method == "general_uio" and observer.fault_delay == 1
    assert np.isinf(observer.performance["core_half_widths"][2])
    assert observer.half_widths[2] < 4
    rng = np.random.default_rng(7)
    x, f, before = np.zeros(2), np.zeros(1), np.zeros(1)
    memory = observer.memory0(x, x_range=[(-1, 1), (-1, 1)])
    widest = 0.0
    for k in range(200):
        u, d = np.array([3 * np.sin(k / 11)]), np.array([0.3 * rng.standard_normal()])
        w = plant.box("w")[np.arange(3), rng.integers(0, 2, 3)]
        following, y = plant.function()(x, u, d, f, w, [0.11], [])
        out = observer.step(memory, u, np.array(y).ravel())
        memory = out[0]
        low, high = np.array(out[5]).ravel(), np.array(out[6]).ravel()
        if k:
            assert int(out[7]) == 0 and low <= before <= high
            widest = max(widest, float(0.5 * (high - low)[0]))
        assert np.all((np.array(out[3]).ravel() <= x) & (x <= np.array(out[4]).ravel()))
        before, x = f, np.clip(np.array(following).ravel(), -39, 39)
        f = np.clip(f + 0.08 * np.sign(np.sin(k / 25)), -4, 4)
    assert widest <= observer.half_widths[2] * (1 + 1e-9)


def test_faults_that_cannot_be_divided_out_are_refused_by_name():
    plant = ob.Plant("alike")
    x, z = plant.states("x z", range=(-5, 5))
    plant.faults("g f", range=(-1, 1))
    g, f = (s.symbol for s in plant.f)
    plant.dynamics([x * (1 + z / 99) / 2 + f + g, z / 2 + x / 3], Ts=1)
    plant.outputs([x, z])
    with pytest.raises(ob.StructureError, match="g, f act in 1 direction"):
        GeneralUIO(faults="divided").design(plant)
    shown = ob.Plant("shown")
    (x,) = shown.states("x", range=(-5, 5))
    shown.dynamics([x / 2 + sp.sin(x) / 9], Ts=1)
    shown.outputs([x])
    shown.sensor_faults("s", of="y1", range=(-1, 1), rate=0.1)
    with pytest.raises(ob.StructureError, match="sensor fault s stands in the output y1"):
        GeneralUIO(faults="divided").design(shown)


def vanishing():
    """A fault whose gain passes zero inside of the box."""
    plant = ob.Plant("vanishing")
    (x,) = plant.states("x", range=(-1, 3))
    (f,) = plant.faults("f", range=(-0.5, 0.5), rate=0.02)
    w = plant.disturbances("w1 w2", bound=0.01)
    plant.dynamics([x * sp.Rational(7, 10) + x * f / 2 + w[0] / 2 + sp.Rational(1, 10)], Ts=1)
    plant.outputs([x + w[1]])
    return plant


def test_a_fault_whose_gain_vanishes_is_divided_out_by_itself():
    """Mutant: the trouble of the search is told in place of another way."""
    with pytest.raises(ob.SolverTrouble, match=r"variation comes from .*narrow"):
        GeneralUIO().solve(GeneralUIO().read(vanishing()))
    observer = ob.BoundedErrorUIO(bounds="peak").design(vanishing())
    assert observer.fault_delay == 1
    (told,) = (text for text in observer.guarantee.claims if "divided by its gain" in text)
    assert told.endswith("; no gain was found that follows it")
    plant, rng = observer.model, np.random.default_rng(2)
    x, f, before = np.array([1.0]), np.zeros(1), np.zeros(1)
    memory = observer.memory0(x, x_range=[(0.5, 1.5)])
    widths = []
    for k in range(300):
        w = plant.box("w")[np.arange(2), rng.integers(0, 2, 2)]
        following, y = plant.function()(x, [], [], f, w, [], [])
        out = observer.step(memory, [], np.array(y).ravel())
        memory, low, high = out[0], float(out[5]), float(out[6])
        assert float(out[3]) <= x[0] <= float(out[4])
        if k:
            assert low <= before[0] <= high
            widths.append(0.5 * (high - low))
        before, x = f, np.array(following).ravel()
        f = np.clip(f + 0.02 * np.sign(np.sin(k / 30)), -0.5, 0.5)
    assert np.median(widths) < 0.15
