"""`estimate`: an observer on a record, and which readings contradict it."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Call, dense
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS, Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.checked import claims_of, scheduling_columns, step_function
from obsynth.evaluate.compiled import compiled
from obsynth.evaluate.data.estimated import Estimate
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.march import in_rows, march
from obsynth.evaluate.trace import as_told
from obsynth.evaluate.truth import sample_time
from obsynth.symbolic import Plant, Record, read_record
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.scenarios import gentle
from obsynth.symbolic.taking import takes

JITTER = 0.05
"""Share of the sample time by which two instants of a record may be too far from each other."""


@takes(observer="Observer FaultDetector ExtendedKalman")
def estimate(
    observer: Observer | FaultDetector,
    record: Any,
    *,
    guess: Any = None,
    x_range: Any = None,
    f_range: Any = None,
    windows: Sequence[int] = (),
    **reading: Any,
) -> Estimate:
    """Run an observer or a fault detector over what was measured.

    Parameters
    ----------
    observer : Observer or FaultDetector
        Of any method, for the plant of the record. Its step runs in double precision, also where
        it was designed for single: the sets hold, as rounding is less than they count.
    record : Record, or whatever `read_record` reads
        Rows are instants one sample time apart; a missing reading is NaN and costs that reading
        only, an instant at which nothing was measured all of them.
    guess : array_like (n,), optional
        Where the state is thought to be at the first instant; the nominal one by default.
    x_range, f_range : array_like (n, 2), (n_f, 2), optional
        Boxes that hold the first state and the first faults; the declared ranges by default, so
        that nothing is assumed of the start.
    windows : sequence of int, optional
        Numbers m of instants, for the means of the faults over them: `Estimate.means`.
    **reading
        What `read_record` takes, ``map=``, ``time=``, ``jitter=`` and so on.

    Returns
    -------
    Estimate
        The same bits that `observer.step` gives, called instant by instant.

    Raises
    ------
    RecordError
        The source cannot be read.
    SimulationError
        The record has other channels, or another sample time, than the observer's plant.

    Examples
    --------
    >>> import obsynth as ob
    >>> observer = ob.IntervalObserver().design(ob.plants.leaking_tanks())
    >>> told = ob.estimate(observer, ob.records.three_tank_leak())
    >>> told.consistent, told.refuted
    (1.0, None)
    """
    model, step = observer.model, step_function(observer, observer.model)
    if not isinstance(record, Record) or reading:
        record = read_record(record, model, **reading)
    fits(model, record)
    start = gentle(model)
    memory = observer.memory0(
        start.guess if guess is None else guess,
        x_range=x_range,
        f_range=start.f_range if f_range is None else f_range,
        y0=record.y[0],
    )
    names = [model.names("rho")[k] for k in scheduling_columns(step, model, "step")]
    rows = np.column_stack([record.u, record.y, *(record[name] for name in names)])
    log, blamed = _march(step, np.array(memory, dtype=float), rows, model.output_names)
    told = as_told(claims_of(step, log))
    for array in told.values():
        array.flags.writeable = False
    own = observer.observer if isinstance(observer, FaultDetector) else observer
    detectors = tuple(FaultDetector(own, window=m) for m in windows)
    return Estimate(observer, record, blamed=blamed, windows=detectors, **told)


def fits(model: Plant, record: Record) -> None:
    """Refuse a record with other channels, or other instants, than a plant has."""
    known = tuple(s.name for s in model.rho if s.measured)
    for kind, names in (("u", model.names("u")), ("y", model.output_names), ("rho", known)):
        if record.names[kind] != tuple(names):
            given, own = (", ".join(some) or "nothing" for some in (record.names[kind], names))
            raise SimulationError(
                f"the record {record.source!r} has {given} as {kind}; {model.name} has {own}: "
                "give its channels in that order.",
                field=kind,
            )
    Ts, steps = sample_time(model), np.diff(record.time)
    k = int(np.abs(steps - Ts).argmax())
    if abs(steps[k] - Ts) > JITTER * Ts:
        raise SimulationError(
            f"the record {record.source!r} has {steps[k]:g} s from t = {record.time[k]:g} on; "
            f"{model.name} is sampled every {Ts:g} s. read_record makes instants of missing rows.",
            instant=k,
        )


def _march(
    function: ca.Function, memory: FloatArray, rows: FloatArray, outputs: tuple[str, ...]
) -> tuple[FloatArray, tuple[str, ...]]:
    """Return what the step tells at every instant, and the outputs that make it void first.

    Shapes: rows (N, n_u + n_y + n_theta), result (N, numbers of the outputs but the memory).
    """
    step = in_rows(compiled(dense(function), len(rows)))
    before = STEP_OUTPUTS[1 : STEP_OUTPUTS.index("status")]
    column = sum(int(function.numel_out(name)) for name in before)
    readings = dict(zip(outputs, range(function.numel_in(1), len(rows[0])), strict=False))
    log: list[FloatArray] = []
    blamed: tuple[str, ...] | None = None
    begin = 0
    for states, told in march(step, memory, rows):
        void = told[:, column].astype(np.int64) & STATUS["void"] > 0
        if void.any() and blamed is None:
            k = int(void.argmax())
            blamed = _blamed(step, states[k], rows[begin + k], column, readings)
        log.append(told)
        begin += len(told)
    return np.concatenate(log), blamed or ()


def _blamed(
    step: ca.Function,
    memory: FloatArray,
    row: FloatArray,
    column: int,
    readings: Mapping[str, int],
) -> tuple[str, ...]:
    """Return the readings, by their columns in the row, without which a step is not void."""
    call, found = Call(step), []
    for name, i in readings.items():
        call.args[0][:], call.args[1][:] = memory, row
        call.args[1][i] = np.nan
        call.evaluate()
        if not int(call.results[1][column]) & STATUS["void"]:
            found.append(name)
    return tuple(found)
