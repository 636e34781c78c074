"""Was the run inside the domain of the guarantee, and what did the observer say about itself?"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.detection.comparison import RECOVERING, VOID, Void, find_voids, list_voids
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown, card

_WORDS = {
    1: "not initialised: no measurement has been processed yet",
    2: "an input or scheduling variable was not finite: the sets start anew",
    4: "the returned set is not inside the domain of the guarantee",
    VOID: "void: a set is empty or a measurement impossible, so an assumption has failed since the "
    "last void or the start; the sets start anew",
    16: "the fault interval is not valid at this instant",
    32: "a measurement was missing or outside its declared range, and left out",
    RECOVERING: "recovering: soon after a void",
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


@dataclass(frozen=True, eq=False, repr=False)
class Domain(Shown):
    """Where truth and estimate stood relative to the box of the guarantee, (N + 1,) each.

    left: one sentence for each state that left, with the first instant and how far
    status, voids: bits of the status that occurred; stretches of void and recovering instants
    """

    x_inside: NDArray[np.bool_]
    xhat_inside: NDArray[np.bool_]
    left: tuple[str, ...]
    status: tuple[StatusCount, ...]
    voids: tuple[Void, ...] = ()

    @property
    def ok(self) -> bool:
        """Both truth and estimate stayed inside the box at every instant."""
        return bool(self.x_inside.all() and self.xhat_inside.all())

    @property
    def refuted(self) -> bool:
        """Whether the observer was void at an instant, which no kept assumption allows."""
        return any(count.bit == VOID for count in self.status)

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
        inside = [np.asarray(((v >= box[:, 0]) & (v <= box[:, 1])).all(axis=1)) for v in (x, xhat)]
        left = outside_box(x, box, names, "range")
        left += outside_box(xhat, box, [f"the estimate of {name}" for name in names], "range")
        return cls(inside[0], inside[1], tuple(left), count_status(status), find_voids(status))

    def __str__(self) -> str:
        n = len(self.x_inside)
        head = (
            f"x and xhat are inside the box at all {n} instants"
            if self.ok
            else f"x is inside the box at {int(self.x_inside.sum())} of {n} instants, "
            f"xhat at {int(self.xhat_inside.sum())}"
        )
        voids = list_voids(self.voids)
        return "\n".join([head, *self.left, *map(str, self.status), *voids])

    def _repr_html_(self) -> str:
        first, *rest = str(self).splitlines()
        return card("", f"{first}.", rest)


def count_status(status: NDArray[np.int64]) -> tuple[StatusCount, ...]:
    """Count each bit that occurs; bits without a meaning are named as such."""
    counts = []
    seen = int(np.bitwise_or.reduce(status)) if status.size else 0
    for bit in (1 << i for i in range(seen.bit_length())):
        at = np.flatnonzero(status & bit)
        if at.size:
            meaning = _WORDS.get(bit, "a bit that this version does not know")
            counts.append(StatusCount(bit, int(at.size), int(at[0]), meaning))
    return tuple(counts)


def outside_box(values: FloatArray, box: FloatArray, names: Sequence[str], word: str) -> list[str]:
    """Say which signals leave their box, (N + 1, n) and (n, 2): when, how often and how far."""
    said = []
    for i, name in enumerate(names):
        beyond = np.maximum(box[i, 0] - values[:, i], values[:, i] - box[i, 1])
        out = np.flatnonzero(~(beyond <= 0))
        if out.size:
            k = int(out[0])
            said.append(
                f"{name} is outside its {word} [{box[i, 0]:g}, {box[i, 1]:g}] at {out.size} "
                f"instants, first k = {k}: {values[k, i]:.6g}; at most {beyond.max():.4g} beyond"
            )
    return said
