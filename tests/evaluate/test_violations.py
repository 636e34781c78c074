"""What observers say after an assumption was broken: never again status 0 with a wrong set.

`benchmarks/violations.py` is the long campaign over the same cases.
"""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
from violations import (
    CALM,
    CASES,
    KINDS,
    SETTLED,
    Count,
    Record,
    Trials,
    campaign,
    case_of,
    counted,
    record,
    trials,
)


@functools.cache
def few(name):
    """Four trials of each kind."""
    given = trials(case_of(name), 4)
    return given, record(case_of(name), given)


def assert_nothing_is_forgotten(found):
    for kind, count in found.items():
        assert (count.unbroken, count.after, count.late) == (0, 0, 0), (kind, count)


@pytest.mark.parametrize("name", [name for name in CASES if name != "set_membership"])
def test_no_violation_is_forgotten(name):
    """Mutant: a guard that keeps its sets where they are empty, or starts anew too narrow."""
    assert_nothing_is_forgotten(counted(case_of(name), *few(name)))


@pytest.mark.long
@pytest.mark.parametrize("name", CASES)
def test_no_violation_is_forgotten_long(name):
    assert_nothing_is_forgotten(campaign(name, 60, seed=20_000))


@pytest.mark.parametrize("name", CASES)
def test_nothing_is_wrong_before(name):
    """The sets hold the truth until something is broken; else a trial says nothing of violations.

    Mutants: noise of the truth beyond its bounds, a set that is compared an instant late.
    """
    given, seen = few(name)
    found = counted(case_of(name), given, seen)
    assert set(found) <= {*KINDS, CALM}
    assert all(count.unbroken == 0 for count in found.values())
    # most trials break something that ends, and the truth stays a number to the end
    assert sum(count.lasting for count in found.values()) <= len(given.kinds) / 4
    assert np.isfinite(seen.x).all()


@pytest.mark.parametrize("name", CASES)
def test_calm_sets_are_as_narrow_as_promised(name):
    """All half widths of calm trials, from N calls on, against `Observer.half_widths`.

    Mutant: half widths of the core below what it proves.
    """
    given, seen = few(name)
    calm = [b for b, kind in enumerate(given.kinds) if kind == CALM]
    width = np.concatenate([seen.x_upper - seen.x_lower, seen.f_upper - seen.f_lower], axis=2)
    promised = case_of(name).observer.half_widths
    if promised is not None:
        settled = 0.5 * width[case_of(name).window :, calm].max(axis=(0, 1))
        assert (settled <= promised * (1 + 1e-9)).all()


def test_the_counts():
    """By hand: N = 3, one violation at k = 160..161, sets that miss the truth where `wrong` says.

    Mutants: `flag` from the violation's start, any bit for a flag, `late` from N on, `bad` at any
    status, a bound that is no number taken for right.
    """
    K = SETTLED + 40
    kinds = ("glitch",) * 4 + ("burst", "drop-out", CALM)
    broken, status, miss = (np.zeros((K, len(kinds)), dtype=t) for t in (bool, int, bool))
    broken[160:162, :4] = True
    miss[[159, 160, 161, 162, 165, 168], 0] = True  # nobody says anything
    miss[[161, 163, 164], 1] = True
    status[[160, 163], 1] = 8  # one flag before the end, one behind it
    miss[[161, 162], 2] = True
    status[162:166, 2] = [32, 64, 80, 96]  # left out, no fault yet, recovering
    status[161, 3] = 4
    miss[161, 3] = True  # flagged, so not counted
    status[170, 3] = 64
    miss[5, 4] = True  # nothing was broken in this one
    glitch = np.zeros((K, len(kinds), 1))
    glitch[160:164, 5] = np.nan
    lower, upper = np.zeros((K, len(kinds), 1)), np.ones((K, len(kinds), 1))
    lower[162:166, 5] = -5
    x = np.where(miss, 2.0, 0.5)[:, :, None]
    upper[164, 1], x[164, 1] = np.nan, 0.5
    none = np.zeros((K, len(kinds), 0))
    seen = Record(x, none, status, lower, upper, none, none, broken)
    given = Trials(kinds, glitch, glitch, none, none)
    case = SimpleNamespace(observer=SimpleNamespace(fault_delay=0), means=(), window=3)
    found = counted(case, given, seen)
    assert found["glitch"] == Count(
        4,
        unbroken=1,
        after=1,
        late=1,
        before=1,
        never=6,
        longest=7,
        flagged=2,
        recovery=(4.5, 10),
        lasting=0,
    )
    assert found["burst"] == Count(1, 1, 0, 0, 0, 0, 0, 0, (0.0, 0), 0)
    assert found["drop-out"].recovery == (3.0, 3)
