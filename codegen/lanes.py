"""The values of a step on many inputs at once: what leads where."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import Real
from obsynth.codegen.single import lane_operations
from obsynth.codegen.tape import read_tape

_NEAR = 0.01


def differ(a: Any, b: Any) -> Any:
    """Return where arrays differ in a bit, any NaN being like any other."""
    unlike = (a != b) & ((a == a) | (b == b))
    return unlike | ((a == 0) & (b == 0) & (np.signbit(a) != np.signbit(b)))


def _passed(name: str, operands: list[Any]) -> list[Any]:
    """Return for operands (lanes,) where a small change of them changes what is made of them."""
    first, *others = operands
    if name == "choose":
        return [differ(*others), first != 0, first == 0]
    if name == "if_else_zero":
        return [others[0] != 0, first != 0]
    if name in {"fmax", "fmin"}:
        taken = (others[0] <= first) if name == "fmax" else (first <= others[0])
        return [taken, ~taken]
    if name in {"mul", "and"}:
        return [others[0] != 0, first != 0]
    if name == "or":
        return [others[0] == 0, first == 0]
    if name in {"lt", "le", "eq", "ne"}:
        near = np.abs(first - others[0]) <= _NEAR * np.maximum(np.abs(first), np.abs(others[0]))
        return [near, near]
    return [np.True_ for _ in operands]


class Lanes:
    """What the tape's writer makes of a step, evaluated by NumPy in its type.

    places: of the operands of every value; results: port, entry, place of the value
    instead: operations in place of the usual ones, by their names
    """

    def __init__(
        self,
        step: ca.Function,
        real: Real,
        instead: Mapping[str, Callable[..., Any]] | None = None,
    ) -> None:
        self.values, results = read_tape(step, real)
        self.real = real
        at = {id(value): k for k, value in enumerate(self.values)}
        self.places = [tuple(at[id(a)] for a in value.args) for value in self.values]
        self._constants = [k for k, value in enumerate(self.values) if value.name == "const"]
        numbers = [[self.values[k].number] for k in self._constants]
        self._numbers = np.array(numbers, real.type).reshape(-1, 1)
        self.results = [(port, i, at[id(value)]) for port, i, value in results]
        self._told = {k for *_, k in self.results}
        self._table = {**lane_operations(real), **(instead or {})}
        zero: Any = real.type(0.0)
        self._table["choose"] = lambda c, a, b: np.where(c != 0, a, b) + zero

    def run(self, ports: Sequence[Any], wanted: Sequence[int] | None = None) -> list[Any]:
        """Return values, all or those of a list of `needed`, for inputs (n, lanes)."""
        with np.errstate(over="ignore"):
            given = [np.asarray(port).astype(self.real.type) for port in ports]
        found: list[Any] = [None] * len(self.values)
        lanes = max((port.shape[1] for port in given), default=0)
        for k, row in zip(self._constants, self._numbers.repeat(lanes, axis=1), strict=True):
            found[k] = row
        with np.errstate(all="ignore"):
            for k in range(len(self.values)) if wanted is None else wanted:
                value = self.values[k]
                if value.name == "input":
                    found[k] = given[value.place[0]][value.place[1]]
                elif value.name != "const":
                    found[k] = self._table[value.name](*(found[p] for p in self.places[k]))
        return found

    def needed(self, wanted: Sequence[int]) -> list[int]:
        """Return the places of values and of all that they are made of, in order."""
        entered, waiting = set(wanted), [*wanted]
        while waiting:
            for place in self.places[waiting.pop()]:
                if place not in entered:
                    entered.add(place)
                    waiting.append(place)
        return sorted(entered)

    def matter(self, found: Sequence[Any]) -> list[Any]:
        """Return (lanes,) for all values, whether a small change of each reaches a result.

        Of a choice, the test matters where the branches differ; of a comparison, what is near its
        limit.
        """
        lanes = found[0].shape
        told: list[Any] = [np.zeros(lanes, bool) for _ in self.values]
        for k in self._told:
            told[k] |= True
        with np.errstate(all="ignore"):
            for k in range(len(self.values) - 1, -1, -1):
                places, seen = self.places[k], told[k]
                if places and seen.any():
                    passed = _passed(self.values[k].name, [found[p] for p in places])
                    for place, through in zip(places, passed, strict=True):
                        told[place] |= seen & through
        return told
