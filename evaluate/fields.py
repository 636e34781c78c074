"""The signals of a scenario as checked arrays, and the assumptions that they do not keep."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from obsynth.evaluate.errors import SimulationError
from obsynth.symbolic import Plant, Scenario

Array = NDArray[np.float64]

WORDS: Mapping[str, str] = {
    "u": "inputs",
    "d": "unknown_inputs",
    "f": "faults",
    "w": "disturbances",
    "rho": "scheduling",
}
"""What a scenario calls each group of signals, in the order in which plants take them."""


def scenario_fields(model: Plant, scenario: Scenario, seed: int) -> dict[str, Array]:
    """Return the scenario's signals as checked arrays of N + 1 samples; no u in a feedback."""
    if isinstance(seed, bool) or int(seed) != seed or seed < 0:
        raise SimulationError(f"seed={seed!r} is not a whole number from 0 on.", seed=seed)
    arrays: Mapping[str, Any] = scenario.arrays(model, int(seed))
    fields: dict[str, Array] = {}
    for key, word in WORDS.items():
        names = model.names(key)
        value = arrays.get(key)
        if value is None:
            if key == "u" and scenario.feedback:
                continue
            if names:
                raise SimulationError(
                    f"scenario {scenario.name!r} gives no {word} for {', '.join(names)}.",
                    field=word,
                )
            value = np.empty((scenario.steps + 1, 0))
        fields[key] = _checked(value, (scenario.steps + 1, len(names)), word, names)
    return fields


def _checked(value: Any, shape: tuple[int, int], word: str, names: tuple[str, ...]) -> Array:
    try:
        array = np.array(value, dtype=float, order="C")
    except (TypeError, ValueError) as error:
        raise SimulationError(
            f"the {word} are no array of numbers: {error}.", field=word
        ) from error
    if array.shape != shape:
        raise SimulationError(
            f"the {word} have shape {array.shape}; {shape} is needed: one row for each of the "
            f"{shape[0]} samples, one column for each of {', '.join(names) or 'no signal'}.",
            field=word,
            shape=array.shape,
        )
    bad = np.argwhere(~np.isfinite(array))
    if bad.size:
        k, i = (int(v) for v in bad[0])
        raise SimulationError(
            f"the {word} are not finite: {names[i]} is {array[k, i]} at k = {k} "
            f"({len(bad)} such values in all).",
            field=word,
            symbol=names[i],
            instant=k,
        )
    return array


def vector(value: Any, names: tuple[str, ...], word: str) -> Array:
    """Return a finite vector with one number for each name."""
    row: Array = np.asarray(value, dtype=float)
    if row.shape != (len(names),):
        raise SimulationError(
            f"{word} has shape {row.shape}; one number for each of {', '.join(names)} is needed.",
            field=word,
            shape=row.shape,
        )
    return _checked(row.reshape(1, -1), (1, len(names)), word, names).reshape(-1)


def function_values(
    function: Callable[[float], Any], points: Array, names: tuple[str, ...], word: str
) -> Array:
    """Return a function of the real-valued k at many points, one row for each."""
    rows = [np.ravel(np.asarray(function(k), dtype=float)) for k in points.tolist()]
    for k, row in zip(points, rows, strict=True):
        if row.shape != (len(names),):
            raise SimulationError(
                f"the {word} at k = {k:g} are {row.size} numbers; one for each of "
                f"{', '.join(names) or 'no signal'} is needed.",
                field=word,
                shape=row.shape,
            )
    values: Array = np.array(rows)
    bad = np.argwhere(~np.isfinite(values))
    if bad.size:
        row_of, i = (int(v) for v in bad[0])
        raise SimulationError(
            f"the {word} are not finite: {names[i]} is {values[row_of, i]} at k = "
            f"{points[row_of]:.12g}.",
            field=word,
            symbol=names[i],
            instant=float(points[row_of]),
        )
    return values


def finite(values: Array, names: tuple[str, ...]) -> None:
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


def broken_assumptions(
    model: Plant, scenario: Scenario, fields: Mapping[str, Array]
) -> tuple[str, ...]:
    """Say which bounds of the observer's discrete model the scenario does not keep.

    Rates are per step there. A rate is compared with a relative slack of 1e-9,
    because differences of sampled ramps carry rounding errors.
    """
    said: list[str] = []
    for group in ("w", "d", "u", "f", "rho"):
        said += _outside_box(fields[group], model.box(group), model.names(group), "range")
    faults = fields["f"]
    for i, signal in enumerate(model.f):
        steps = np.abs(np.diff(faults[:, i]))
        limit = np.inf if signal.rate is None else signal.rate * (1 + 1e-9)
        fast = np.flatnonzero(steps > limit)
        if fast.size:
            k = int(fast[0])
            said.append(
                f"{signal.name} moves by {steps[k]:.6g} from k = {k} to {k + 1}; its declared "
                f"rate is {signal.rate:g} per step"
            )
    start = np.zeros((len(model.f), 2)) if scenario.f_range is None else scenario.f_range
    said += _outside_box(faults[:1], start, model.names("f"), "assumed initial range")
    if scenario.x_range is not None:
        x0 = np.asarray(scenario.x0, dtype=float).reshape(1, -1)
        said += _outside_box(x0, scenario.x_range, model.names("x"), "assumed initial range")
    return tuple(said)


def _outside_box(values: Array, box: Array, names: tuple[str, ...], word: str) -> list[str]:
    said = []
    for i, name in enumerate(names):
        out = np.flatnonzero((values[:, i] < box[i, 0]) | (values[:, i] > box[i, 1]))
        if out.size:
            k = int(out[0])
            said.append(
                f"{name} is outside its {word} [{box[i, 0]:g}, {box[i, 1]:g}] at {out.size} "
                f"instants, first k = {k}: {values[k, i]:.6g}"
            )
    return said
