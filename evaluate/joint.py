"""Plant and continuous-time observer as one differential equation."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Call, dense
from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.observer import MEAN_OUTPUTS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import (
    first_memory,
    refuse_algebraic_loop,
    scenario_fields,
    scheduling_columns,
    step_function,
    vector,
)
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.run import Run
from obsynth.evaluate.truth import (
    continuous_plant,
    parameter_text,
    same_signals,
    sample_time,
    substeps_of,
)
from obsynth.symbolic import Plant, Scenario
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.discretise import runge_kutta
from obsynth.symbolic.scenario import WORDS

# Runge-Kutta steps evaluated in one call; bounds what the signals' values take of memory.
_CHUNK = 8192


def joint(
    model: Plant,
    observer: Observer | FaultDetector,
    scenario: Scenario,
    seed: int,
    substeps: int | None,
) -> Run:
    """Integrate plant and observer together; see :func:`obsynth.simulate`.

    Signals enter a Runge-Kutta step by their values at its beginning, middle and end; a feedback
    (k, y) reads the output of each stage.
    """
    if isinstance(observer, FaultDetector):
        run = joint(model, observer.observer, scenario, seed, substeps)
        means = observer.means(run)
        alarm = observer.alarms(run.f_lower, run.f_upper, run.status, *means)
        told: Any = dict(zip(MEAN_OUTPUTS, means, strict=False))
        return replace(run, alarm=alarm, method=observer.method, **told)
    system = _System(model, observer, 1 if substeps is None else substeps_of(substeps))
    fields = scenario_fields(model, scenario, seed)
    march = _with_feedback if scenario.feedback else _with_signals
    z = march(system, observer, scenario, fields)
    n = len(model.x)
    x, memory = np.ascontiguousarray(z[:, :n]), np.ascontiguousarray(z[:, n:])
    (y,) = _mapped(system.output, z, _samples(fields))
    return Run.collect(
        model=model,
        observer=observer,
        scenario=scenario,
        seed=seed,
        truth=system.describe(scenario),
        outside=system.outside,
        Ts=system.Ts,
        truths={"x": x, "y": y, **fields},
        claims=_claims(step_function(observer, model), model, memory, y, fields),
    )


class _System:
    """z' = rates(z, v) and y = output(z, v) with z = (x, memory) and v = (u, d, f, w, rho)."""

    def __init__(self, model: Plant, observer: Observer, substeps: int) -> None:
        ode = observer.ode
        if ode is None:
            raise SimulationError(
                "engine='joint' integrates plant and observer as one differential equation and "
                f"needs a continuous-time method; {observer.method} is a discrete-time observer: "
                "use engine='step', with substeps= for a continuous truth.",
                engine="joint",
            )
        own = observer.model
        same_signals(model, own)
        self.plant = continuous_plant(model, "engine='joint'")
        designed = continuous_plant(own, "engine='joint'")
        self.outside: tuple[str, ...] = ()
        if self.plant is not designed and self.plant.to_dict() != designed.to_dict():
            self.outside = ("the truth is not the plant for which the observer was designed",)
        self.model, self.substeps = model, substeps
        self.Ts = sample_time(own)
        self.h = self.Ts / substeps
        self.p = operating_values(self.plant, "p")
        self._join(ode)

    def _join(self, ode: ca.Function) -> None:
        columns = scheduling_columns(ode, self.model, "ode")
        sizes = [len(self.model.names(key)) for key in WORDS]
        n, n_memory = len(self.model.x), int(ode.numel_in(0))
        z, v = ca.MX.sym("z", n + n_memory), ca.MX.sym("v", sum(sizes))
        u, d, f, w, rho = ca.vertsplit(v, [0, *np.cumsum(sizes).tolist()])
        call: Any = self.plant.function()
        dx, y = call(z[:n], u, d, f, w, self.p, rho)
        measured = [z[n:], u, y] + ([rho[columns]] if ode.n_in() == 4 else [])
        derivative: Any = ode(*measured)
        if int(derivative.numel()) != n_memory:
            raise SimulationError(
                f"the observer's ode takes {n_memory} numbers as memory and returns "
                f"{derivative.numel()}.",
                field="memory",
            )
        self.n_x, self.n_memory, self.n_v = n, n_memory, sum(sizes)
        self.rates = _scalar(ca.Function("rates", [z, v], [ca.vertcat(dx, derivative)]))
        self.output = _scalar(ca.Function("output", [z, v], [y]))

    def start(self, observer: Observer, scenario: Scenario, v: FloatArray) -> FloatArray:
        """Return z at k = 0: the scenario's x0 and the memory for the first measurement."""
        x0 = vector(scenario.x0, self.model.names("x"), "x0")
        z0 = np.concatenate([x0, np.zeros(self.n_memory)])
        y0 = _mapped(self.output, z0[None], v[None])[0][0]
        return np.concatenate([x0, first_memory(observer, scenario, y0, self.n_memory)])

    def describe(self, scenario: Scenario) -> str:
        """Say what was integrated how."""
        at_stages = [WORDS[key] for key in scenario.functions]
        at_stages += ["inputs (feedback)"] if scenario.feedback else []
        how = (
            f"{', '.join(at_stages)} at the stages, all else held" if at_stages else "signals held"
        )
        return (
            "continuous plant and the observer's differential equation together, Runge-Kutta "
            f"steps of {self.h:g} s ({self.substeps} per sample), {how}"
            f"{parameter_text(self.plant, self.p)}"
        )


def _scalar(function: ca.Function) -> ca.Function:
    """Return the function as scalar operations where it can be written so; they are faster."""
    try:
        return dense(function.expand())
    except RuntimeError:
        return dense(function)


