"""Campaigns: the rows are those of single runs, intervals, folders that go on, clusters."""

import os
import signal
import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

import obsynth as ob
from obsynth.evaluate.campaigns.campaign import interval
from obsynth.evaluate.campaigns.parts import Parts, facts


@pytest.fixture(scope="module")
def car():
    return ob.plants.cruise_control().discretise("euler", Ts=0.1)


@pytest.fixture(scope="module")
def observer(car):
    return ob.BoundedErrorUIO(bounds="peak").design(car)


@pytest.fixture(scope="module")
def scenario(car):
    gentle = ob.scenarios.gentle(car, steps=200)
    faults = np.where(np.arange(201) < 50, 0.0, 0.003 * np.arange(-50, 151))[:, None]
    return replace(gentle, name="ramp", faults=faults, f_range=[[-0.5, 0.5]])


def test_rows_are_those_of_runs(car, observer, scenario):
    detector = ob.FaultDetector(observer)
    found = ob.campaign({"a": observer, "b": detector}, scenario, seeds=[4, 7], workers=1)
    assert [(row["design"], row["seed"]) for row in found.rows] == [
        ("a", 4),
        ("a", 7),
        ("b", 4),
        ("b", 7),
    ]
    run = ob.simulate(car, detector, scenario, seed=7)
    told = found.rows[3]
    assert {key: told[key] for key in facts(run)} == facts(run)
    late = slice(100, None)
    assert told["f: half width"] == run["f"].half_width[late].mean()
    assert told["f: rms error"] == pytest.approx(run.rms(100)["f"], rel=1e-12)
    assert told["f: missed"] == 0 and told["kept"] and told["refused"] == ""
    void = replace(run, status=run.status | np.where(np.arange(201) == 9, 8, 0))
    assert facts(void)["void"] == 1 and not facts(void)["kept"]
    raised = np.flatnonzero(run.alarm[:, 0])
    assert told["f: delay"] == raised[0] - 51 and told["f: false alarms"] == 0
    assert "f: delay" not in found.rows[0]
    table, alarms = found.table(), found.alarms()
    assert [row[3:6] for row in table.rows] == [[2, 2, "100 %"]] * 2
    assert alarms.rows[0][3:6] == ["f", 2, 0] and alarms.rows[0][6] == "2 of 2"


def test_a_truth_that_breaks_the_promise_is_seen(car, observer, scenario):
    """Its runs do not keep the assumptions, and are counted apart."""
    wild = car.with_ranges({"w1": (-2, 2)})
    drawn = replace(scenario, disturbances=None)  # from the ranges of the truth
    found = ob.campaign(observer, drawn, 3, truth={"own": car, "wild": wild}, workers=1)
    own, other = found.table().rows
    assert own[4:6] == [3, "100 %"] and other[4] == 0 and other[5] == "n/a"
    missed = [row["v: missed"] + row["f: missed"] + row["void"] for row in found.rows[3:]]
    assert min(missed) > 0


def test_a_miss_and_a_false_alarm_are_counted(car, observer, scenario):
    """Mutants: every kept run held; alarms before the fault not counted."""
    found = ob.campaign(ob.FaultDetector(observer), scenario, 2, workers=1)
    first, second = found.rows
    spoilt = replace(found, rows=({**first, "f: missed": 1, "f: false alarms": 2}, second))
    assert spoilt.table().rows[0][4:6] == [2, "50.00 %"]
    assert spoilt.alarms().rows[0][5] == 1
    run = ob.simulate(car, ob.FaultDetector(observer), scenario)
    alarm = np.ones_like(run.alarm)
    assert facts(replace(run, alarm=alarm))["f: false alarms"] == 51


def test_intervals_of_clopper_and_pearson():
    """Numbers of the two tails, 1 - (a/2)^(1/n) and the quantiles of the beta distribution."""
    assert interval(20, 20) == (pytest.approx(0.025 ** (1 / 20)), 1.0)
    assert interval(0, 20) == (0.0, pytest.approx(1 - 0.025 ** (1 / 20)))
    low, high = interval(7, 10)
    assert binom.sf(6, 10, low) == pytest.approx(0.025) == binom.cdf(7, 10, high)


