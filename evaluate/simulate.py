"""Run a plant and an observer side by side through ``Observer.step``."""

from collections.abc import Callable
from typing import Any

import numpy as np

from obsynth.codegen.kernel import Call, dense, row_of
from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import (
    broken_assumptions,
    claims_of,
    finite,
    first_memory,
    refuse_algebraic_loop,
    scenario_fields,
    scheduling_columns,
    step_function,
    vector,
)
from obsynth.evaluate.compiled import compiled
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.joint import joint
from obsynth.evaluate.run import Run
from obsynth.evaluate.truth import Truth
from obsynth.symbolic import Plant, Scenario
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.taking import takes


@takes(model="Plant", observer="Observer FaultDetector ExtendedKalman", scenario="Scenario")
def simulate(
    model: Plant,
    observer: Observer | FaultDetector,
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
    observer : Observer or FaultDetector
        Its step runs in double precision, also where it was designed for single: the sets hold, as
        rounding is less than they count. What a target computes, float by float, are the vectors of
        `generate_c`, evaluated by ``codegen/single.py``.
    scenario : Scenario
        Inputs, faults, disturbances and initial values.
    seed : int
        Seed of the disturbances, as the scenario defines it.
    engine : {"step", "joint"}
        ``"joint"`` integrates plant and observer as one differential equation
        by the Runge-Kutta formula of order four, for observers with an ``ode``.
        What the observer says at an instant is read from its step, called with
        the integrated memory; the memory which that step returns is not used.
        Signals that the scenario gives as functions of k, and a feedback
        (k, y), are evaluated at the stages of the formula, arrays are held.
    substeps : int, optional
        With ``"step"``: integrate the continuous plant by this many Runge-Kutta
        steps per sample, with inputs, faults and disturbances held. The run
        then says that the discretisation is outside the guarantee, unless the observer's model
        carries its remainder: the disturbances of the run then show the remainder that the motion
        had, within its range. With
        ``"joint"``: steps per sample, 1 by default.

    Returns
    -------
    Run

    Raises
    ------
    SimulationError
        If the joint engine is asked for and the method has no ``ode`` or the
        plant no differential equation; if model and observer do not have the
        same signals, a field of the scenario is missing, misshapen or not
        finite, or the truth leaves the region in which its equations give
        numbers.

    Examples
    --------
    >>> run = simulate(model, observer, scenario, seed=0)      # doctest: +SKIP
    >>> run.coverage["h1"]                                     # doctest: +SKIP
    1.0
    """
    if engine == "joint":
        return joint(model, observer, scenario, seed, substeps)
    if engine != "step":
        raise SimulationError(
            f"engine={engine!r} is not known: use engine='step' or 'joint'.", engine=engine
        )
    truth = Truth(model, observer, substeps)
    fields = scenario_fields(truth.model, scenario, seed)
    return _loop(truth, observer, scenario, fields, seed)


def _feedback(
    scenario: Scenario, plant: Plant, truth: Call, names: tuple[str, ...]
) -> Callable[[int], FloatArray]:
    """Return a function of k that reads y_k and returns u_k; refuses an algebraic loop."""
    refuse_algebraic_loop(scenario, plant)
    law: Any = scenario.inputs

    def at(k: int) -> FloatArray:
        truth.evaluate()
        return vector(law(k, truth.results[1].copy()), names, f"inputs at k = {k}")

    return at


def _loop(
    truth: Truth,
    observer: Observer | FaultDetector,
    scenario: Scenario,
    fields: dict[str, FloatArray],
    seed: int,
) -> Run:
    """March plant and observer through the samples."""
    model, N = truth.model, scenario.steps
    function = step_function(observer, model)
    theta = scheduling_columns(function, model, "step")
    names = model.names("u")
    u = fields.setdefault("u", np.zeros((N + 1, len(names))))
    kinds = ("u", "d", "f", "w", "rho")
    given, sizes = np.hstack([fields[kind] for kind in kinds]), [fields[k].shape[1] for k in kinds]
    # both functions read one row of signals and write one row of results
    row, signals = row_of(sizes)
    whole, moving = compiled(dense(function), N + 1), compiled(truth.function, N + 1)
    state, (_, made) = np.empty(len(model.x)), row_of([moving.numel_out(i) for i in range(2)])
    plant = Call(moving, [state, *signals], made)
    memory, moved = (np.empty(whole.numel_in(0)) for _ in range(2))
    told, ends = row_of([whole.numel_out(i) for i in range(1, whole.n_out())])
    scheduled = [np.empty(len(theta))] if theta else []
    step = Call(whole, [memory, signals[0], plant.results[1], *scheduled], [moved, *ends])
    law = _feedback(scenario, truth.plant, plant, names) if scenario.feedback else None

    x, y = (np.empty((N + 1, part.size)) for part in made)
    log = np.empty((N + 1, told.size))
    state[:] = vector(scenario.x0, model.names("x"), "x0")
    for k in range(N + 1):
        row[:] = given[k]
        if law is not None:
            signals[0][:] = u[k] = law(k)
        plant.evaluate()
        x[k], y[k] = state, plant.results[1]
        if k == 0:
            memory[:] = first_memory(observer, scenario, y[0], memory.size)
        if theta:
            scheduled[0][:] = signals[-1][theta]
        step.evaluate()
        log[k] = told
        memory[:] = moved
        state[:] = made[0]
    finite(x, model.names("x"))
    finite(y, tuple(model.output_names))
    fields["w"] = truth.remainders(fields, x)
    truths = {"x": x, "y": y, **fields}
    return Run.collect(
        model=model,
        observer=observer,
        scenario=scenario.name,
        seed=int(seed),
        truth=truth.description,
        outside=(*truth.outside, *broken_assumptions(observer, scenario, truths)),
        t=np.arange(N + 1, dtype=np.float64) * np.float64(truth.Ts),
        truths=truths,
        claims=claims_of(function, log),
    )
