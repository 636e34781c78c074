"""An observer on a record: what it says of what was measured."""

import numpy as np

from obsynth.designs.core.observer import Observer
from obsynth.evaluate.checked import scheduling_columns, step_function
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.run import Run
from obsynth.evaluate.truth import Call, dense, sample_time
from obsynth.symbolic import Record
from obsynth.symbolic.scenarios import gentle


def replay(observer: Observer, record: Record) -> Run:
    """Run an observer over a record, from its declared ranges; the truth of the run is NaN."""
    model, function = observer.model, step_function(observer, observer.model)
    for kind, names in (("u", model.names("u")), ("y", model.output_names)):
        if record.names[kind] != tuple(names):
            raise SimulationError(
                f"the record {record.source!r} has {', '.join(record.names[kind])} as {kind}; "
                f"{model.name} has {', '.join(names)}: give its channels in that order.",
                field=kind,
            )
    Ts, steps = sample_time(model), np.diff(record.time)
    k = int(np.abs(steps - Ts).argmax())
    if abs(steps[k] - Ts) > 0.05 * Ts:
        raise SimulationError(
            f"the record {record.source!r} has {steps[k]:g} s from t = {record.time[k]:g} on; "
            f"{model.name} is sampled every {Ts:g} s.",
            instant=k,
        )
    if scheduling_columns(function, model, "step"):
        raise SimulationError(f"{model.name} is scheduled, which a record does not hold.")
    step, start = Call(dense(function)), gentle(model)
    step.args[0][:] = observer.memory0(start.guess, f_range=start.f_range, y0=record.y[0])
    logs = [np.empty((len(record), result.size)) for result in step.results[1:]]
    for k in range(len(record)):
        step.args[1][:], step.args[2][:] = record.u[k], record.y[k]
        step.evaluate()
        for log, result in zip(logs, step.results[1:], strict=True):
            log[k] = result
        step.args[0][:] = step.results[0]
    sizes = {kind: len(getattr(model, kind)) for kind in ("x", "d", "f", "w", "rho")}
    unknown = {kind: np.full((len(record), size), np.nan) for kind, size in sizes.items()}
    return Run.collect(
        model=model,
        observer=observer,
        scenario=record.source,
        seed=0,
        truth="a record",
        outside=(),
        t=np.array(record.time),
        truths={**unknown, "u": np.array(record.u), "y": np.array(record.y)},
        claims=dict(zip(function.name_out()[1:], logs, strict=True)),
    )
