"""Was the run inside the domain of the guarantee, and what did the observer say about itself?"""

import html
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import STATUS

_WORDS = {
    "not_initialised": "not initialised: no measurement has been processed yet",
    "non_finite_input": "a measurement was not finite; the step predicted without it",
    "outside_domain": "the returned set is not inside the box of the guarantee",
    "inconsistent_measurement": "the measurement contradicts the set: an assumption is broken",
    "fault_not_valid": "the fault interval is not valid at this instant",
}


@dataclass(frozen=True)
class StatusCount:
    """How often one bit of the status was set."""

    bit: int
    count: int
    first: int
    meaning: str

    def __str__(self) -> str:
        return f"status {self.bit} at {self.count} instants, first k = {self.first}: {self.meaning}"


@dataclass(frozen=True, eq=False)
class Domain:
    """Where truth and estimate stood relative to the box of the guarantee.

    Parameters
    ----------
    x_inside, xhat_inside : (N + 1,) bool arrays
        True where every state is inside its range.
    left : tuple of str
        One sentence for each state that left, with the first instant.
    status : tuple of StatusCount
        Bits of the status that occurred.
    """

    x_inside: NDArray[np.bool_]
    xhat_inside: NDArray[np.bool_]
    left: tuple[str, ...]
    status: tuple[StatusCount, ...]

    @property
    def ok(self) -> bool:
        """Both truth and estimate stayed inside the box at every instant."""
        return bool(self.x_inside.all() and self.xhat_inside.all())

    @classmethod
    def of(
        cls,
        x: NDArray[np.float64],
        xhat: NDArray[np.float64],
        box: NDArray[np.float64],
        status: NDArray[np.int64],
        names: tuple[str, ...],
    ) -> "Domain":
        """Compare trajectories with the box, and count the bits of the status."""
        left: list[str] = []
        inside = []
        for word, values in (("", x), ("the estimate of ", xhat)):
            within = np.asarray((values >= box[:, 0]) & (values <= box[:, 1]))
            inside.append(np.asarray(within.all(axis=1)))
            for i, name in enumerate(names):
                outside = np.flatnonzero(~within[:, i])
                if outside.size:
                    k = int(outside[0])
                    left.append(
                        f"{word}{name} is outside [{box[i, 0]:g}, {box[i, 1]:g}] at "
                        f"{outside.size} instants, first k = {k}: {values[k, i]:.6g}"
                    )
        return cls(inside[0], inside[1], tuple(left), count_status(status))

    def __str__(self) -> str:
        n = len(self.x_inside)
        head = (
            f"x and xhat are inside the box at all {n} instants"
            if self.ok
            else f"x is inside the box at {int(self.x_inside.sum())} of {n} instants, "
            f"xhat at {int(self.xhat_inside.sum())}"
        )
        return "\n".join([head, *self.left, *(str(count) for count in self.status)])

    def _repr_html_(self) -> str:
        first, *rest = (html.escape(line) for line in str(self).splitlines())
        items = "".join(f"<li>{line}</li>" for line in rest)
        return f"<p>{first}.</p>" + (f"<ul>{items}</ul>" if items else "")


def count_status(status: NDArray[np.int64]) -> tuple[StatusCount, ...]:
    """Count each bit that occurs; bits without a meaning are named as such."""
    meanings = {bit: _WORDS.get(name, name) for name, bit in STATUS.items()}
    counts = []
    seen = int(np.bitwise_or.reduce(status)) if status.size else 0
    for bit in (1 << i for i in range(seen.bit_length())):
        at = np.flatnonzero(status & bit)
        if at.size:
            meaning = meanings.get(bit, "a bit that this version does not know")
            counts.append(StatusCount(bit, int(at.size), int(at[0]), meaning))
    return tuple(counts)
