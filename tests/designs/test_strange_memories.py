"""Whatever memory a caller hands in: what no step can have written is void or not initialised."""

import functools
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from methods import METHODS, observer_of, run_of
from obsynth.codegen.kernel import Machine
from obsynth.designs.bounded_error import step as bounded_error
from obsynth.designs.bounded_error.step import memory_sizes, running_bound
from obsynth.designs.core.boxes import Ends
from obsynth.designs.core.guard import YOUNG
from obsynth.designs.core.observer import STATUS

NONNEGATIVE = ("bound", "level", "clock")
"""Below zero; the clock even after the count of a call."""
STRANGE = (np.nan, np.inf, -np.inf, -1.0, 1e300, -1e300, 0.0, 2.0, 0.5, 1e80, -1e-3)
NO_NUMBER = (np.nan, np.inf, -np.inf)
WARM, AFTER = 30, 3


def watched(name):
    """The method's observer, or a detector with everything that it may remember."""
    observer = observer_of(name)
    if not METHODS[name].detects:
        return observer
    detector = ob.FaultDetector(observer, persistence=3)
    return detector if detector._of_mean else ob.FaultDetector(observer, 3, window=3)


@functools.cache
def visited(name, alone=False):
    """The step, and what it was given at some calls of the run; of the observer alone, if asked."""
    observer, run = observer_of(name) if alone else watched(name), run_of(name)
    step, scenario, found = Machine(observer.step), METHODS[name].scenario(), []
    memory = observer.memory0(scenario.guess)
    for k in range(WARM):
        rest = [run.u[k], run.y[k], *([run.rho[k]] if observer.step.n_in() > 3 else [])]
        found.append([memory, *rest])
        memory = step(memory, *rest)[0]
    return observer, step, found


def told(observer, step, arguments):
    return dict(zip(observer.step.name_out(), step(*arguments), strict=True))


def twice(part):
    return part, part + YOUNG


def impossible(name, rng):
    """Yield where something was written that no step can have written, and the arguments."""
    observer, _, found = visited(name, alone=True)
    layout = observer.memory_layout
    for part, place in layout.items():
        if part.startswith("begin") or place.stop == place.start:
            continue
        k = int(rng.integers(3, WARM - AFTER))
        memory = found[k][0].copy()
        # a copy that begins at this call, from its sets, reads nothing else of its own
        memory[[layout[p].start for p in twice("begin")]] = 0.0
        base, young = part.removesuffix(YOUNG), YOUNG * part.endswith(YOUNG)
        kinds = [np.nan] if base.endswith(("_lower", "_upper")) else NO_NUMBER
        kinds = (np.nan, -np.inf, -2.0) if base in NONNEGATIVE else kinds
        values = {"age": (np.nan, -1.0, 1e300), "since": (np.nan, -1.0, 1e300)}
        values |= {"initialised": (np.nan, np.inf, 2.0, -1.0, 0.2, 1e300)}
        for value in values.get(part, kinds):
            spoilt = memory.copy()
            spoilt[rng.integers(place.start, place.stop)] = value
            yield f"{part} = {value}", [spoilt, *found[k][1:]]
        if base.endswith("_lower"):
            spoilt, other = memory.copy(), layout[base.replace("_lower", "_upper") + young]
            i = int(rng.integers(place.stop - place.start))
            spoilt[place.start + i] = spoilt[other.start + i] + 1e-9 * (
                1.0 + abs(spoilt[other.start + i])
            )
            if np.isfinite(spoilt[place.start + i]) and abs(spoilt[place.start + i]) < 1e90:
                yield f"{part} above its upper end", [spoilt, *found[k][1:]]


@pytest.mark.parametrize("name", METHODS)
def test_what_no_step_can_have_written_is_void_or_not_initialised(name):
    """And what comes after it is what a void instant is followed by: sets that hold the state.

    Mutants: `could_be_written` without its signs or its order of ends; no limit of a counter,
    nothing asked of `before`; `initialised` without its upper limit; a core without `nonnegative`.
    """
    observer, step, found = visited(name, alone=True)
    run, shown = run_of(name), STATUS["void"] | STATUS["not_initialised"]
    for where, arguments in impossible(name, np.random.default_rng(1)):
        said = told(observer, step, arguments)
        status = int(said["status"][0])
        assert status & shown, f"{name}: {where} gives status {status}"
        if status & STATUS["not_initialised"]:
            assert where.startswith("initialised")
            np.testing.assert_array_equal(said["memory_next"], arguments[0])
            continue
        k = next(k for k in range(WARM) if found[k][1] is arguments[1])
        for later in range(k + 1, k + AFTER):
            said = told(observer, step, [said["memory_next"], *found[later][1:]])
            assert not int(said["status"][0]) & STATUS["void"], f"{name}: {where} lasts"
            assert np.isfinite(said["xhat"]).all()
            assert np.all(said["x_lower"] <= run.x[later])
            assert np.all(run.x[later] <= said["x_upper"])
        # nothing that is no number is left but ends of sets and bounds that are infinite
        assert not np.isnan(said["memory_next"]).any(), f"{name}: {where} is remembered"


