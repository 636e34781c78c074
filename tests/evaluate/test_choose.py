"""Choosing: the rule, the time limit, the common run, what is shown."""

import multiprocessing
import os
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gallery import TIMES

import obsynth as ob
from obsynth.evaluate.choosing.choice import Choice
from obsynth.evaluate.choosing.tries import METHODS, Try, attempt, first_sentence, in_time, named

PLANT = ob.plants.leaking_tanks()


class Told(SimpleNamespace):
    """A run that knows half widths only."""

    def __getitem__(self, name):
        return SimpleNamespace(half_width=self.widths[name])


def entry(name, leak, operations, state=0.01, missed=0.0, **more):
    """A try whose intervals of the leak, half range .05, are as wide in a run of ten instants."""
    half = np.tile([state, state, state, leak], (10, 1))
    half[:3] *= 3
    names = {"x": ("e1", "h2", "e3")}
    estimated = (*names["x"], "leak")
    observer = SimpleNamespace(
        half_widths=half[-1] * 2,
        step=SimpleNamespace(n_instructions=lambda: operations),
        guarantee=SimpleNamespace(assumptions=("bounded", f"as {name} has it")),
    )
    run = Told(
        x=np.zeros((10, 3)),
        t=np.arange(10),
        names=names,
        estimated=estimated,
        scenario="by hand",
        widths=dict(zip(estimated, half.T, strict=True)),
        coverage=dict.fromkeys(estimated, 1.0 - missed),
        status=np.zeros(10, dtype=int),
    )
    return Try(name, 1.5, observer, run, **more)


def choice(*tries, budget=None, criterion=("leak",), plant=PLANT):
    refused = Try("Refused", 0.5, reason="no <b>rank</b>")
    kalman = entry("Kalman", 0.01, 7, missed=0.25)
    kalman.observer.half_widths = None
    return Choice(plant, criterion, budget, (*tries, refused), kalman)


def test_the_cheapest_of_the_narrowest_is_recommended():
    """Mutants: the narrowest whatever it costs; the cheapest whatever its width; 5 per cent of the
    wider one."""
    tries = entry("narrow", 0.0200, 900), entry("near", 0.0209, 500), entry("wide", 0.02101, 100)
    found = choice(*tries)
    assert found.best.name == "near" and found.recommended is found.best.observer
    assert found.score(found.best) == pytest.approx(0.418)
    assert "near is recommended" in found.reason and "within 5 % of narrow" in found.reason
    assert choice(*tries[::2]).best.name == "narrow"
    assert choice(*tries, budget=400).best.name == "wide"
    none = choice(*tries, budget=99)
    assert none.recommended is None and "wide has the fewest operations, 100" in none.reason


def test_what_missed_the_truth_or_bounds_nothing_is_not_recommended():
    """Mutant: what misses is not looked at."""
    found = choice(
        entry("wrong", 0.01, 10, missed=0.1), entry("empty", np.inf, 10), entry("r", 1, 9)
    )
    assert found.best.name == "r"
    assert "misses 10 %" in str(found.table)
    assert "no method gives" in choice().reason
    mean = entry("mean", 0.01, 10, means=True)
    mean.run.coverage["leak"] = 0.5
    assert mean.missed == 0.0 and entry("now", 0.01, 10, missed=0.5).missed == 0.5


def test_where_the_fault_is_not_bounded_the_states_decide_and_the_reason_says_so():
    """Mutants: the other signals left out; vacuous intervals not told."""
    found = choice(entry("a", 0.05, 10, state=0.1), entry("b", 0.0499, 20, state=0.01))
    assert found.best.name == "b"
    assert "say hardly more than the declared ranges" in found.reason
    assert "Hardly more than is declared is told by a." in found.reason
    told = choice(entry("a", 0.05, 10), entry("b", 0.02, 20))
    assert (
        told.best.name == "b" and "is told by a." in told.reason and "say hardly" not in told.reason
    )


