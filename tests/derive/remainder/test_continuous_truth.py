"""Discrete plants that speak of the continuous one: what a step leaves out is a disturbance."""

import json
import subprocess
import sys

import numpy as np
import pytest
import sympy as sp
from scipy.integrate import solve_ivp

import obsynth as ob
from obsynth.derive.remainder import enclosure
from obsynth.symbolic import discretise as steps
from obsynth.symbolic.sxmodel import check_parity, sample_box

R = sp.Rational


def van_der_pol():
    plant = ob.Plant("van der Pol")
    x, v = plant.states("x v", range=[(-2.5, 2.5), (-4, 4)])
    (u,) = plant.inputs("u", range=(-1, 1))
    plant.actuator_faults("f", of="u", range=(-1, 1), rate=0.5)
    w = plant.disturbances("w1:3", bound=[0.005, 0.02])
    plant.dynamics([v, (1 - x**2) * v - x + u])
    plant.outputs([x + w[0], v + w[1]])
    return plant


def flexible_joint():
    plant = ob.Plant("flexible joint")
    limits = [(-3, 3), (-10, 10), (-3, 3), (-10, 10)]
    a, p, b, q = plant.states("th_m w_m th_l w_l", range=limits)
    (u,) = plant.inputs("u", range=(-3, 3))
    plant.actuator_faults("f", of="u", range=(-1, 1), rate=1)
    w = plant.disturbances("w1:3", bound=[0.002, 0.02])
    rate_p = R(486, 10) * (b - a) - R(125, 100) * p + R(216, 10) * u
    plant.dynamics([p, rate_p, q, -R(195, 10) * (b - a) - R(333, 100) * sp.sin(b)])
    plant.outputs([a + w[0], p + w[1]])
    return plant


def cart_pole():
    plant = ob.Plant("cart pole")
    limits = [(-1, 1), (-3, 3), (-0.5, 0.5), (-3, 3)]
    x, v, th, om = plant.states("x v theta omega", range=limits)
    (F,) = plant.inputs("F", range=(-10, 10))
    plant.actuator_faults("f", of="F", range=(-3, 3), rate=2)
    M, m, length, g = 1, R(1, 10), R(1, 2), R(981, 100)
    top = g * sp.sin(th) + sp.cos(th) * (-F - m * length * om**2 * sp.sin(th)) / (M + m)
    turn = top / (length * (R(4, 3) - m * sp.cos(th) ** 2 / (M + m)))
    force = F + m * length * (om**2 * sp.sin(th) - turn * sp.cos(th))
    plant.dynamics([v, force / (M + m), om, turn])
    plant.outputs([x, v, th, om])
    return plant


def left_out(plant, step, count=3000, seed=0):
    """What steps leave out of the true flow, (n, count): at corners and at random points."""
    rng = np.random.default_rng(seed)

    def pick(kind):
        box = plant.box(kind).reshape(-1, 2)
        box = np.where(np.isfinite(box), box, [-5.0, 5.0])
        share = rng.random((count, len(box)))
        corner = rng.integers(0, 2, share.shape)
        share = np.where(rng.random((count, 1)) < 0.6, corner, share)
        return (box[:, 0] + share * (box[:, 1] - box[:, 0])).T

    x, u, d, f, w, p, rho = (pick(kind) for kind in ("x", "u", "d", "f", "w", "p", "rho"))
    rate = np.array([s.rate or 0.0 for s in plant.f])[:, None]
    if len(rate):
        ends = plant.box("f")
        f = np.clip(f, ends[:, :1] + rate * step.Ts, ends[:, 1:] - rate * step.Ts)
    slope = rate * rng.integers(-1, 2, f.shape)
    flow = plant.function()

    def rates(t, state):
        return np.array(flow(state.reshape(x.shape), u, d, f + slope * t, w, p, rho)[0]).ravel()

    end = solve_ivp(rates, (0, step.Ts), x.ravel(), method="DOP853", rtol=1e-12, atol=1e-13)
    quiet = np.vstack([w, np.zeros((len(step.remainder), count))])
    own = np.array(step.function()(x, u, d, f, quiet, p, rho)[0])
    return end.y[:, -1].reshape(x.shape) - own


def growing(rate=0.5):
    plant = ob.Plant("growing")
    x, y = plant.states("x y", range=(1, 2))
    (f,) = plant.process_faults("f", range=(0, 1), rate=rate)
    plant.dynamics([x * (1 + f), -y * f])
    plant.outputs([x])
    return plant


def ends(step):
    ranges = {s.name.removeprefix(steps.PREFIX): (s.lower, s.upper) for s in step.remainder}
    return np.array([ranges.get(name, (0.0, 0.0)) for name in step.names("x")]).T[..., None]


