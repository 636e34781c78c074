"""An observer's functions behind buffers, checked against the plant that they are called for."""

from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import ALARM_OUTPUT, STEP_OUTPUTS
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.interface import StepObserver
from obsynth.symbolic import Plant, Scenario

Array = NDArray[np.float64]

_INPUTS = ("memory", "u", "y")


def step_function(observer: StepObserver, model: Plant) -> ca.Function:
    """Return the observer's step once its inputs and outputs are known to fit the model."""
    step: ca.Function = observer.step
    scheduling_columns(step, model, "step")
    # CasADi accepts one name on both sides only on request, so the first output is left free.
    if tuple(step.name_out())[1:] not in (STEP_OUTPUTS[1:], (*STEP_OUTPUTS[1:], ALARM_OUTPUT)):
        raise SimulationError(
            f"the observer's step returns ({', '.join(step.name_out())}); "
            f"({', '.join(STEP_OUTPUTS)}[, {ALARM_OUTPUT}]) is needed.",
            given=tuple(step.name_out()),
        )
    return step


def scheduling_columns(function: ca.Function, model: Plant, word: str) -> list[int]:
    """Return which scheduling signals step or ode reads; refuse inputs that do not fit."""
    given = tuple(function.name_in())
    if given[:3] != _INPUTS or given[3:] not in ((), ("theta",)):
        raise SimulationError(
            f"the observer's {word} takes ({', '.join(given)}); (memory, u, y[, theta]) is needed.",
            given=given,
        )
    measured = [i for i, signal in enumerate(model.rho) if signal.measured]
    columns = measured if len(given) == 4 else []
    counts = {"u": len(model.u), "y": len(model.output_names), "theta": len(columns)}
    for i, name in enumerate(given[1:], start=1):
        if function.numel_in(i) != counts[name]:
            raise SimulationError(
                f"the observer's {word} takes {function.numel_in(i)} numbers as {name}; the model "
                f"has {counts[name]}.",
                field=name,
            )
    return columns


def first_memory(observer: StepObserver, scenario: Scenario, y0: Array, size: int) -> Array:
    """Return what the observer remembers before the first step."""
    memory: Array = np.asarray(
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