def test_a_campaign_goes_on(tmp_path, observer, scenario, monkeypatch):
    """Rows that are there and run again would be counted here."""
    folder, ran = tmp_path / "runs", []
    original = ob.simulate

    def counted(plant, observer, scenario, seed, substeps=None):
        ran.append(seed)
        if seed == 2 and len(ran) == 3:
            raise KeyboardInterrupt
        return original(plant, observer, scenario, seed, substeps=substeps)

    monkeypatch.setattr("obsynth.evaluate.campaigns.parts.simulate", counted)
    monkeypatch.setattr("obsynth.evaluate.campaigns.campaign._TOGETHER", 201)
    with pytest.raises(KeyboardInterrupt):
        ob.campaign(observer, scenario, 4, folder=folder, workers=1)
    assert len(list(folder.glob("part-*.parquet"))) == 2
    found = ob.campaign(observer, scenario, 4, folder=folder, workers=1)
    assert ran == [0, 1, 2, 2, 3]
    again = ob.campaign(observer, scenario, 4, folder=folder, workers=1)
    assert len(ran) == 5
    drop = {"seconds"}
    assert [{k: v for k, v in r.items() if k not in drop} for r in again.rows] == [
        {k: v for k, v in r.items() if k not in drop} for r in found.rows
    ]
    with pytest.raises(ob.SimulationError, match="another scenario ramp"):
        ob.campaign(observer, replace(scenario, guess=scenario.guess + 1), 4, folder=folder)
    with pytest.raises(ob.ObsynthError, match="no campaign"):
        ob.campaign(observer, scenario, 1, folder=tmp_path)


def test_refusals(observer, scenario):
    with pytest.raises(ob.SimulationError, match="two scenarios are called 'ramp'"):
        ob.campaign(observer, [scenario, scenario], 1)
    with pytest.raises(ob.PlantError, match="2 initial states"):
        ob.campaign(observer, replace(scenario, x0=[0.0, 0.0], guess=[0.0, 0.0]), 1)
    with pytest.raises(ob.SimulationError, match="a seed at least"):
        ob.campaign(observer, scenario, [])


def test_a_run_that_is_refused_is_a_row(observer, scenario, monkeypatch):
    def refuses(*args, **keywords):
        raise ob.SimulationError("the truth is no number")

    monkeypatch.setattr("obsynth.evaluate.campaigns.parts.simulate", refuses)
    found = ob.campaign(observer, scenario, 1, workers=1)
    assert found.rows[0]["refused"] == "the truth is no number" and not found.rows[0]["kept"]
    assert "1 runs were refused" in found.table().note


@pytest.mark.long
def test_processes_give_the_same(observer, scenario, monkeypatch):
    monkeypatch.setattr("obsynth.evaluate.campaigns.campaign._TOGETHER", 201)
    one = ob.campaign(observer, scenario, 3, workers=1).to_frame()
    two = ob.campaign(observer, scenario, 3, workers=2).to_frame()
    assert one.drop(columns="seconds").equals(two.drop(columns="seconds"))


@pytest.mark.long
def test_a_worker_that_is_killed_half_way_loses_nothing(tmp_path, observer, scenario, monkeypatch):
    from distributed import Client, LocalCluster

    monkeypatch.setattr("obsynth.evaluate.campaigns.campaign._TOGETHER", 201)
    longer = replace(ob.scenarios.gentle(observer.model, steps=5_000), name="long")
    seen, original = [], Parts.add
    cluster = LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None)
    with cluster, Client(cluster) as client:
        workers = list(client.run(os.getpid).values())

        def add(self, rows):
            seen.extend(row["seed"] for row in rows)
            if len(seen) == 2:
                os.kill(workers[0], signal.SIGKILL)
                time.sleep(0.1)
            original(self, rows)

        monkeypatch.setattr(Parts, "add", add)
        found = ob.campaign(observer, longer, 8, folder=tmp_path / "runs", client=client)
    assert sorted(seen) == list(range(8))
    assert [row["seed"] for row in found.rows] == list(range(8))
    assert len(list((tmp_path / "runs").glob("part-*.parquet"))) == 8
    one = ob.campaign(observer, longer, [7], workers=1).rows[0]
    assert {k: v for k, v in found.rows[7].items() if k in one and k != "seconds"} == {
        k: v for k, v in one.items() if k != "seconds"
    }
