"""What is asked of a record, by plants so small that the answer is known."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.sparse import csr_array
from witness import happened, record_of

import obsynth as ob
from obsynth.evaluate.bounds import certified
from obsynth.evaluate.bounds.attribution import attribute
from obsynth.evaluate.bounds.boxes import enclose
from obsynth.evaluate.bounds.linear import Linear, assemble
from obsynth.evaluate.bounds.problem import pose
from obsynth.evaluate.bounds.trajectory import measured


def still_level(bounds=(0.1, 0.1), rate=None, moved=True):
    """x+ = x + u + f, y = x + w1 + w2."""
    plant = ob.Plant("level")
    (x,) = plant.states("x", range=(0, 1))
    (u,) = plant.inputs("u", range=(-1, 1))
    (f,) = plant.faults("f", range=(-0.1, 0.1), rate=rate)
    w = plant.disturbances(f"w1:{len(bounds) + 1}", bound=list(bounds)) if len(bounds) else ()
    plant.dynamics([x + u + (f if moved else 0 * f)], Ts=1)
    plant.outputs([sum(w, x)])
    return plant


def asked(y, u=None, free=(), groups=None, **options):
    plant = still_level(**options)
    u = np.zeros((len(y), 1)) if u is None else u
    return plant, record_of(plant, u, np.array(y, float)[:, None])


def test_nothing_is_said_of_what_follows_the_record():
    """A mistake that holds the state after the last instant to its range finds nothing left."""
    plant, record = asked([0.5, 0.9], [[0.4], [0.9]])
    problem = pose(plant, record, [])
    assert enclose(problem, np.array([0.1])).empty is None
    fit = ob.least_bounds(plant, record, [])
    assert fit.upper < 1e-6 and not fit.refutes(outputs=0.1)


def test_sums_of_readings():
    """Levels 0, 1, 0, 1 need |w1| + |w2| = 1/2: each 1/4, or .4 beside a w2 that is held to .1."""
    plant, record = asked([0, 1, 0, 1])
    fit = ob.least_bounds(plant, record, [])
    assert abs(fit.upper - 0.25) < 1e-7 and 0.25 - 1e-7 < fit.lower <= fit.upper
    fit = ob.least_bounds(plant, record, [], groups={"first": ["w1"]})
    assert abs(fit.upper - 0.4) < 1e-7 and 0.4 - 1e-7 < fit.lower <= fit.upper
    assert fit.refutes(first=0.399) and not fit.refutes(first=0.401)
    assert fit.plant.box("w")[1].tolist() == [-0.1, 0.1]


def test_a_trajectory_keeps_what_is_held():
    """A mistake that closes readings by any disturbance needs .25 of w1, and as much of w2."""
    record = asked([0, 1, 0, 1])[1]
    v = np.tile([0.5, 0.0, 0.0, 0.0], (4, 1))
    for groups, bounds, need in (
        ({"first": ["w1"]}, (0.1, 0.1), 0.5),
        ({"all": ["w1", "w2"]}, (0.1, 0.0), 0.5),
        ({"all": ["w1", "w2"]}, (0.1, 0.1), 0.25),
    ):
        found = measured(pose(still_level(bounds), record, [], groups), v)
        assert abs(found.bounds[0] - need) < 1e-9


def test_a_trajectory_keeps_rates():
    """One that moves a fault by more than its rate attains nothing."""
    plant, record = asked([0.5, 0.5, 0.6], rate=0.05)
    v = np.array([[0.5, 0.0, 0, 0], [0.5, 0.1, 0, 0], [0.6, 0.1, 0, 0]])
    assert measured(pose(plant, record), v).bounds[0] == np.inf
    v[:, :2] = [0.5, 0.05], [0.55, 0.1], [0.65, 0.1]
    assert np.isfinite(measured(pose(plant, record), v).bounds[0])


def test_sizes_hold_the_ranges():
    """Mistakes of half a unit: of the share in a group, of the middle, of the product."""
    rng = np.random.default_rng(0)
    for _ in range(10):
        plant, record = asked([0.5, 0.5], bounds=rng.uniform(0, 1, 3))
        low, high = np.sort(rng.normal(size=(2, 3)), axis=0)
        ranges = {f"w{j + 1}": (low[j], high[j]) for j in range(3)}
        problem = pose(plant.with_ranges(ranges), record)
        radius = np.maximum(high - problem.middle, problem.middle - low)
        sizes = problem.sizes(np.array([np.nextafter(radius.max(), np.inf)]))
        for m, size, a, b in zip(problem.middle, sizes, low, high, strict=True):
            assert Fraction(m) - Fraction(size) <= Fraction(a)
            assert Fraction(b) <= Fraction(m) + Fraction(size)
        bounds, own = rng.uniform(0, 1, 3), rng.uniform(0, 1)
        shape = (even := pose(*asked([0.5, 0.5], bounds=bounds))).shape
        for share, size, bound in zip(shape, even.sizes(np.array([own])), bounds, strict=True):
            assert Fraction(share) * Fraction(bounds.max()) >= Fraction(bound)
            assert Fraction(size) >= Fraction(share) * Fraction(own)


def test_what_a_step_leaves_out_is_no_bound_to_find():
    """Its range is proved, and a plant does not take another."""
    truth = happened("remainder cruise_control", 1, 12)
    fit = ob.least_bounds(truth.plant, truth.record)
    carrier = truth.plant.names("w").index("remainder_v")
    assert fit.problem.group[carrier] == len(fit.bounds) == 2
    assert 0.0 < fit.plant.w[carrier].upper < 1.1 * truth.plant.w[carrier].upper


def test_known_lower_ends():
    """Bounds that are known not to be smaller, as those of a quantum, are never below."""
    plant, record = asked([0.5, 0.5, 0.5])
    fit = ob.least_bounds(plant, record, [], least_of={"outputs": 0.02})
    assert fit.bounds["outputs"] == fit.upper == 0.02 and abs(fit.lower - 0.02) < 1e-9


def test_what_no_bounds_explain():
    """Readings without noise outside of the range: proved, and said."""
    plant = ob.Plant("bare")
    (x,) = plant.states("x", range=(0, 1))
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([x + w], Ts=1)
    plant.outputs([x])
    fit = ob.least_bounds(plant, record_of(plant, np.empty((2, 0)), [[0.5], [2.0]]))
    assert fit.lower == fit.upper == np.inf and fit.refuted
    assert "No bounds explain it" in str(fit) and fit.to_dict()["upper"] is None
    with pytest.raises(ob.BoundsError, match="no bounds were found"):
        fit.plant.names("w")
    fit = ob.least_bounds(plant, record_of(plant, np.empty((3, 0)), [[0.5], [0.75], [0.5]]))
    assert abs(fit.upper - 0.25) < 1e-7 and abs(fit.lower - 0.25) < 1e-7


def test_what_is_empty_below_what_is_attained(monkeypatch):
    """It proves what was looked up to, not that no bounds do."""
    plant, record = asked([0, 1, 0, 1])
    monkeypatch.setattr(certified, "ROOM", -1e-3)
    found = certified.least(pose(plant, record, []), np.ones(1))
    assert found.solution is None and found.lower <= found.upper < 0.251


def test_one_disturbance_alone():
    plant, record = asked([0, 1, 0, 1], bounds=(0.1,))
    found = ob.least_bounds(plant, record, []).attribute()
    assert found.first is None and found.alone.rows[0][1] == 0.0


def program(rows, right, equal=False):
    """A linear program in one variable between 0 and 2."""
    A = csr_array(np.array(rows, float)[:, None])
    none = np.empty(0, dtype=np.int64)
    same = np.full(len(rows), equal)
    ends = np.array([0.0]), np.array([2.0])
    return Linear(A, np.array(right, float), same, *ends, none, none, none)


def test_emptiness_is_proved():
    """Mistakes: always, never; a slack without an upper end is never certified."""
    for gap in (1e-3, 1e-6):
        assert program([1, -1], [1.0, -1.0 - gap]).empty()
        found = program([1, -1], [1.0, -1.0 - gap]).minimise(np.ones(1))
        assert found.certified == np.inf
    assert not program([1, -1], [1.0, -1.0]).empty()
    assert program([3.0], [7.0], equal=True).empty()
    assert replace(program([1], [1.0]), lower=np.array([3.0])).minimise(np.ones(1)).value == np.inf
    assert replace(program([1], [9.0]), lower=np.array([3.0])).empty()
    assert not program([3.0], [1.0], equal=True).empty()


def test_multipliers_of_any_quality():
    """A certificate that takes the other end of a variable is above what is attained."""
    rng = np.random.default_rng(0)
    linear = program([1, -1], [1.0, -0.25])
    for _ in range(100):
        cost, multipliers = rng.normal(size=1), rng.exponential(size=2)
        assert linear.certify(cost, multipliers) <= min(0.25 * cost[0], cost[0])
    assert linear.certify(np.ones(1), np.array([0.0, 1.0])) == 0.25


def test_refusals():
    plant, record = asked([0, 1, 0, 1])
    fit = ob.least_bounds(plant, record, [])
    with pytest.raises(ob.BoundsError, match="groups outputs"):
        fit.refutes(output=0.1)
    with pytest.raises(ob.BoundsError, match="groups outputs"):
        fit.refutes(outputs=np.nan)
    with pytest.raises(ob.BoundsError, match="'g' is none of x, f"):
        fit.attribute(without=["g"])
    with pytest.raises(ob.BoundsError, match="2 to 4"):
        fit.validate(5)
    with pytest.raises(ob.BoundsError, match="no disturbance whose bound is open"):
        ob.least_bounds(*asked([0.5, 0.5], bounds=()))
    gap = replace(record, u=np.where(np.arange(4)[:, None] == 2, np.nan, record.u))
    with pytest.raises(ob.BoundsError, match="known throughout"):
        ob.least_bounds(plant, gap)
    with pytest.raises(ob.SimulationError, match="sampled every 1 s"):
        ob.least_bounds(plant, replace(record, time=0.5 * record.time))


def test_what_is_past_the_bounds():
    """Readings half a unit off, of which .2 are allowed, at four instants. Mistake: a slack that
    takes room away."""
    plant, record = asked([0, 1, 0, 1])
    found = attribute(pose(plant, record, []), record, np.array([0.1]))
    assert abs(found.excess.sum() - 1.2) < 1e-9
    assert found.scale[0] == pytest.approx(2.5) == found.scale[1]


def test_what_stands_still_is_one_number():
    """Readings p and 1 + p of one parameter; one of its own at each instant would explain both."""
    plant = ob.Plant("gain")
    (x,) = plant.states("x", range=(0, 1))
    (p,) = plant.params("p", range=(0, 2))
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([x], Ts=1)
    plant.outputs([p * (1 + 0 * x) + w])
    record = record_of(plant, np.empty((3, 0)), [[0.5], [1.5], [1.0]])
    fit = ob.least_bounds(plant, record)
    assert abs(fit.upper - 0.5) < 1e-7 and 0.5 - 1e-7 < fit.lower <= fit.upper
    assert abs(fit.params["p"] - 1.0) < 1e-6
    assert fit.validate(3).free == 2  # the parameter was fitted as well
    boxes = enclose(fit.problem, np.array([0.75]))
    assert np.allclose(boxes.ends[:, 2], [0.75, 1.25])


def test_faults_move_by_their_rates():
    """0, .1, .1 with .1 at first, and no more than .05 less after it; .1 less were none at all."""
    plant, record = asked([0, 0.1, 0.1], rate=0.05)
    assert ob.least_bounds(plant, record).lower > 0.005
    assert ob.least_bounds(*asked([0, 0.1, 0.1])).upper < 1e-6
    fit = ob.least_bounds(*asked([0, 0.1, 0.15], rate=0.05))
    assert fit.upper < 1e-6 and not fit.refutes(outputs=1e-5)
    loose, top = pose(plant, record), np.array([0.05])
    linear = assemble(loose, enclose(loose, top), top)
    assert abs(linear.minimise(linear.cost(np.ones(1))).certified - 0.05 / 8) < 1e-9
    exact = pose(*asked([0, 0.1, np.nan], rate=0.05))
    boxes = enclose(exact, np.array([1e-6]))
    assert np.allclose(boxes.ends[:2, 1], [[0.1, 0.1], [0.05, 0.1]], atol=1e-5)


def test_windows_of_long_records(monkeypatch):
    """Half a unit in the second of three windows; it is told at its time."""
    monkeypatch.setattr(certified, "LONGEST", 2)
    plant, record = asked([0.5, 0.5, 0.0, 1.0, 0.5, 0.5, 0.5])
    said = []
    problem = pose(plant, record, [])
    found = certified.least(problem, np.ones(1), progress=lambda *a: said.append(a))
    assert abs(found.lower - 0.25) < 1e-7 and found.begin == 2
    assert [round(share, 2) for _, share in said] == [0.0, 0.2, 0.43, 0.66, 0.89]
    support = ob.LeastBounds(problem, record, 1.2, found).support
    assert {row[0] for row in support.rows} == {2.0, 3.0}
    fit = ob.LeastBounds(problem, record, 1.2, found)
    assert fit.refutes(outputs=0.24) and not fit.refutes(outputs=0.26)
    narrow = replace(problem, first=np.array([[0.5, 0.5]]))
    assert narrow.window(2, 4).first is None
    assert enclose(narrow, np.ones(1)).ends[0, 0].tolist() == [0.5, 0.5]


def test_a_range_that_is_too_narrow_is_told() -> None:
    """Readings beyond the range of a level: not the noise is large, the range is small."""
    record = ob.records.three_tank_leak()[:30]
    plant = ob.plants.leaking_tanks()
    assert not ob.least_bounds(plant, record).pressed
    fit = ob.least_bounds(plant.with_ranges({"h2": (0.0, 0.3)}), record)
    assert set(fit.pressed) == {"h2"}
    assert f"h2 at {fit.pressed['h2']} instants" in str(fit) and fit.refuted


def test_a_constant_that_is_held_asks_nothing(capfd):
    """CasADi would warn of equations without a variable: of two constants between ten readings."""
    plant = ob.Plant("line")
    (x,), (a, b) = plant.states("x", range=(-9, 9)), plant.params("a b", range=(0.5, 1.5))
    w, r = plant.disturbances("w r", bound=(0.1, 0.1))
    plant.dynamics([x * a * b + w], Ts=1)
    plant.outputs([x + r])
    told = np.array([0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0])
    record = ob.read_record({"y1": told}, plant)
    fit = ob.least_bounds(plant, record, free=[])
    assert abs(fit.upper - 0.5) < 1e-6
    shown = capfd.readouterr()
    assert "overconstrained" not in shown.out + shown.err
