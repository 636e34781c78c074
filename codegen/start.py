"""How the first memory depends on a guess and on first ranges, as sums that C can form."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.codegen.kernel import DOUBLE, REALS, Real
from obsynth.derive.equilibrium import operating_values
from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import LIMITS
from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_SCALES = (1.0, 1.0, 1.0, 0.3, 0.01, 1e-4)
_ROUNDED = 1e-13


@dataclass(frozen=True)
class Variable:
    """A variable of a unit for co-simulation.

    field: of the structs of the C interface; empty for parameters
    first: start value, or the value before the first step
    lower, upper: limits of a parameter
    """

    name: str
    type: Literal["Real", "Boolean", "Integer"]
    causality: Literal["parameter", "input", "output"]
    field: str
    first: float
    description: str
    unit: str = ""
    lower: float = -np.inf
    upper: float = np.inf


@dataclass(frozen=True, eq=False)
class Start:
    """A first memory, for the start values of its parameters, and what it is made of.

    parameters: parts of the guess, so many as there are guesses, then pairs of ends of ranges
    rules: entries of the memory that depend on parameters v, in C; ``outward(v, way)`` is the next
        number of single precision that way
    largest: numbers of larger size are no start values
    """

    memory: FloatArray
    largest: float
    parameters: tuple[Variable, ...] = ()
    guesses: int = 0
    rules: tuple[tuple[int, str], ...] = ()


def start_of(
    observer: Observer | FaultDetector,
    guess: ArrayLike | None = None,
    x_range: ArrayLike | None = None,
    f_range: ArrayLike | None = None,
) -> Start:
    """Return what `memory0` returns, and the numbers on which its entries depend as sums.

    What is not finite, or something depends on in another way, is left out.
    """
    model = observer.model
    inner = observer.observer if isinstance(observer, FaultDetector) else observer
    real, largest = REALS[inner.precision], LIMITS[inner.precision].finite
    fixed = {
        "guess": np.asarray(operating_values(model, "x") if guess is None else guess, dtype=float),
        "x_range": x_range,
        "f_range": f_range,
    }
    memory = np.asarray(observer.memory0(**fixed), dtype=float)

    def made(**given: Any) -> FloatArray | None:
        try:
            return np.asarray(observer.memory0(**{**fixed, **given}), dtype=float)
        except ObsynthError:
            return None

    x, f = (np.asarray(model.box(kind), dtype=float).reshape(-1, 2) for kind in "xf")
    boxes = {"guess": x, "x_range": x, "f_range": f}
    # a first set is for no faults, or for faults anywhere in their ranges
    tried = {name: [fixed[name]] for name in boxes}
    tried["x_range"] += [x]
    tried["f_range"] += [np.zeros(f.shape), f]
    starts: dict[str, FloatArray] = {}
    for name, candidates in tried.items():
        for value in (np.asarray(one, dtype=float) for one in candidates if one is not None):
            if np.all(np.abs(value) <= largest) and _same(made(**{name: value}), memory):
                starts.setdefault(name, value)
    for count in range(len(starts), 0, -1):
        for names in combinations(starts, count):
            chosen = {name: starts[name] for name in names}
            rules = _rules(made, memory, chosen, boxes, real)
            if rules:
                parts = [p for name in names for p in _parameters(observer, name, chosen[name])]
                guesses = len(chosen.get("guess", ()))
                return Start(memory, largest, tuple(parts), guesses, rules)
    return Start(memory, largest)


def _same(one: FloatArray | None, other: FloatArray) -> bool:
    return one is not None and np.array_equal(one, other, equal_nan=True)


def _drawn(start: FloatArray, box: FloatArray, scale: float, rng: np.random.Generator) -> Any:
    """Return a guess, or ranges, within declared ranges or nearer to the start."""
    ends = np.clip(box, -1e3, 1e3)
    drawn = np.sort(rng.uniform(ends[:, 0], ends[:, 1], (start.ndim, len(box))), axis=0)
    return start + scale * ((drawn.T if start.ndim == 2 else drawn[0]) - start)


def _rules(
    made: Callable[..., FloatArray | None],
    memory: FloatArray,
    starts: Mapping[str, FloatArray],
    boxes: Mapping[str, FloatArray],
    real: Real,
) -> tuple[tuple[int, str], ...]:
    """Return entries of the memory as copies, middles or sums; none if that is not what they are.

    Each start, flattened, is a part of the vector of parameters v; all of them have to matter.
    """
    rng = np.random.default_rng(0)
    draws = [{k: _drawn(v, boxes[k], s, rng) for k, v in starts.items()} for s in _SCALES]
    found = [made(**draw) for draw in draws]
    rows = [row for row in found if row is not None]
    if len(rows) < len(draws):
        return ()
    m = np.array(rows)
    v = np.array([np.concatenate([value.ravel() for value in draw.values()]) for draw in draws])
    guesses = len(starts.get("guess", ()))
    base, *ones = (made(guess=e) if guesses else None for e in np.eye(guesses + 1, guesses, -1))
    rules = []
    for i in np.flatnonzero(np.any((m != memory) & ~(np.isnan(m) & np.isnan(memory)), axis=0)):
        rule = _rule(m[:, i], v, guesses, real)
        if not rule and base is not None:
            linear = [one[i] - base[i] for one in ones if one is not None]
            rule = _sum(m[:, i], v, [float(base[i]), *linear])
        if not rule:
            return ()
        rules.append((int(i), rule))
    k = 0
    for value in starts.values():
        if not any(f"v[{j}]" in rule for j in range(k, k + value.size) for _, rule in rules):
            return ()
        k += value.size
    return tuple(rules)


def _rule(entry: FloatArray, v: FloatArray, guesses: int, real: Real) -> str:
    """Return an entry, (draws,), as a parameter or the middle of a range; empty if it is none."""
    found = [(f"v[{k}]", [column]) for k, column in enumerate(v.T)]
    found += [(rule, [column.astype(real.type)]) for rule, (column,) in found[:guesses]]
    for k in range(guesses, v.shape[1], 2):
        middle = 0.5 * (v[:, k] + v[:, k + 1])
        found.append((f"0.5 * (v[{k}] + v[{k + 1}])", [middle, middle.astype(real.type)]))
        ends = outward(v[:, k : k + 2], real.precision).T
        found += [
            (f"outward(v[{k + i}], {way}INFINITY)", [ends[i]]) for i, way in enumerate(("-", ""))
        ]
    fits = (rule for rule, forms in found if any(np.array_equal(entry, form) for form in forms))
    return next(fits, "")


def _sum(entry: FloatArray, v: FloatArray, terms: list[float]) -> str:
    """Return an entry as a constant and multiples of parts of the guess; empty if it is none."""
    constant, *factors = terms
    guess = v[:, : len(factors)]
    size = abs(constant) + np.abs(guess) @ np.abs(factors)
    if not np.all(np.abs(entry - constant - guess @ factors) <= _ROUNDED * size):
        return ""
    parts = [DOUBLE.number(constant)] * (constant != 0.0)
    parts += [f"{DOUBLE.number(c)} * v[{j}]" for j, c in enumerate(factors) if c != 0.0]
    return " + ".join(parts)


def _parameters(
    observer: Observer | FaultDetector, group: str, start: FloatArray
) -> list[Variable]:
    """Return the parameters of a guess, (n,), or of ranges, (n, 2)."""
    ranges = group != "guess"
    kind, words = (group[0], ["first_lower", "first_upper"]) if ranges else ("x", ["guess"])
    limits = np.asarray(observer.model.box(kind), dtype=float).reshape(-1, 2)
    if not ranges:
        limits = np.full(limits.shape, [-np.inf, np.inf])
    found = []
    for s, row, pair in zip(getattr(observer.model, kind), start, limits.tolist(), strict=True):
        for word, value in zip(words, np.atleast_1d(row).tolist(), strict=True):
            told = f"{word.replace('_', ' ')} of {s.name}"
            name = f"{s.name}_{word}"
            found.append(Variable(name, "Real", "parameter", "", value, told, s.unit, *pair))
    return found