CASES = [
    (van_der_pol, "euler", None),
    (van_der_pol, "taylor", 2),
    (van_der_pol, "taylor", 3),
    pytest.param(van_der_pol, "rk4", None, marks=pytest.mark.long),
    (flexible_joint, "taylor", 2),
    (flexible_joint, "taylor", 3),
    pytest.param(cart_pole, "taylor", 2, marks=pytest.mark.long),
    pytest.param(cart_pole, "taylor", 3, marks=pytest.mark.long),
    pytest.param(cart_pole, "rk4", None, marks=pytest.mark.long),
]


@pytest.mark.parametrize(("build", "method", "order"), CASES)
def test_the_true_flow_stays_within_and_reaches_most_of_it(build, method, order):
    """Against an integrator at 1e-12, at 3000 corners and points, faults held and at their rate.

    Mutants: what moving faults add is dropped, or counted without its first term, or with
    Ts^k / k!; the order taken one too high; the box in place of the flow box. Twice the sampled
    width would do; 1.3 times is seen.
    """
    plant = build()
    step = plant.discretise(method, 0.01, order=order, remainder=True)
    found, (low, high) = left_out(plant, step), ends(step)
    assert ((low <= found) & (found <= high)).all()
    assert ((high - low)[:, 0] <= 1.35 * np.ptp(found, axis=1)).all()


@pytest.mark.parametrize(
    ("method", "order", "rate"),
    [("rk4", None, 0.5), *(("taylor", q, 0.5) for q in (1, 2, 3)), ("taylor", 2, None)],
)
def test_fast_growth_over_a_long_step_stays_within(method, order, rate):
    """Nothing here is symmetric, and solutions leave the box by far.

    Mutants: slopes by moving faults over the box in place of the flow box, or of one side only;
    the polynomial taken as zero at its own order.
    """
    plant = growing(rate)
    step = plant.discretise(method, 0.25, order=order, remainder=True)
    found, (low, high) = left_out(plant, step), ends(step)
    assert ((low <= found) & (found <= high)).all()
    assert ((high - low)[:, 0] <= 3.5 * np.ptp(found, axis=1)).all()


def test_a_step_that_is_too_long_for_higher_orders_is_enclosed_all_the_same():
    """x' = -20 x over .1 s: each order is as large as the one before, so that the first ones stay.

    Mutant: one end returned twice where the sequence stops.
    """
    plant = ob.Plant("stiff")
    plant.states("x", range=(-1, 1))
    plant.dynamics(["-20*x"])
    plant.outputs(["x"])
    step = plant.discretise("rk4", 0.1, remainder=True)
    found, (low, high) = left_out(plant, step, 200), ends(step)
    assert ((low <= found) & (found <= high)).all()
    exact = np.exp(-2) - (1 - 2 + 2 - 8 / 6 + 16 / 24)
    np.testing.assert_allclose(np.abs(found).max(), np.abs(exact), rtol=1e-9)


def test_faults_that_are_constant_or_have_no_rate_are_held():
    """Mutants: a constant fault moves; a rate per step in place of one per second."""

    def remainder(**fault):
        plant = ob.Plant("integrator")
        (x,) = plant.states("x", range=(-1, 1))
        (f,) = plant.process_faults("f", range=(-1, 1), **fault)
        plant.dynamics([f])
        plant.outputs([x])
        return plant.discretise("euler", R(1, 2), remainder=True)

    assert remainder().remainder == () == remainder(constant=True, rate=0.3).remainder
    assert remainder().rhs == remainder().continuous.discretise("euler", R(1, 2)).rhs
    (moving,) = remainder(rate=0.3).remainder
    exact = 0.3 * 0.5**2 / 2
    assert moving.upper == -moving.lower
    assert exact <= moving.upper <= exact * (1 + 1e-12)