def _mapped(function: ca.Function, *arguments: FloatArray) -> list[FloatArray]:
    """Evaluate a function of columns for every row of its arguments."""
    return [np.array(found).T for found in function.call([ca.DM(a.T) for a in arguments])]


def _claims(
    step: ca.Function,
    model: Plant,
    memory: FloatArray,
    y: FloatArray,
    fields: dict[str, FloatArray],
) -> dict[str, FloatArray]:
    """Read from the observer's step what it says for the integrated memories."""
    arguments = [memory, fields["u"], y]
    if len(step.name_in()) == 4:
        arguments.append(fields["rho"][:, scheduling_columns(step, model, "step")])
    if step.numel_in(0) != memory.shape[1]:
        raise SimulationError(
            f"the observer's ode has {memory.shape[1]} numbers as memory, its step "
            f"{step.numel_in(0)}.",
            field="memory",
        )
    return dict(zip(step.name_out()[1:], _mapped(step, *arguments)[1:], strict=True))


def _samples(fields: dict[str, FloatArray]) -> FloatArray:
    """Return all signals at the samples, beside each other; zero where a feedback sets u."""
    return np.hstack([fields[key] for key in WORDS])


def _stages(
    system: _System, scenario: Scenario, samples: FloatArray
) -> Iterator[tuple[int, int, tuple[FloatArray, FloatArray, FloatArray]]]:
    """Yield the signals at beginning, middle and end of every Runge-Kutta step, in chunks.

    Each item is a range of samples and three arrays with one row for each step.
    """
    steps, per = scenario.steps, system.substeps
    ends = np.cumsum([0, *(len(system.model.names(key)) for key in WORDS)])
    columns = {key: slice(ends[i], ends[i + 1]) for i, key in enumerate(WORDS)}
    size = max(1, _CHUNK // per)
    for begin in range(0, steps, size):
        end = min(steps, begin + size)
        first, middle, last = (np.repeat(samples[begin:end], per, axis=0) for _ in range(3))
        points = np.arange(2 * per * begin, 2 * per * end + 1) / (2.0 * per)
        for key, function in scenario.functions.items():
            names = system.model.names(key)
            rows = ((k, np.ravel(function(k))) for k in points.tolist())
            values = np.array([vector(r, names, f"{WORDS[key]} at k = {k:.12g}") for k, r in rows])
            first[:, columns[key]] = values[:-1:2]
            middle[:, columns[key]] = values[1::2]
            last[:, columns[key]] = values[2::2]
        yield begin, end, (first, middle, last)


def _with_signals(
    system: _System, observer: Observer, scenario: Scenario, fields: dict[str, FloatArray]
) -> FloatArray:
    """Integrate with every signal known beforehand; return z at the samples."""
    samples = _samples(fields)
    z = np.empty((scenario.steps + 1, system.n_x + system.n_memory))
    z[0] = system.start(observer, scenario, samples[0])
    step = _runge_kutta(system)
    for begin, end, stages in _stages(system, scenario, samples):
        march = step.mapaccum(len(stages[0]))
        z[begin + 1 : end + 1] = _mapped(march, z[[begin]], *stages)[0][
            system.substeps - 1 :: system.substeps
        ]
    return z


def _runge_kutta(system: _System) -> ca.Function:
    z = ca.MX.sym("z", system.n_x + system.n_memory)
    first, middle, last = (ca.MX.sym(name, system.n_v) for name in ("first", "middle", "last"))
    at, rates = iter((first, middle, middle, last)), cast(Any, system.rates)
    following = runge_kutta(lambda stage: rates(stage, next(at)), z, system.h)
    return _scalar(ca.Function("step", [z, first, middle, last], [following]))


def _with_feedback(
    system: _System, observer: Observer, scenario: Scenario, fields: dict[str, FloatArray]
) -> FloatArray:
    """Integrate with inputs that read the output of every stage; return z, and u in the fields."""
    refuse_algebraic_loop(scenario, system.plant)
    names, per, law = system.model.names("u"), system.substeps, cast(Any, scenario.inputs)
    u = fields["u"] = np.zeros((scenario.steps + 1, len(names)))
    samples = _samples(fields)
    measure, move = Call(system.output), Call(system.rates)

    def control(at: float, z: FloatArray, v: FloatArray) -> FloatArray:
        """Return the inputs where the others of the signals v are known, as y does not need u."""
        measure.args[0][:], measure.args[1][:] = z, v
        measure.evaluate()
        return vector(law(at, measure.results[0].copy()), names, f"inputs at k = {at:.12g}")

    def rates(z: FloatArray) -> FloatArray:
        point, v = next(ahead)
        move.args[0][:], move.args[1][:] = z, v
        move.args[1][: len(names)] = value = control(point / (2.0 * per), z, v)
        if point % (2 * per) == 0 and v is first:
            u[point // (2 * per)] = value
        move.evaluate()
        return move.results[0].copy()

    z = np.empty((scenario.steps + 1, system.n_x + system.n_memory))
    z[0] = now = system.start(observer, scenario, samples[0])
    for begin, _, stages in _stages(system, scenario, samples):
        for j, (first, middle, last) in enumerate(zip(*stages, strict=True), begin * per):
            points = (2 * j, 2 * j + 1, 2 * j + 1, 2 * j + 2)
            ahead = zip(points, (first, middle, middle, last), strict=True)
            now = z[j // per + 1] = runge_kutta(rates, now, system.h)
    u[-1] = control(float(scenario.steps), now, samples[-1])
    return z