def test_signals_without_a_range_are_measured_by_the_narrowest():
    plant = ob.Plant("free")
    (x,) = plant.states("x", range=(-1, 1))
    (f,) = plant.faults("f")
    plant.dynamics([x / 2 + f], Ts=1)
    plant.outputs([x])
    tries = [entry(name, 1, 1) for name in "ab"]
    for one, share in zip(tries, (1, 2), strict=True):
        one.run.estimated, one.run.names = ("x", "f"), {"x": ("x",)}
        one.run.coverage = {"x": 1.0, "f": 1.0}
        one.run.widths.update(x=np.full(4, 0.5 * share), f=np.full(4, 3.0 * share))
        one.observer.half_widths = None
    found = Choice(plant, ("f",), None, tuple(tries), tries[1])
    assert [found.score(one) for one in tries] == [1.0, 2.0]
    assert found.best.name == "a" and "hardly" not in found.reason
    assert "are 1 of the narrowest found in the mean" in found.reason
    assert found.table.title.startswith("Half width / narrowest found of f, ")
    assert found.online(tries[1]).tolist() == [1.0, 2.0]


def test_everything_is_shown():
    found = choice(entry("one", 0.02, 900, means=True), entry("<two>", 0.03, 500))
    table = found.table
    assert table.rows[0][:7] == ["one", True, pytest.approx(0.4), pytest.approx(0.8), 3, 900, 1.5]
    assert table.rows[0][7] == "recommended; its faults are means over time"
    assert [one.operations for one in found.tries] == [900, 500, None]
    assert table.rows[2][1] is False and table.rows[2][7] == "no <b>rank</b>"
    assert table.rows[3][1] == "no guarantee" and "misses 25 %" in table.rows[3][7]
    assert table.rows[3][2:4] == [pytest.approx(0.2), None]
    assert table.marked == [0]
    assert "hold means over time" in found.reason and "means" not in choice(entry("o", 1, 1)).reason
    assert repr(found) == f"<Choice for 'leaking tanks': {found.reason}>"
    assert found.widths.columns == ["signal", "one", "<two>", "Kalman, no guarantee"]
    assert found.widths.rows[3][:2] == ["leak", "0.4 (0.8)"]
    many = choice(*(entry(name, 0.02, 900) for name in "abcd")).widths
    assert many.columns == ["observer", "e1", "h2", "e3", "leak"]
    assert [row[0] for row in many.rows] == [*"abcd", "Kalman, no guarantee"]
    assert many.rows[0][4] == "0.4 (0.8)"
    assert found.assumptions.rows[0] == ["bounded", "one, <two>"]
    page = found._repr_html_()
    assert "&lt;two&gt;" in page and "<two>" not in page and "<b>rank" not in page
    import matplotlib as mpl

    mpl.use("agg")
    ax = found.plot()
    assert [t.get_text() for t in ax.get_yticklabels()] == ["e1", "h2", "e3", "leak"]
    assert "one (recommended)" in [t.get_text() for t in ax.figure.legends[0].get_texts()]


def test_a_method_is_ended_when_its_time_is_up(capfd):
    """Mutants: the process not ended; no limit; what it prints shown among the bars."""
    alone, start = os.getpid(), time.perf_counter()

    def works():
        print("shown nowhere", flush=True)
        return Try("works", float(os.getpid() != alone))

    slow = in_time("slow", lambda: time.sleep(60), 0.2)
    assert slow.reason == "no design within 0.2 s" and time.perf_counter() - start < 5
    assert in_time("dies", lambda: os._exit(3), 5).reason == "its process ended with exit code 3"
    assert in_time("works", works, 5).seconds == 1.0 and not multiprocessing.active_children()
    assert capfd.readouterr().out == ""
    assert in_time("works", works, None).seconds == 0.0


