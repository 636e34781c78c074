"""What the steps of all methods share: finiteness, ranges, the status word, names of arguments."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import inward
from obsynth.designs.core.boxes import LIMITS, column, every, select
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.taking import labelled

_KINDS = {"u": "inputs", "y": "outputs", "theta": "measured scheduling variables"}
MOST_CORNERS = 14


class StepFunction(ca.Function):
    """A step: what is called with as many numbers as it has signals, or refuses them by name.

    CasADi itself fills a vector with a number that stands alone, takes zero for a keyword that is
    left out, and reads labelled numbers in whatever order they have.
    """

    labels: Mapping[str, Sequence[str]] = {}
    """Names of the plant's signals in u, y and theta, where they are known."""

    def __call__(self, *args: Any, **keywords: Any) -> Any:
        """Return what CasADi returns for the same arguments once each has its size."""
        names = self.name_in()
        given = dict(zip(names, args, strict=False)) | keywords
        unknown = [name for name in keywords if name not in names]
        if unknown or len(args) + len(keywords) != len(names) or len(given) != len(names):
            told = f"{len(args)} arguments" + "".join(f", {name}=" for name in keywords)
            raise ObsynthError(
                f"step takes ({', '.join(names)}), each once; it was given {told}", given=told
            )
        for i, name in enumerate(names):
            self._check(name, int(self.numel_in(i)), given[name])
        return super().__call__(*args, **keywords)

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "labels": self.labels}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        super().__setstate__(state)
        self.labels = state["labels"]

    def _check(self, name: str, size: int, value: Any) -> None:
        if isinstance(value, ca.SX | ca.MX | ca.DM):
            shape: Any = value.shape
        else:
            shape = self._shape(name, value)
        if len(shape) == 2 and shape[0] == size:  # a column for every one of many steps
            return
        if (number := int(np.prod(shape, dtype=int))) != size:
            raise ObsynthError(
                f"step: {name} has {number} number{'s' * (number != 1)} for {size} "
                f"{self._told(name)}",
                argument=name,
                given=number,
                needed=size,
            )

    def _shape(self, name: str, value: Any) -> tuple[int, ...]:
        if told := labelled(name, value, self.labels.get(name, ("...",))):
            raise ObsynthError(f"step: {told}", argument=name)
        try:
            numbers = np.asarray(value)
            if numbers.dtype.kind not in "biuf":
                numbers = numbers.astype(object) + 0.0
            return numbers.shape
        except (TypeError, ValueError) as error:
            raise ObsynthError(
                f"step: {name} is an array of numbers, one for each of the {self._told(name)}, nan "
                f"for a reading that is missing; not {type(value).__name__} {value!r:.60}",
                argument=name,
            ) from error

    def _told(self, name: str) -> str:
        if name not in _KINDS:
            return "entries of the memory (observer.memory0 returns the first one)"
        listed = ", ".join(self.labels.get(name, ()))
        return _KINDS[name] + (f" ({listed})" if listed else "")


def named_step(function: ca.Function, plant: Plant) -> StepFunction:
    """Return the function as the step of an observer of a plant."""
    step = StepFunction(function)
    measured = tuple(signal.name for signal in plant.rho if signal.measured)
    step.labels = {"u": plant.names("u"), "y": plant.output_names, "theta": measured}
    return step


def slices(sizes: Mapping[str, int]) -> dict[str, slice]:
    """Return where the parts of a vector are, by their sizes, one behind the other."""
    layout, at = {}, 0
    for name, size in sizes.items():
        layout[name] = slice(at, at + size)
        at += size
    return layout


def fill(layout: Mapping[str, slice], parts: Mapping[str, ArrayLike]) -> FloatArray:
    """Return an initialised memory with the parts given and zeros elsewhere."""
    memory = np.zeros(layout["initialised"].stop)
    memory[layout["initialised"]] = 1.0
    for name, value in parts.items():
        memory[layout[name]] = value
    return memory


def largest_level(P: FloatArray, lower: FloatArray, upper: FloatArray) -> float:
    """Bound ``xi'P xi`` over a box, delta of (48): exact up to rounding for up to 14 components."""
    reach = np.maximum(np.abs(lower), np.abs(upper))
    rounding = 2.0**-40 * float(reach @ np.abs(P) @ reach)
    if len(P) > MOST_CORNERS:
        return float(reach @ np.abs(P) @ reach) * (1.0 + 2.0**-44) + rounding
    pairs = [(a, b) if a != b else (a,) for a, b in zip(lower, upper, strict=True)]
    corners = np.array(list(itertools.product(*pairs)))
    levels = np.einsum("ki,ij,kj->k", corners, P, corners)
    return float(levels.max()) + rounding