def test_the_lowest_order_that_does_not_lose_more_is_taken():
    """Mutants: the gain compared with nothing else that is unknown; one order more than needed."""
    plant = growing()
    others = enclosure.other_unknowns(plant, 0.1)
    # both by the fault's change within a step, at the middle of the ranges
    np.testing.assert_allclose(others, 0.1 * 1.5 * 0.1 * 0.5)
    order = plant.discretise("taylor", Ts=0.1).step.order
    known = [plant.discretise("taylor", 0.1, order=k) for k in (order - 1, order, order + 1)]
    known = [ends(step)[..., 0] for step in known]
    assert enclosure.gains(known[0], known[1], others)
    assert not enclosure.gains(known[1], known[2], others)
    wide, less = ([-1.0], [1.0]), ([-0.9], [0.9])
    wide, less = (tuple(map(np.array, pair)) for pair in (wide, less))
    assert enclosure.gains(wide, less, np.array([0.1]))
    assert not enclosure.gains(wide, less, np.array([100.0]))
    # one state is enough, and what counts is a width: a remainder of one sign has half of it
    both = [tuple(np.append(end, [1.0]) for end in pair) for pair in (wide, less)]
    assert enclosure.gains(*both, np.array([0.1, 0.1]))
    assert enclosure.matters((np.array([-1.0]), np.array([0.0])), np.array([1.0]))
    assert not enclosure.matters((np.array([0.99]), np.array([1.0])), np.array([1.0]))
    noisy = ob.Plant("noisy")
    (x,) = noisy.states("x", range=(-1, 1))
    (w,) = noisy.disturbances("w", bound=100)
    noisy.dynamics([-x])
    noisy.outputs([x + w])
    # what a reading leaves unknown anyway is not worth a second derivative
    assert noisy.discretise("taylor", Ts=0.1).discretisation == "euler"
    np.testing.assert_allclose(enclosure.other_unknowns(van_der_pol(), 0.01), [0.005, 5e-5])
    silent = ob.Plant("silent")
    silent.states("x", range=(-1, 1))
    silent.dynamics(["-x"])
    silent.outputs(["x"])
    np.testing.assert_allclose(enclosure.other_unknowns(silent, 0.1), [1e-3])


def test_kinks_end_at_the_first_order_and_are_refused_beyond():
    plant = ob.Plant("kink")
    x, y = plant.states("x y", range=(-1, 1))
    plant.dynamics([sp.Abs(y) - x, -y])
    plant.outputs([x])
    step = plant.discretise("taylor", Ts=0.1)
    assert step.discretisation == "euler"
    found, (low, high) = left_out(plant, step), ends(step)
    assert ((low <= found) & (found <= high)).all()
    with pytest.raises(ob.PlantError, match=r"row of x has the kink of Abs\(y\)"):
        plant.discretise("taylor", Ts=0.1, order=2)


def test_unknown_inputs_without_a_range_are_refused_where_they_leak():
    """Mutants: no look at what depends on the states that d moves; d taken as zero all the same."""
    leaks = ob.Plant("leaks")
    x, y = leaks.states("x y", range=(-1, 1))
    (d,) = leaks.unknown_inputs("d")
    leaks.dynamics([-x + sp.sin(y), d - x])
    leaks.outputs([x, y])
    with pytest.raises(ob.UnboundedError, match="no range is declared for d") as refused:
        leaks.discretise("euler", 0.1, remainder=True)
    assert refused.value.entries == ("d",)
    assert "remainder=False" in str(refused.value)
    bent = ob.Plant("bent")
    bent.states("x y", range=(-1, 1))
    bent.unknown_inputs("d")
    bent.dynamics([-x, sp.sin(d) * x])
    bent.outputs([x])
    with pytest.raises(ob.UnboundedError, match="no range is declared for d"):
        bent.discretise("euler", 0.1, remainder=True)
    plant = ob.Plant("within its direction")
    plant.states("x y", range=(-1, 1))
    plant.unknown_inputs("d")
    plant.dynamics([-x + sp.sin(x), 3 * d - sp.cos(x)])
    plant.outputs([x, y])
    step = plant.discretise("euler", 0.1, remainder=True)
    found, (low, high) = left_out(plant, step), ends(step)
    # numbers of the size of d cancel
    assert ((low - 1e-13 <= found) & (found <= high + 1e-13)).all()
    assert (np.abs(found).max(axis=1) > 1e-4).all()


def test_a_plant_with_its_remainder_is_what_its_file_says():
    """Mutants: ranges rounded on the way; an order or the remainder forgotten; format 1."""
    plant = van_der_pol()
    for options in ({"method": "taylor", "order": 3}, {"method": "euler", "remainder": True}):
        step = plant.discretise(Ts=R(1, 100), **options)
        data = json.loads(json.dumps(step.to_dict()))
        assert data["format"] == "obsynth plant 2"
        again = ob.Plant.from_dict(data)
        assert again.remainder == step.remainder
        assert again.signals == step.signals and again.rhs == step.rhs
        assert again.to_dict() == data
        assert again.step == step.step and again.continuous.to_dict() == plant.to_dict()
        assert enclosure.carries_remainder(again) == ""
    data["format"] = "obsynth plant 1"
    with pytest.raises(ob.PlantError, match="the format is"):
        ob.Plant.from_dict(data)
    plain = plant.discretise("taylor", 0.01, order=2, remainder=False)
    assert plain.remainder is None and plain.to_dict()["format"] == "obsynth plant 1"
    assert ob.Plant.from_dict(plain.to_dict()).rhs == plain.rhs
    assert enclosure.carries_remainder(plain)


