"""What a simulation is given, checked: the scenario's signals and the observer's functions."""

import math
from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from obsynth.designs.core.observer import FURTHER_OUTPUTS, STEP_OUTPUTS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.designs.detection.observed import core_of
from obsynth.evaluate.domain import outside_box
from obsynth.evaluate.errors import SimulationError
from obsynth.symbolic import Plant, Scenario
from obsynth.symbolic.arrays import FloatArray


def scenario_fields(model: Plant, scenario: Scenario, seed: int) -> dict[str, FloatArray]:
    """Return the scenario's signals as arrays of N + 1 samples; no u in a feedback."""
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise SimulationError(f"seed={seed!r} is not a whole number from 0 on.", seed=seed)
    arrays = scenario.arrays(model, int(seed)).items()
    return {key: np.array(value) for key, value in arrays if value is not None}


def vector(value: Any, names: tuple[str, ...], word: str) -> FloatArray:
    """Return a finite vector with one number for each name."""
    row: FloatArray = np.asarray(value, dtype=float)
    if row.shape != (len(names),):
        raise SimulationError(
            f"{word} has shape {row.shape}; one number for each of "
            f"{', '.join(names) or 'no signal'} is needed.",
            field=word,
            shape=row.shape,
        )
    for name, number in zip(names, row.tolist(), strict=True):
        if not math.isfinite(number):
            raise SimulationError(
                f"{word}: {name} is {number}, no finite number.", field=word, symbol=name
            )
    return row


def finite(values: FloatArray, names: tuple[str, ...]) -> None:
    """Refuse a truth that is no number any more, with its first instant."""
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        k, i = (int(v) for v in bad[0])
        raise SimulationError(
            f"the truth is no number any more: {names[i]} is {values[k, i]} at k = {k}. The plant "
            "has left the region in which its equations are defined; check the scenario's inputs "
            "and faults, or shorten it.",
            symbol=names[i],
            instant=k,
        )


def state_box(observer: Observer | FaultDetector) -> FloatArray:
    """Return the ranges of the states, (n, 2): a region of the design, else those declared."""
    box: FloatArray = np.asarray(observer.model.box("x"), dtype=float)
    core = core_of(observer)
    region = None if core is None else core.domain
    return box if region is None else np.where(np.isfinite(region), region, box)


def broken_assumptions(
    observer: Observer | FaultDetector, scenario: Scenario, truths: Mapping[str, FloatArray]
) -> tuple[str, ...]:
    """Say which ranges and rates of the observer's discrete model a run did not keep.

    truths: (N + 1, n) each; rates have a slack of 1e-9, as sampled ramps carry rounding errors.
    """
    model = observer.model
    said = outside_box(truths["x"], state_box(observer), model.names("x"), "range")
    for group in ("w", "d", "u", "f", "rho"):
        said += outside_box(truths[group], model.box(group), model.names(group), "range")
    said += outside_box(truths["y"], model.output_ranges, model.output_names, "sensor's range")
    faults = truths["f"]
    for i, signal in enumerate(model.f):
        steps = np.abs(np.diff(faults[:, i]))
        limit = np.inf if signal.rate is None else signal.rate * (1 + 1e-9)
        fast = np.flatnonzero(steps > limit)
        if fast.size:
            k = int(fast[0])
            said.append(
                f"{signal.name} moves by {steps[k]:.6g} from k = {k} to {k + 1}; its declared "
                f"rate is {signal.rate:g} per step, exceeded {fast.size} times, by at most "
                f"{steps.max() - signal.rate:.4g}"
            )
    start = np.zeros((len(model.f), 2)) if scenario.f_range is None else scenario.f_range
    said += outside_box(faults[:1], start, model.names("f"), "assumed initial range")
    if scenario.x_range is not None:
        x0 = np.asarray(scenario.x0, dtype=float).reshape(1, -1)
        said += outside_box(x0, scenario.x_range, model.names("x"), "assumed initial range")
    return tuple(said)


def step_function(observer: Observer | FaultDetector, model: Plant) -> ca.Function:
    """Return the observer's step once its inputs and outputs are known to fit the model."""
    step: ca.Function = observer.step
    scheduling_columns(step, model, "step")
    # what follows the memory is what is read; the memory itself only goes back into the step
    if tuple(step.name_out())[1:] not in [(*STEP_OUTPUTS[1:], *more) for more in FURTHER_OUTPUTS]:
        raise SimulationError(
            f"the observer's step returns ({', '.join(step.name_out())}); "
            f"({', '.join(STEP_OUTPUTS)}[, alarm[, mean_lower, mean_upper, mean_status]]) is "
            "needed.",
            given=tuple(step.name_out()),
        )
    return step


def claims_of(step: ca.Function, log: FloatArray) -> dict[str, FloatArray]:
    """Take what a step returned behind its memory, a row for each instant, apart by name."""
    ends = np.cumsum([step.numel_out(i) for i in range(1, step.n_out() - 1)])
    return dict(zip(step.name_out()[1:], np.split(log, ends, axis=1), strict=True))


def scheduling_columns(function: ca.Function, model: Plant, word: str) -> list[int]:
    """Return which scheduling signals step or ode reads; refuse inputs that do not fit."""
    columns = [i for i, signal in enumerate(model.rho) if signal.measured]
    columns = columns if "theta" in function.name_in() else []
    sizes = (function.numel_in(0), len(model.u), len(model.output_names), len(columns))
    names = ("memory", "u", "y", *(["theta"] if columns else []))
    found = ((name, function.numel_in(name)) for name in function.name_in())
    pairs = found, zip(names, sizes, strict=False)
    given, wanted = (", ".join(f"{name}: {size}" for name, size in part) for part in pairs)
    if given != wanted:
        raise SimulationError(
            f"the observer's {word} takes ({given}) numbers; ({wanted}) are needed.", given=given
        )
    return columns


def first_memory(
    observer: Observer | FaultDetector, scenario: Scenario, y0: FloatArray, size: int
) -> FloatArray:
    """Return what the observer remembers before the first step."""
    memory: FloatArray = np.asarray(
        observer.memory0(
            scenario.guess, x_range=scenario.x_range, f_range=scenario.f_range, y0=y0.copy()
        ),
        dtype=float,
    )
    if memory.shape != (size,):
        raise SimulationError(
            f"the observer's memory0 has shape {memory.shape}; its step takes {size} numbers.",
            field="memory0",
        )
    return memory


def refuse_algebraic_loop(scenario: Scenario, plant: Plant) -> None:
    """Refuse a feedback (k, y) where y depends on the inputs of the same instant."""
    pattern: Any = np.array(ca.DM(plant.function().sparsity_jac(1, 1)), dtype=bool)
    if pattern.any():
        row, column = (int(v) for v in np.argwhere(pattern)[0])
        name = plant.names("u")[column]
        raise SimulationError(
            f"the inputs of scenario {scenario.name!r} are a function of (k, y), but output "
            f"{plant.output_names[row]} depends on {name} at the same instant: that is an "
            "algebraic loop. Give the inputs as an array or a function of k.",
            output=plant.output_names[row],
            symbol=name,
        )
