"""What a simulation needs of an observer."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from obsynth.symbolic import Plant

Array = NDArray[np.float64]


class StepObserver(Protocol):
    """What a simulation needs of an observer; every method's observer has it."""

    @property
    def model(self) -> Plant:
        """Discrete plant for which the guarantee holds."""

    @property
    def method(self) -> str:
        """Name of the method."""

    @property
    def step(self) -> Any:
        """``casadi.Function`` (memory, u, y[, theta]) -> (memory, xhat, ..., status)."""

    @property
    def fault_delay(self) -> int:
        """0 when the step at instant k bounds f_k, 1 when it bounds f_{k-1}."""

    @property
    def half_widths(self) -> Array | None:
        """Steady half widths of states, then faults."""

    def memory0(
        self,
        guess: ArrayLike,
        x_range: ArrayLike | None = None,
        f_range: ArrayLike | None = None,
        y0: ArrayLike | None = None,
    ) -> Array:
        """Memory before the first step."""