@pytest.mark.parametrize(
    ("name", "pair"),
    [("z", [0.0, 1.0]), ("x", [1.0, 0.0]), ("x", [0.0, float("inf")]), ("x", 1.0), ("x", [0, "1"])],
)
def test_stored_remainders_that_are_none_are_refused(name, pair):
    data = van_der_pol().discretise("euler", 0.01, remainder=True).to_dict()
    data["discretise"]["remainder"][name] = pair
    with pytest.raises(ob.PlantError, match="remainder"):
        ob.Plant.from_dict(data)


def test_a_range_that_was_made_narrower_is_noticed():
    """Mutants: only the upper end compared; a remainder that is left away passes."""
    step = van_der_pol().discretise("taylor", 0.01, order=2)
    for change in (
        lambda kept: kept["x"].__setitem__(0, kept["x"][0] * 0.999),
        lambda kept: kept["v"].__setitem__(1, kept["v"][1] * 0.999),
        lambda kept: kept.pop("v"),
    ):
        data = json.loads(json.dumps(step.to_dict()))
        change(data["discretise"]["remainder"])
        assert "is left out of" in enclosure.carries_remainder(ob.Plant.from_dict(data))


@pytest.mark.parametrize("constants", ["value", "symbol"])
def test_both_forms_of_a_step_agree(constants):
    """SymPy against SX at random points. Mutants: a factorial; a remainder in another's row."""
    plant = ob.Plant("constants")
    x, y = plant.states("x y", range=(-1, 1))
    (a,) = plant.params("a", R(1, 3))
    (w,) = plant.disturbances("w", bound=1)
    plant.dynamics([y, -a * sp.sin(x) + w * y])
    plant.outputs([x])
    for order in (2, 4):
        step = plant.discretise("taylor", R(1, 2), order=order)
        model = step.sx(constants)
        symbols = [s.symbol for kind in ("x", "w") for s in getattr(step, kind)]
        rows = [row.xreplace(step.constant_values) for row in step.rhs]
        function = model.function()

        def values(point, function=function):
            at = [point[:2], [], [], [], point[2:], [], []]
            return function(*at, *([1 / 3] if constants == "symbol" else []))[0]

        points = sample_box(np.tile([-1.0, 1.0], (5, 1)), 8)
        check_parity(rows, symbols, lambda p, v=values: np.array(v(p)), points, ["x", "y"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "taylor", "order": 7}, "no whole number from 1 to 6"),
        ({"method": "taylor", "order": True}, "no whole number"),
        ({"method": "euler", "order": 2}, "option of 'taylor'"),
        ({"method": "taylor", "remainder": False}, "give order="),
        ({"method": "euler", "remainder": "yes"}, "True or False"),
        ({"method": "heun"}, "euler, rk4, taylor"),
    ],
)
def test_options_are_refused_by_name(options, message):
    with pytest.raises(ob.PlantError, match=message):
        van_der_pol().discretise(Ts=0.01, **options)


def test_a_name_that_is_taken_and_a_room_alone_are_refused(monkeypatch):
    plant = ob.Plant("taken")
    x, r = plant.states("x remainder_x", range=(-1, 1))
    plant.dynamics([-x, -r])
    plant.outputs([x])
    with pytest.raises(ob.PlantError, match="remainder_x is needed"):
        plant.discretise("euler", 0.1, remainder=True)
    monkeypatch.setattr(steps, "ENCLOSURES", [])
    with pytest.raises(ob.PlantError, match="import obsynth"):
        van_der_pol().discretise("taylor", 0.1)


def test_the_public_package_hands_plants_what_encloses_remainders():
    """Mutant: the package does not import it."""
    code = (
        "import obsynth as ob\n"
        "plant = ob.Plant('p')\n"
        "(x,) = plant.states('x', range=(1, 2))\n"
        "plant.dynamics([-x]); plant.outputs([x])\n"
        "print(plant.discretise('taylor', 0.1, order=2).names('w'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "('remainder_x',)"


def test_people_see_what_the_remainder_is():
    step = van_der_pol().discretise("taylor", 0.01, order=2)
    page = step._repr_html_()
    assert "what a step of taylor 2 leaves out" in page and "remainder_v" in page
    assert "taylor 2" in step._repr_latex_()
    assert [s.unit for s in step.remainder] == ["", ""]