@pytest.mark.parametrize("name", METHODS)
def test_no_memory_spoils_a_bound(name):
    """Mutant: `could_be_written` without its sum, which lets estimates in that are no number."""
    observer, step, found = visited(name)
    rng, layout = np.random.default_rng(2), list(observer.memory_layout.values())
    pairs = [("x", 1), ("f", 1), *([("mean", 0)] if "mean_lower" in observer.outputs else [])]
    for _ in range(150):
        arguments = [part.copy() for part in found[rng.integers(WARM)]]
        memory, place = arguments[0], layout[rng.integers(len(layout))]
        at = [slice(i, i + 1) for i in rng.integers(memory.size, size=4)]
        for i in [[place], at[:1], at][rng.integers(3)]:
            memory[i] = rng.choice(STRANGE)
        for _ in range(AFTER):
            said = told(observer, step, arguments)
            status = int(said["status"][0])
            for kind, estimated in pairs:
                wrong = ~(said[f"{kind}_lower"] <= said[f"{kind}_upper"])
                assert not wrong.any(), f"{name}: {kind} {said}, status {status}"
                assert status or not estimated or np.isfinite(said[f"{kind}hat"]).all()
            assert "alarm" not in said or np.isin(said["alarm"], (0, 1)).all()
            arguments[0] = said["memory_next"]


def test_strange_counters_count_as_none():
    """Mutants: `counter` without its lower limit, by which an alarm never comes, or its upper."""
    observer, step, found = visited("bounded_error_uio")
    n_f, layout = len(observer.model.f), observer.memory_layout
    outside, unknown = np.ones(n_f), [-np.ones(n_f), np.ones(n_f), STATUS["fault_not_valid"]]
    decide = Machine(observer.decide)
    for strange in (np.nan, np.inf, -1e300, -1.0, 4.0):
        for sets in ([outside, outside, 0.0, *unknown], [*unknown, *unknown]):
            count, alarm = decide(np.full(n_f, strange), *sets)
            assert np.all(count == (sets[0] is outside)) and not alarm.any()
        memory = found[1][0].copy()
        memory[layout["mean_count"]] = strange
        said = told(observer, step, [memory, *found[1][1:]])
        assert said["mean_status"][0] == STATUS["fault_not_valid"]
        memory = found[-1][0].copy()
        memory[layout["mean_since"]] = strange
        said = told(observer, step, [memory, *found[-1][1:]])
        assert strange == 4.0 or said["mean_status"][0] == sum(STATUS.values()) - 16


def test_a_copy_turns_at_ages_between_whole_numbers_too():
    """Mutant: `_turns` with both limits open, which an age of N - 1/2 never meets."""
    observer, step, found = visited("luenberger")
    layout, N = (
        observer.memory_layout,
        observer.certificate.contract.guard(observer.certificate.design).horizon,
    )
    for share in (0.0, 0.25, 0.5, 0.75):
        memory = found[-1][0].copy()
        memory[layout["age"]] = N - 3.0 + share
        begun = []
        for _ in range(6):
            memory = step(memory, *found[-1][1:])[0]
            begun.append(memory[layout["begin" + YOUNG]].item())
        assert sum(begun) == 1.0


def test_an_estimate_that_is_no_number_is_placed_anew_in_the_range_of_T(monkeypatch):
    """Mutant: `place` that asks whether z was moved, which no number says of itself."""
    design = observer_of("bounded_error_uio").certificate.design
    bound = running_bound(design)
    shifted = replace(design, bound=replace(design.bound, error="shifted"))
    monkeypatch.setattr(bounded_error, "running_bound", lambda given: bound)
    x, f = (Ends.of(design.plant.box(kind)) for kind in "xf")
    kept = {name: ca.SX([np.nan] * size) for name, size in memory_sizes(design).items()}
    z = np.array(ca.evalf(bounded_error.build_core(shifted).place(x, f, kept)["z"])).ravel()
    middle = design.T @ design.plant.box("x").mean(axis=1)
    np.testing.assert_allclose(z, middle, rtol=1e-12)
