"""`StepFunction`: the step as a CasADi function that says which argument does not fit, and why."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.taking import labelled

_KINDS = {"u": "inputs", "y": "outputs", "theta": "measured scheduling variables"}


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
