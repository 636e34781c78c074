"""What is said of alarms and faults, for numbers by hand and against plain loops."""

import numpy as np
import pytest

from obsynth.designs.core.observer import STATUS
from obsynth.designs.detection.comparison import Void, _first_run, compare, find_voids, stretches

VOID, RECOVERING = STATUS["void"], STATUS["recovering"]


def runs(there):
    found, since = [], None
    for k, bit in enumerate([*there, False]):
        if bit and since is None:
            since = k
        if not bit and since is not None:
            found.append((since, k - 1))
            since = None
    return found


@pytest.mark.parametrize("seed", range(20))
def test_stretches_and_first_runs_are_those_of_loops(seed):
    there = np.random.default_rng(seed).random(30) < 0.6
    assert stretches(there) == runs(there)
    for length in (1, 2, 3, 5, 40):
        complete = [k for k in range(30) if k + 1 >= length and there[k + 1 - length : k + 1].all()]
        assert _first_run(there, length) == (complete[0] if complete else None)


@pytest.mark.parametrize("seed", range(20))
def test_violations_last_from_the_first_void_to_the_last_recovering_instant(seed):
    """Recovering instants without a void one before them are none."""
    rng = np.random.default_rng(seed)
    status = rng.choice([0, 0, 0, 32, VOID, VOID + 32, RECOVERING, RECOVERING + 4], 40)
    wanted = []
    for first, until in runs([word & (VOID | RECOVERING) != 0 for word in status]):
        at = [k for k in range(first, until + 1) if status[k] & VOID]
        wanted += [Void(at[0], at[-1], len(at), until)] if at else []
    assert find_voids(status) == tuple(wanted)


@pytest.fixture
def run():
    """Instants 0 to 11; f is there from 3 to 6, told one call late; g never is."""
    truth, alarm, status = np.zeros((12, 2)), np.zeros((12, 2), dtype=bool), np.zeros(12, dtype=int)
    truth[3:7, 0] = [2.0, 2.5, -3.0, 1.0]
    alarm[5:9, 0] = alarm[5, 1] = True
    return {
        "alarm": alarm,
        "truth": truth,
        "t": 0.1 * np.arange(12),
        "names": ("f", "g"),
        "fault_delay": 1,
        "threshold": 0.0,
        "width": np.full((12, 2), 1.5),
        "valid": np.arange(12) != 4,
        "status": status,
        "persistence": (2, 1),
    }


def test_an_event_by_hand(run):
    """Promised after two samples that count: 5 and 6, which speak of 4 and 5."""
    found = compare(**run)
    (event,) = found.events
    assert (event.fault, event.onset, event.end, event.peak) == ("f", 3, 6, 3.0)
    assert (event.promised, event.alarm, event.level, event.others) == (6, 5, 2.5, ("g",))
    assert event.delay == pytest.approx(0.2)
    assert event.violation is None and not event.isolated
    assert found.false_alarms == {"f": 0, "g": 1}
    assert found.lingering == {"f": 1, "g": 0}
    assert found.before_violation == {"f": 0, "g": 0}
    assert found.violations == () and found.missed == ()
    assert found.delays == {"f": pytest.approx(0.2)}


def test_what_is_promised_needs_samples_that_count(run):
    """As many as the alarm takes, above the width, one behind the other; a void one ends them."""
    assert compare(**run | {"width": None}).events[0].promised is None
    assert compare(**run | {"width": np.full((12, 2), 2.6)}).events[0].promised is None
    assert compare(**run | {"persistence": (3, 1)}).events[0].promised is None
    assert compare(**run | {"valid": np.ones(12, dtype=bool)}).events[0].promised == 5
    status = np.where(np.arange(12) == 5, VOID, 0)
    gone = {"status": status, "valid": (status & VOID == 0) & run["valid"]}
    assert compare(**run | gone).events[0].promised is None
    assert compare(**run | gone | {"persistence": (1, 1)}).events[0].promised == 6


def test_alarms_until_a_void_instant_prove_nothing(run):
    """All of their samples, from the first on. Mutants: the last alone; voids elsewhere."""
    status = np.zeros(12, dtype=int)
    status[9], status[10] = VOID, RECOVERING
    found = compare(**run | {"status": status})
    assert found.before_violation == {"f": 4, "g": 0}
    assert found.events[0].violation == 9
    assert found.violations == (Void(9, 9, 1, 10),)
    status[9], status[11] = 0, VOID
    found = compare(**run | {"status": status})
    assert found.before_violation == {"f": 0, "g": 0}
    assert found.events[0].violation is None
    assert found.violations == (Void(11, 11, 1, 11),)


def test_a_fault_without_an_alarm_is_missed_and_small_ones_are_none(run):
    quiet = compare(**run | {"alarm": np.zeros((12, 2), dtype=bool)})
    (event,) = quiet.missed
    assert (event.alarm, event.delay, event.promised) == (None, None, 6)
    assert quiet.delays == {"f": None}
    small = compare(**run | {"threshold": 2.2})
    assert [(e.onset, e.end) for e in small.events] == [(4, 5)]
    assert small.events[0].delay == pytest.approx(0.1)
    late = compare(**run | {"fault_delay": 0})
    assert late.events[0].level == 3.0
    assert late.lingering == {"f": 2, "g": 0}
