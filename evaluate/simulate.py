"""Run a plant and an observer side by side through ``Observer.step``."""

from collections.abc import Callable
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.observer import STEP_OUTPUTS
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.fields import broken_assumptions, finite, scenario_fields, vector
from obsynth.evaluate.interface import StepObserver
from obsynth.evaluate.run import Run
from obsynth.evaluate.truth import Call, Truth, dense
from obsynth.symbolic import Plant, Scenario

__all__ = ["simulate"]

Array = NDArray[np.float64]

STEP_INPUTS = ("memory", "u", "y")


def simulate(
    model: Plant,
    observer: StepObserver,
    scenario: Scenario,
    seed: int = 0,
    engine: str = "step",
    substeps: int | None = None,
) -> Run:
    """Simulate a plant in a scenario and estimate it with an observer.

    At every instant k = 0..N the output y_k = h(x_k, u_k) is taken, the
    observer's step is called with (u_k, y_k), and only then the plant moves
    on: what the run stores at index k is the truth of instant k and what the
    observer claims about it.

    Parameters
    ----------
    model : Plant
        The truth: the observer's own discrete model, another discretisation,
        or, with `substeps`, the continuous plant behind it.
    observer : Observer
        Anything with the step of :class:`StepObserver`.
    scenario : Scenario
        Inputs, faults, disturbances and initial values.
    seed : int
        Seed of the disturbances, as the scenario defines it.
    engine : {"step"}
        ``"joint"`` integrates plant and observer as one differential equation
        and belongs to continuous-time methods.
    substeps : int, optional
        Integrate the continuous plant by this many Runge-Kutta steps of order
        four per sample, with inputs, faults and disturbances held. The run
        then says that the discretisation is outside the guarantee.

    Returns
    -------
    Run

    Raises
    ------
    SimulationError
        If model and observer do not have the same signals, a field of the
        scenario is missing, misshapen or not finite, or the truth leaves the
        region in which its equations give numbers.

    Examples
    --------
    >>> run = simulate(model, observer, scenario, seed=0)      # doctest: +SKIP
    >>> run.coverage["h1"]                                     # doctest: +SKIP
    1.0
    """
    if engine == "joint":
        raise SimulationError(
            "engine='joint' integrates plant and observer as one differential equation and needs "
            f"a continuous-time method; {observer.method} is a discrete-time observer: "
            "use engine='step', with substeps= for a continuous truth.",
            engine=engine,
        )
    if engine != "step":
        raise SimulationError(f"engine={engine!r} is not known: use engine='step'.", engine=engine)
    truth = Truth(model, observer, substeps)
    fields = scenario_fields(model, scenario, seed)
    return _loop(truth, observer, scenario, fields, seed)


def _step_call(observer: StepObserver, model: Plant) -> tuple[Call, list[int]]:
    """Put the observer's step behind buffers, and find the scheduling columns that it reads."""
    step = observer.step
    given_in, given_out = tuple(step.name_in()), tuple(step.name_out())
    if given_in[:3] != STEP_INPUTS or given_in[3:] not in ((), ("theta",)):
        raise SimulationError(
            f"the observer's step takes ({', '.join(given_in)}); (memory, u, y[, theta]) is "
            "needed.",
            given=given_in,
        )
    # CasADi accepts one name on both sides only on request, so the first one is left free.
    if given_out[1:] != STEP_OUTPUTS[1:]:
        raise SimulationError(
            f"the observer's step returns ({', '.join(given_out)}); ({', '.join(STEP_OUTPUTS)}) "
            "is needed.",
            given=given_out,
        )
    measured = [i for i, signal in enumerate(model.rho) if signal.measured]
    columns = measured if len(given_in) == 4 else []
    call = Call(dense(step))
    counts = {"u": len(model.u), "y": len(model.output_names), "theta": len(columns)}
    for i, name in enumerate(given_in[1:], start=1):
        if call.args[i].size != counts[name]:
            raise SimulationError(
                f"the observer's step takes {call.args[i].size} numbers as {name}; the model has "
                f"{counts[name]}.",
                field=name,
            )
    return call, columns


def _feedback(
    scenario: Scenario, plant: Plant, truth: Call, names: tuple[str, ...]
) -> Callable[[int], Array]:
    """Return a function of k that reads y_k and returns u_k; refuses an algebraic loop."""
    pattern = np.array(ca.DM(plant.function().sparsity_jac(1, 1)), dtype=bool)
    if pattern.any():
        row, column = (int(v) for v in np.argwhere(pattern)[0])
        raise SimulationError(
            f"the inputs of scenario {scenario.name!r} are a function of (k, y), but output "
            f"{plant.output_names[row]} depends on {names[column]} at the same instant: that is "
            "an algebraic loop. Give the inputs as an array or a function of k.",
            output=plant.output_names[row],
            symbol=names[column],
        )
    law: Any = scenario.inputs

    def at(k: int) -> Array:
        truth.evaluate()
        return vector(law(k, truth.results[1].copy()), names, f"inputs at k = {k}")

    return at


def _loop(
    truth: Truth,
    observer: StepObserver,
    scenario: Scenario,
    fields: dict[str, Array],
    seed: int,
) -> Run:
    """March plant and observer through the samples."""
    model, N = truth.model, scenario.steps
    plant = Call(truth.function)
    step, theta = _step_call(observer, model)
    plant_x, plant_u = plant.args[0], plant.args[1]
    law = _feedback(scenario, truth.plant, plant, model.names("u")) if scenario.feedback else None
    u = fields.setdefault("u", np.empty((N + 1, len(model.u))))
    rho = fields["rho"]
    pairs = zip(plant.args[2:], (fields["d"], fields["f"], fields["w"], rho), strict=True)
    held = [(argument, array) for argument, array in pairs if argument.size]

    x = np.empty((N + 1, len(model.x)))
    y = np.empty((N + 1, len(model.output_names)))
    logs = [np.empty((N + 1, result.size)) for result in step.results[1:]]
    plant_x[:] = vector(scenario.x0, model.names("x"), "x0")
    for k in range(N + 1):
        x[k] = plant_x
        for argument, array in held:
            argument[:] = array[k]
        plant_u[:] = u[k] if law is None else law(k)
        plant.evaluate()
        y[k] = plant.results[1]
        if k == 0:
            step.args[0][:] = _memory0(observer, scenario, y[0], step.args[0].size)
        u[k] = plant_u
        step.args[1][:] = plant_u
        step.args[2][:] = y[k]
        if theta:
            step.args[3][:] = rho[k, theta]
        step.evaluate()
        for log, result in zip(logs, step.results[1:], strict=True):
            log[k] = result
        step.args[0][:] = step.results[0]
        plant_x[:] = plant.results[0]
    finite(x, model.names("x"))
    finite(y, tuple(model.output_names))
    return Run.collect(
        model=model,
        observer=observer,
        scenario=scenario.name,
        seed=int(seed),
        truth=truth.description,
        outside=(*truth.outside, *broken_assumptions(observer.model, scenario, fields)),
        t=np.arange(N + 1, dtype=np.float64) * np.float64(truth.Ts),
        truths={"x": x, "y": y, **fields},
        claims=dict(zip(STEP_OUTPUTS[1:], logs, strict=True)),
    )


def _memory0(observer: StepObserver, scenario: Scenario, y0: Array, size: int) -> Array:
    memory = np.asarray(
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