def test_one_method_cannot_take_the_time_of_the_others(monkeypatch):
    """Mutants: all that is left for the first; the limit for each of them."""
    monkeypatch.setattr(ob.HinfUIO, "design", lambda *_: time.sleep(60))
    few, start = [ob.HinfUIO(), ob.HinfUIO(horizon=9), ob.FilterBank()], time.perf_counter()
    found = ob.choose(PLANT, ob.records.three_tank_leak(), methods=few, limit=1.0)
    assert time.perf_counter() - start < 5
    first, second, third = (one.reason for one in found.tries)
    taken = [
        float(said.removeprefix("no design within ").removesuffix(" s")) for said in (first, second)
    ]
    assert 0 < taken[1] < taken[0] <= 0.5 and sum(taken) < 0.9
    assert "does not work in discrete time" in third


def test_names_and_reasons_are_short():
    assert named(ob.IntervalObserver(gains="search")) == "IntervalObserver(gains='search')"
    assert named(ob.QPVObserver()) == "QPVObserver"
    assert len({named(method) for method in METHODS}) == len(METHODS)
    assert (
        first_sentence("It fails: x = 3.5 is too large.  Take less.")
        == "It fails: x = 3.5 is too large"
    )
    assert len(first_sentence("word " * 100)) == 120


def test_the_reason_of_a_refusal_is_its_headline():
    class Refusing(ob.HinfUIO):
        def design(self, plant):
            raise ob.InfeasibleDesign("no gain was found with |L| <= 3", ["the smallest is 8"])

    found = attempt(Refusing(), ob.plants.dc_motor(), print)
    assert found.reason == "no gain was found with |L| <= 3"


def test_every_observer_sees_the_same_noise_and_the_model_that_is_its_own():
    """Mutants: noise of another seed for each; a remainder drawn with the noise of the others."""
    few = [ob.IntervalObserver(), ob.HinfUIO(), ob.FilterBank()]
    plant = ob.plants.tanks_in_a_row(2)
    kept = plant.discretise("euler", Ts=0.5, remainder=True)
    found = ob.choose(kept, methods=few, limit=None, scenario=ob.scenarios.gentle(kept, 60))
    assert found.criterion == ("f",) and len(found.made) == 3
    runs = [one.run for one in (*found.tries, found.kalman)]
    assert {one.missed for one in found.tries} == {0.0}
    assert {one.observer.model.Ts for one in found.tries} == {0.5}
    own = [one.observer.model.discretisation for one in found.tries]
    assert own == ["euler", "euler", "rk4"] and found.tries[2].means
    for run in runs:
        assert np.array_equal(run.u, runs[0].u) and np.array_equal(run.f, runs[0].f)
        assert np.array_equal(run.w[:, :2], runs[0].w[:, :2]) and np.ptp(run.w[:, 0]) > 0
    assert np.array_equal(runs[1].x, runs[0].x) and not np.array_equal(runs[2].x, runs[0].x)
    assert found.score(found.best) <= 1.05 * min(map(found.score, found.made))


def test_criteria_are_words_or_names():
    with pytest.raises(ob.SimulationError, match="it takes faults, states, all or names of e1, h2"):
        ob.choose(PLANT, criterion="width", methods=[])
    record = ob.records.three_tank_leak()
    for given, counted in [("states", 3), ("all", 4), ("leak", 1), (["h2", "leak"], 2)]:
        found = ob.choose(PLANT, record, criterion=given, methods=[])
        assert len(found.criterion) == counted


def test_a_record_takes_the_place_of_the_simulation():
    """Mutants: the truth of a simulation kept; channels in another order taken as they come."""
    record = ob.records.three_tank_leak()
    found = ob.choose(PLANT, record, methods=[ob.IntervalObserver()], limit=None)
    assert "three_tank_leak.csv, 181 instants" in found.table.title
    assert found.tries[0].missed is None
    assert "Nothing in three_tank_leak.csv refutes the assumptions." in found.reason
    assert np.median(found.tries[0].half_widths[:, 3]) == pytest.approx(0.01585, rel=2e-3)
    broken = replace(record, y=record.y + [[0.3, 0, 0]] * (record.time == 100)[:, None])
    void = ob.choose(PLANT, broken, methods=[ob.IntervalObserver()], limit=None)
    assert "void at 1 calls, which contradicts the assumptions" in str(void.table)
    assert "The record refutes the assumptions at k = 64 (100 s): " in void.reason
    turned = replace(record, names={**record.names, "y": ("y2", "y1", "y3")})
    with pytest.raises(ob.SimulationError, match=r"y2, y1, y3 as y; .* has y1, y2, y3"):
        ob.choose(PLANT, turned)
    slow = replace(record, time=2 * record.time)
    with pytest.raises(ob.SimulationError, match=r"has 2 s from t = 72 on; .* every 1 s"):
        ob.choose(PLANT, slow)


