"""Which faults can be seen, and which can be told apart, whatever the unknown inputs do."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.derive.errors import StructureError
from obsynth.derive.structure.frozen import freeze, precision, rank, transfer
from obsynth.symbolic.plant import Plant
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes

# Real numbers off the usual poles and zeros; a rank below the generic one has probability zero.
_FREQUENCIES = (1.3717, -0.8391, 2.1173)


@dataclass(frozen=True, eq=False, repr=False)
class FaultIsolability(Shown):
    """What the outputs say about single faults.

    faults: names of the faults
    unknown: unknown inputs, of which the statements are independent
    detectable (n_f,): whether some residual that no unknown input reaches sees the fault
    isolable (n_f, n_f): row i, column j: whether some residual sees fault i but neither fault j nor
        the unknown inputs. Symmetric for faults that are detectable
    groups: detectable faults that cannot be told from each other; a fault on its own can be told
        from every other one
    joint_rank, unknown_rank: normal rank of the transfer matrix with all faults, and without: their
        difference is how many faults can be estimated at the same time
    """

    faults: tuple[str, ...]
    unknown: tuple[str, ...]
    detectable: NDArray[np.bool_]
    isolable: NDArray[np.bool_]
    groups: tuple[tuple[str, ...], ...]
    joint_rank: int
    unknown_rank: int

    @property
    def unique(self) -> tuple[str, ...]:
        """Faults that can be told from every other one."""
        return tuple(group[0] for group in self.groups if len(group) == 1)

    @property
    def at_once(self) -> int:
        """How many faults can be estimated at the same time."""
        return self.joint_rank - self.unknown_rank

    def require(self, detect: Iterable[str] = (), isolate: Iterable[str] = ()) -> None:
        """Refuse a specification that no residual generator can meet, by a StructureError.

        detect: faults to be seen in spite of the unknown inputs
        isolate: faults to be told from each other and from all other faults
        """
        wanted = [str(name) for name in detect]
        apart = [str(name) for name in isolate]
        for name in [*wanted, *apart]:
            if name not in self.faults:
                raise StructureError(
                    f"{name} is no fault of the plant; faults are {', '.join(self.faults)}",
                    symbol=name,
                    symbols=(name,),
                )
        hidden = [n for n in [*wanted, *apart] if not self.detectable[self.faults.index(n)]]
        if hidden:
            behind = f"does not respond to {', '.join(self.unknown)}" if self.unknown else "exists"
            raise StructureError(
                f"the fault {hidden[0]} cannot be detected: no residual that {behind} sees it "
                f"(rank of the transfer matrix is {self.unknown_rank} with and without "
                f"{hidden[0]}). Measure more, or drop {hidden[0]} from what is asked for",
                condition="detectability of a fault",
                symbol=hidden[0],
                symbols=tuple(hidden),
            )
        for group in self.groups:
            mixed = [name for name in apart if name in group]
            if mixed and len(group) > 1:
                others = ", ".join(name for name in group if name != mixed[0])
                raise StructureError(
                    f"the fault {mixed[0]} cannot be told from {others}: whatever one of them "
                    "does to the outputs, another could do as well. Measure what separates them, "
                    "or ask for the group as one",
                    condition="isolability",
                    symbol=mixed[0],
                    symbols=group,
                )

    def __str__(self) -> str:
        if not self.faults:
            return "no faults"
        hidden = [n for n, seen in zip(self.faults, self.detectable, strict=True) if not seen]
        parts = []
        if self.unique:
            parts.append(f"{', '.join(self.unique)} can be told from every other single fault")
        parts += [
            f"{', '.join(group)} cannot be told from each other"
            for group in self.groups
            if len(group) > 1
        ]
        if hidden:
            reason = f"behind {', '.join(self.unknown)}" if self.unknown else "from the outputs"
            parts.append(f"{', '.join(hidden)} hidden {reason}")
        parts.append(f"at most {self.at_once} at the same time")
        return "; ".join(parts)

    def _repr_html_(self) -> str:
        rows = [
            (name, "yes" if seen else "no", *("yes" if ok else "\u00b7" for ok in row))
            for name, seen, row in zip(self.faults, self.detectable, self.isolable, strict=True)
        ]
        return Table(str(self), ("fault", "seen", *self.faults), rows)._repr_html_()


@takes(model="Plant")
def fault_isolability(model: Plant) -> FaultIsolability:
    """Tell which single faults can be seen and which can be told apart.

    Fault i can be told from fault j when its column of the transfer matrix is no combination, with
    rational functions as coefficients, of the columns of fault j and of the unknown inputs (Varga,
    Solving Fault Diagnosis Problems, section 3.3). The ranks are those of the plant frozen at
    random points of its box, in 40 digits; faults may enter in any way. For a discretised plant
    the continuous one is looked at. Disturbances and noise do not count: they blur a residual,
    but do not hide a fault for ever.

    Parameters
    ----------
    model : Plant
        Any plant; no equilibrium and no split is needed.

    Returns
    -------
    FaultIsolability
        ``.require(detect=..., isolate=...)`` refuses what cannot be had.

    Raises
    ------
    DerivationError
        Derivatives that are not finite inside the box.

    Examples
    --------
    >>> from obsynth.symbolic.plants import quadruple_tank
    >>> str(fault_isolability(quadruple_tank()))
    'f1, f2 can be told from every other single fault; at most 2 at the same time'
    """
    # the equations of a continuous plant are shorter than those of its step
    plant = model.check().continuous or model
    names = plant.names("f")
    n_f, q = len(names), len(plant.d)
    points = freeze(plant) if n_f or q else []

    with precision():
        tables = [transfer(frozen, at) for frozen, at in zip(points, _FREQUENCIES, strict=False)]

        def normal_rank(faults: tuple[int, ...]) -> int:
            columns = [*range(q), *(q + k for k in faults)]
            return max(
                (rank([[row[c] for c in columns] for row in table]) for table in tables), default=0
            )

        base = normal_rank(())
        single = [normal_rank((k,)) for k in range(n_f)]
        detectable = np.array([r > base for r in single], dtype=bool)
        isolable = np.zeros((n_f, n_f), dtype=bool)
        for i in range(n_f):
            for j in range(n_f):
                both = single[j] if i == j else normal_rank((min(i, j), max(i, j)))
                isolable[i, j] = both > single[j]
        joint = normal_rank(tuple(range(n_f)))
    groups: list[tuple[str, ...]] = []
    seen: set[int] = set()
    for i in np.flatnonzero(detectable).tolist():
        if i not in seen:
            alike = [j for j in np.flatnonzero(detectable).tolist() if not isolable[i, j]]
            seen |= set(alike)
            groups.append(tuple(names[j] for j in alike))
    return FaultIsolability(
        names, plant.names("d"), detectable, isolable, tuple(groups), joint, base
    )
