"""That results are numbers in order is proved of the tape, and held to NaN at every instruction."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from methods import METHODS, observer_of
from obsynth.codegen.description import describe
from obsynth.codegen.drive import Drive
from obsynth.codegen.kernel import DOUBLE, RESULTS, Machine
from obsynth.codegen.lanes import Lanes
from obsynth.codegen.numbers import prove_numbers
from obsynth.codegen.tape import read_tape

WITHOUT_SETS = {"general_uio.l2", "hinf_uio"}
QUICK = {"luenberger", "qpv_observer", "hinf_uio", "general_uio.l2"}
ALL = [n if n in QUICK else pytest.param(n, marks=pytest.mark.long) for n in (*METHODS, "detector")]
STEPS = 30
HANDED_ON = {"choose", "if_else_zero", "fmax", "fmin", "fabs", "neg", "sign", "floor", "ceil"}
"""Operations that give a NaN only where they are given one: none begins there."""


def observer_for(name):
    if name != "detector":
        return observer_of(name)
    return ob.FaultDetector(observer_of("bounded_error_uio"), persistence=3, window=5)


@pytest.mark.parametrize("name", ALL)
def test_results_are_numbers_in_order_whatever_bits(name):
    """Of every method, in both precisions. Mutants: see below."""
    designs = [observer_for(name)]
    if name not in {"detector", "hinf_uio", "qpv_observer"}:
        method = replace(METHODS[name].method, precision="single")
        designs.append(method.design(METHODS[name].plant()))
    for observer in designs:
        told = prove_numbers(*read_tape(observer.step, describe(observer).real))
        assert told.unproved == ()
        assert set(told.quiet) == ({"xhat", "fhat"} if name in WITHOUT_SETS else set())
        assert {"x_lower", "x_upper"} <= set(told.always)


@pytest.mark.parametrize("name", ALL)
def test_no_value_that_becomes_none_comes_out(name):
    """A NaN in place of every value that arithmetic gives, one at a time, at steps in service.

    Mutant: a set that is no number as a set, `Ends.empty` by `lower > upper`.
    """
    observer = observer_for(name)
    description = describe(observer)
    lanes = Lanes(description.observer.step, DOUBLE)
    places = [k for k, v in enumerate(lanes.values) if v.nan and v.name not in HANDED_ON]
    assert len(places) > 100
    drive, step = Drive(description, np.random.default_rng(0)), Machine(observer.step)
    begun = drive.begin(STEPS)
    memory = description.start if begun is None else begun
    quiet = 0
    for k in range(STEPS):
        inputs = drive.sample(k)
        if k % 7 == 5:
            out = spoilt(lanes, places, [memory, *inputs])
            for lower in (key for key in out if key[0].endswith("_lower")):
                upper = lower[0].replace("_lower", "_upper"), lower[1]
                assert np.all(out[lower] <= out[upper]), lower
            healthy = out["status", 0] == 0
            quiet += int(healthy.sum())
            assert not any(np.isnan(value[healthy]).any() for value in out.values())
        memory = step(memory, *inputs)[0]
    assert quiet > 0 or name == "qpv_observer"


def spoilt(lanes, places, given):
    """Results of a step, a lane for each place with a NaN there; without the next memory."""
    found = []
    with np.errstate(all="ignore"):
        for k, value in enumerate(lanes.values):
            if value.name == "input":
                row = np.full(len(places), given[value.place[0]][value.place[1]])
            elif value.name == "const":
                row = np.full(len(places), value.number)
            else:
                row = lanes._table[value.name](*(found[p] for p in lanes.places[k]))
            if k in places:
                row = np.array(row, dtype=float)
                row[np.searchsorted(places, k)] = np.nan
            found.append(row)
    told = {(RESULTS[port], i): found[k] for port, i, k in lanes.results}
    return {key: row for key, row in told.items() if key[0] not in {"next", "mean_status"}}


def toy(change):
    """A step that returns [a, b] where it is in order, and a guess inside of it."""
    a, b, guess, sound = (ca.SX.sym(s) for s in ("a", "b", "guess", "sound"))
    void = ca.logic_not(a <= b)
    results = {
        "x": (ca.if_else(void, -1.0, a), ca.if_else(void, 1.0, b)),
        "xhat": ca.if_else(ca.fabs(guess) <= 9.0, guess, 0.0),
        "fhat": guess * sound,
        "status": 8 * void + 16 * ca.logic_not(ca.fabs(guess * sound) <= 9.0),
    }
    results |= change(a, b, guess, void)
    memory = ca.vertcat(a, b, guess, sound)
    x, empty = results["x"], ca.SX(0, 1)
    told = [memory, results["xhat"], results["fhat"], *x, empty, empty, results["status"]]
    return ca.Function("step", [memory], told)


ENDS = ("x_lower", "x_upper")
BROKEN = {
    "nothing": (lambda a, b, guess, void: {}, ("fhat",), ()),
    "a NaN passes": (
        lambda a, b, guess, void: {"x": (ca.if_else(a > b, -1, a), ca.if_else(a > b, 1, b))},
        ("fhat", *ENDS),
        (),
    ),
    "one end": (
        lambda a, b, guess, void: {"x": (ca.if_else(void, -1, a), b)},
        ("fhat", *ENDS),
        (),
    ),
    "wrong order": (
        lambda a, b, guess, void: {"x": (ca.if_else(void, 1, a), ca.if_else(void, -1, b))},
        ("fhat", *ENDS),
        (),
    ),
    "exchanged": (
        lambda a, b, guess, void: {"x": (ca.if_else(void, -1, b), ca.if_else(void, 1, a))},
        ("fhat",),
        ENDS,
    ),
    "sum": (
        lambda a, b, guess, void: {"x": (ca.if_else(void, -1, a), ca.if_else(void, 1, a + b))},
        ("fhat",),
        ENDS,
    ),
    "not looked at": (lambda a, b, guess, void: {"xhat": guess}, ("fhat",), ("xhat",)),
    "a comparison that a NaN fails": (
        lambda a, b, guess, void: {"xhat": ca.if_else(guess > 9.0, 0.0, guess)},
        ("fhat",),
        ("xhat",),
    ),
    "one case of two": (
        lambda a, b, guess, void: {"xhat": ca.if_else(a <= b, guess, 1.0)},
        ("fhat",),
        ("xhat",),
    ),
    "no bit": (lambda a, b, guess, void: {"status": 8 * void}, (), ("fhat",)),
}


@pytest.mark.parametrize("name", BROKEN)
def test_what_is_not_so_is_not_proved(name):
    """Mutants: a comparison that fails as a fact, one case of a choice, any status as 0."""
    change, quiet, unproved = BROKEN[name]
    told = prove_numbers(*read_tape(toy(change), DOUBLE))
    assert (set(told.quiet), set(told.unproved)) == (set(quiet), set(unproved))