def test_what_cannot_be_tried_is_refused():
    plant = ob.plants.cruise_control()
    with pytest.raises(ob.SimulationError, match="cruise control is a continuous plant: give Ts="):
        ob.choose(plant)
    with pytest.raises(ob.SimulationError, match="sampled every 1 s: leave Ts out"):
        ob.choose(PLANT, Ts=1.0)
    drifts = ob.plants.pmsm_dq()
    with pytest.raises(ob.SimulationError, match="PMSM in dq leaves its box within 25 samples"):
        ob.choose(drifts, Ts=0.05)


def test_a_bug_in_one_method_is_told_and_the_others_go_on(monkeypatch):
    def breaks(self, model, bounds=None, at=None):
        raise ZeroDivisionError("float division")

    monkeypatch.setattr(ob.HinfUIO, "design", breaks)
    found = ob.choose(PLANT, ob.records.three_tank_leak(), methods=[ob.HinfUIO()], limit=None)
    assert found.tries[0].reason == "ZeroDivisionError: float division"


@pytest.mark.long
@pytest.mark.parametrize("name", TIMES)
def test_the_gallery_has_a_table_in_under_five_minutes(name):
    start = time.perf_counter()
    found = ob.choose(getattr(ob.plants, name)(), Ts=TIMES[name])
    assert time.perf_counter() - start < 300
    made = found.made
    assert made and all(one.missed == 0.0 and not one.run.domain.voids for one in made)
    n, half = len(found.model.x), 0.5 * np.diff(found.model.box("f"), axis=1)[:, 0]
    kept = [one.half_widths[len(one.half_widths) // 2 :, n:] for one in made]
    widths = [rows.mean(axis=0) / half for rows in kept]
    mine = made.index(found.best)
    assert widths[mine].mean() <= 1.05 * min(w.mean() for w in widths)
    assert not any("Error:" in one.reason for one in found.tries)


def turning(nominal, middle):
    """States that turn about a middle, slowly coming nearer."""
    plant = ob.Plant("turning")
    a, b = plant.states("a b", range=[(-1, 1)] * 2, nominal=nominal)
    (f,) = plant.faults("f", range=(-0.01, 0.01), rate=0.001)
    c, s = 0.99 * np.cos(0.5), 0.99 * np.sin(0.5)
    da, db = a - middle, b - middle
    plant.dynamics({a: middle + c * da - s * db + f, b: middle + s * da + c * db}, Ts=1)
    plant.outputs([a, b])
    return plant


def test_the_common_run_is_where_the_plant_rests():
    """Mutants: about nominal values alone; about a point of rest where those would do."""
    few = [ob.IntervalObserver()]
    found = ob.choose(turning([-0.5, -0.5], 0.6), methods=few)
    assert found.kalman.run.scenario == "gentle 0" and len(found.kalman.run.t) == 1001
    assert np.abs(found.kalman.run.x[0] - 0.6).max() < 0.06
    held = ob.choose(turning([0.55, 0.55], 0.6), methods=few)
    assert np.abs(held.kalman.run.x[0] - 0.55).max() < 0.051 and held.kalman.run.x[0, 0] < 0.59
    with pytest.raises(ob.SimulationError, match=r"25 samples .*rests outside the range.*a = 1\.7"):
        ob.choose(turning([0.0, 0.0], 1.7), methods=few)