def clip(value: ca.SX, box: FloatArray, precision: str = "double") -> ca.SX:
    """Return the nearest point of a box of shape (n, 2); infinite ends do not bind."""
    parts = []
    for i, (low, high) in enumerate(inward(box, precision)):
        entry = value[i]
        if np.isfinite(low):
            entry = ca.fmax(entry, low)
        if np.isfinite(high):
            entry = ca.fmin(entry, high)
        parts.append(entry)
    return ca.vertcat(*parts)


def inside(lower: ca.SX, upper: ca.SX, box: FloatArray, precision: str = "double") -> ca.SX:
    """Return 1 where the interval [lower, upper] lies in a box of shape (n, 2), else 0."""
    ends = enumerate(inward(np.clip(box, -LIMITS[precision].far, LIMITS[precision].far), precision))
    return every(ca.logic_and(lower[i] >= a, upper[i] <= b) for i, (a, b) in ends)


def all_finite(vector: ca.SX, finite: float) -> ca.SX:
    """Return 1 where every entry is a number of at most a size (`Limits.finite`), else 0."""
    return every(ca.fabs(vector[i]) <= finite for i in range(vector.numel()))


def finite_or(vector: ca.SX, other: ca.SX | ca.DM | Sequence[float], finite: float) -> ca.SX:
    """Return the vector with every entry that is no number of at most that size replaced."""
    rows = range(vector.numel())
    return column(ca.if_else(ca.fabs(vector[i]) <= finite, vector[i], other[i]) for i in rows)


def could_be_written(parts: Mapping[str, ca.SX], nonnegative: Sequence[str], real: str) -> ca.SX:
    """Return 1 where a step can have written parts of a memory, else 0.

    Some are not negative, ends of boxes are in order, the sum of all others is finite.
    """
    total, held = ca.SX(0), ca.SX(1)
    for name, part in parts.items():
        ends = parts.get(name.replace("_lower", "_upper"))
        for i in range(part.numel()):
            if name in nonnegative:
                held = ca.logic_and(held, part[i] >= 0.0)
            elif name.endswith("_lower") and ends is not None:
                held = ca.logic_and(held, part[i] <= ends[i])
            elif not (name.endswith("_upper") and name.replace("_upper", "_lower") in parts):
                total = total + part[i]
    largest = np.finfo("f4" if real == "single" else "f8").max
    return ca.logic_and(held, ca.fabs(total) <= float(largest))


def counter(count: ca.SX, limit: float) -> ca.SX:
    """Return a counter, zero in place of what lies outside of [0, limit] or is no number."""
    return ca.if_else(ca.logic_and(count >= 0.0, count <= limit), count, 0.0)


def extended(
    ode: ca.Function, sizes: Mapping[str, int], layout: Mapping[str, slice], mark: str
) -> ca.Function:
    """Return an ode of the guarded memory from a core's; what is not the core's stands still."""
    names = ode.name_in()
    ports = [ca.SX.sym(name, ode.numel_in(i)) for i, name in enumerate(names)]
    ports[0] = memory = ca.SX.sym("memory", layout["initialised"].stop)
    own = slices(sizes)
    inner = [ca.vertcat(*(memory[layout[name]] for name in own)), *ports[1:]]
    rates: Any = ode(*inner)
    moved = []
    for name, place in layout.items():
        base = name.removesuffix(mark)
        moved.append(rates[own[base]] if base in own else ca.SX(place.stop - place.start, 1))
    running = memory[layout["initialised"]] > 0.5
    together = ca.vertcat(*moved)
    outputs = select(running, together, ca.SX(together.numel(), 1))
    return ca.Function("ode", ports, [ca.densify(outputs)], names, ["dmemory"])


def make_ode(inputs: Mapping[str, ca.SX], rates: ca.SX) -> ca.Function:
    """Return a right-hand side with its inputs (memory, u, y[, theta]) in their order."""
    given = {name: value for name, value in inputs.items() if name != "theta" or value.numel()}
    return ca.Function("ode", list(given.values()), [ca.densify(rates)], list(given), ["dmemory"])


def status_word(bits: Mapping[str, ca.SX]) -> ca.SX:
    """Return the status from conditions (1 or 0) by the names of `STATUS`."""
    word = ca.SX(0)
    for name, condition in bits.items():
        word = word + STATUS[name] * condition
    return word


def make_step(
    plant: Plant, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]
) -> StepFunction:
    """Return `Observer.step` with its inputs (memory, u, y[, theta]) and outputs in their order."""
    names = [name for name in ("memory", "u", "y", "theta") if name in inputs]
    # what the two copies have in common is evaluated once
    sizes = np.cumsum([0, *(outputs[name].numel() for name in STEP_OUTPUTS)])
    together = ca.cse(ca.vertcat(*(ca.densify(outputs[name]) for name in STEP_OUTPUTS)))
    results = [together[a:b] for a, b in itertools.pairwise(sizes.tolist())]
    given = [inputs[name] for name in names]
    return named_step(ca.Function("step", given, results, names, list(STEP_OUTPUTS)), plant)
