"""Run a plant and an observer side by side through ``Observer.step``."""

from typing import Any, cast

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Call, dense
from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import (
    claims_of,
    first_memory,
    refuse_algebraic_loop,
    scenario_fields,
    scheduling_columns,
    step_function,
    vector,
)
from obsynth.evaluate.compiled import PAYS, compiled
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.joint import joint
from obsynth.evaluate.march import Before, in_rows, march
from obsynth.evaluate.run import Run
from obsynth.evaluate.truth import Truth
from obsynth.symbolic import Plant, Scenario
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.scenario import WORDS
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


def _feedback(scenario: Scenario, plant: Plant, output: Call, names: tuple[str, ...]) -> Before:
    """Return a function of (k, state, row) that sets u_k by y_k; refuses an algebraic loop."""
    refuse_algebraic_loop(scenario, plant)
    law: Any = scenario.inputs
    (x, given), y = output.args, output.results[1]

    def at(k: int, state: FloatArray, row: FloatArray) -> None:
        x[:], given[:] = state[: x.size], row
        output.evaluate()
        row[: len(names)] = vector(law(k, y.copy()), names, f"inputs at k = {k}")

    return at


def instants(truth: Truth, observer: Observer | FaultDetector, calls: int) -> ca.Function:
    """Return (x and memory, u d f w rho) -> (both at the next instant, y and what is told).

    Where it is called often, as compiled code: both together, or what is compiled already.
    """
    step, model = dense(step_function(observer, truth.model)), truth.model
    theta = scheduling_columns(step, model, "step")
    together = _instant(truth.function, step, theta)
    found = compiled(together, calls) if calls >= PAYS else together
    if found is together:
        found = _instant(compiled(truth.function, calls), compiled(step, calls), theta)
    return found


def _instant(moving: ca.Function, step: ca.Function, theta: list[int]) -> ca.Function:
    n, n_memory = moving.numel_in(0), step.numel_in(0)
    state = ca.MX.sym("state", n + n_memory)
    signals = [ca.MX.sym(f"v{i}", moving.numel_in(i)) for i in range(1, moving.n_in())]
    move, call = cast(Any, moving), cast(Any, step)
    moved, y = move(state[:n], *signals)
    memory, *told = call(state[n:], signals[0], y, *([signals[-1][theta]] if theta else []))
    following = ca.vertcat(moved, memory)
    return in_rows(ca.Function("instant", [state, *signals], [following, y, *told]))


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
    names = model.names("u")
    fields.setdefault("u", np.zeros((N + 1, len(names))))
    rows = np.hstack([fields[kind] for kind in WORDS])
    output, instant = Call(in_rows(truth.function)), instants(truth, observer, N + 1)
    law = _feedback(scenario, truth.plant, output, names) if scenario.feedback else None
    output.args[0][:] = x0 = vector(scenario.x0, model.names("x"), "x0")
    output.args[1][:] = rows[0]
    output.evaluate()
    memory = first_memory(observer, scenario, output.results[1], function.numel_in(0))
    blocks = march(instant, np.hstack([x0, memory]), rows, law)
    parts = ((states[:, : x0.size].copy(), told) for states, told in blocks)
    x, said = map(np.concatenate, zip(*parts, strict=True))
    fields["u"] = rows[:, : len(names)]
    y, log = np.split(said, [output.results[1].size], axis=1)
    fields["w"] = truth.remainders(fields, x)
    return Run.collect(
        model=model,
        observer=observer,
        scenario=scenario,
        seed=seed,
        truth=truth.description,
        outside=truth.outside,
        Ts=truth.Ts,
        truths={"x": x, "y": y, **fields},
        claims=claims_of(function, log),
    )
