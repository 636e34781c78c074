"""The step of every method: ``guard(core cut with contractor)``.

A method gives a `Core`. Everything else that a step does is here, once: which readings are used,
what is void, where sets start again, how long anything is remembered, and the status word. What
that guarantees is Theorems 1 and 2 of docs/step.md: two copies of sets and bounds are carried, of
which the older is given up at the age of 2 N calls and the younger takes its place at the age N.
Estimates need no second copy: a core is begun around whatever its estimate is.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.rigour import outward
from obsynth.designs.core.backward import Sweeps
from obsynth.designs.core.boxes import LIMITS, near_box
from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.contractor import CUTS, EVERY_CUT, Contractor, Cut
from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.half_widths import MOST_PASSES, HalfWidths
from obsynth.designs.core.record import Precision, precision_of
from obsynth.designs.core.stepping import slices
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

HORIZON = 400
"""N where nothing else is said."""
MOST_CALLS = 10**9
"""N of what is never given up."""
MOST_COUNTED = 2**22
"""N in single precision, whose whole numbers end at four times that; `MOST_CALLS` is never."""
_LATE = 2
YOUNG = "_2"
"""What the names of the younger copy's parts of the memory end with."""


@dataclass(frozen=True)
class Watch:
    """Options of the guard, see `Method`; horizon None: what the core takes to settle."""

    horizon: int | None
    recovery: int
    cuts: tuple[Cut, ...]
    precision: Precision = "double"

    @property
    def calls(self) -> int:
        """N where a core does not say how long its bounds take to settle."""
        return HORIZON if self.horizon is None else self.horizon

    @classmethod
    def of(cls, options: Mapping[str, object]) -> "Watch":
        """Read what a design stores, or refuse it."""
        horizon, recovery, cuts = (options.get(name) for name in ("horizon", "recovery", "cuts"))
        given = HORIZON if horizon is None else horizon
        named: Any = CUTS if cuts is None else cuts
        known = isinstance(named, list | tuple) and all(name in EVERY_CUT for name in named)
        counts = [n for n in (given, recovery) if isinstance(n, int) and 1 <= n <= MOST_CALLS]
        counted = MOST_CALLS if precision_of(options) == "double" else MOST_COUNTED
        if not known or len(counts) < 2 or counted < counts[0] < MOST_CALLS:
            raise CertificateError(
                f"the stored design cannot be read: horizon {horizon!r}, recovery {recovery!r} and "
                f"cuts {cuts!r} are no options of the guard"
            )
        found = None if horizon is None else counts[0]
        used = tuple(c for c in EVERY_CUT if c in named)
        return cls(found, counts[1], used, precision_of(options))


@dataclass(frozen=True, eq=False)
class Guard:
    """What watches over the core of a design: its memory, its horizon, what is returned in the end.

    sizes, shared, settle: parts of the core's memory and more, see `Contract`
    delay: of the fault interval, 0 or 1
    Ts: from one call to the next
    """

    plant: Plant
    sizes: Mapping[str, int]
    watch: Watch
    delay: int
    Ts: float
    shared: tuple[str, ...] = ()
    settle: Callable[[FloatArray, int | None], tuple[int, FloatArray] | None] | None = None

    @property
    def precision(self) -> Precision:
        """In which the step runs."""
        return self.watch.precision

    @property
    def discrete(self) -> bool:
        """Whether sets are carried from call to call."""
        return self.plant.Ts is not None

    @property
    def boxes(self) -> dict[str, int]:
        """Parts of the memory of each copy that are ends of its sets, and their sizes."""
        sizes = {"x": len(self.plant.x)} if self.discrete else {}
        sizes["f"] = len(self.plant.f)
        if self.sweeps is not None:
            sizes["rest"] = len(self.sweeps.carried)
        return {f"{k}_{end}": size for k, size in sizes.items() for end in ("lower", "upper")}

    def layout(self) -> dict[str, slice]:
        """Return where the parts of the memory are; the older copy has the core's own names."""
        known = len(self.plant.u) + sum(s.measured for s in self.plant.rho)
        single = dict(self.sizes)
        own = {k: s for k, s in single.items() if k not in self.shared}
        twice = own | self.boxes | {"begin": 1}
        young = {name + YOUNG: size for name, size in twice.items()}
        before = {"before": known} if self.discrete else {}
        ends = {"age": 1, "since": 1, "initialised": 1}
        return slices({k: s for k, s in (single | twice | young | before | ends).items() if s})

    def first(
        self, parts: Mapping[str, ArrayLike], x: FloatArray, f: FloatArray
    ) -> dict[str, ArrayLike]:
        """Return the first memory: a discrete core begins at the first call, from boxes."""
        boxes = {"x": x, "f": f} if self.discrete else {"f": self.plant.box("f")}
        if self.sweeps is not None:
            boxes["rest"] = self.sweeps.declared[self.sweeps.carried]
        ends: dict[str, ArrayLike] = {}
        layout = self.layout()
        for name, box in boxes.items():
            near = outward(near_box(box, self.precision), self.precision)
            ends |= {f"{name}_lower": near[:, 0], f"{name}_upper": near[:, 1]}
        own = {**parts, **ends, "begin": np.array([float(self.discrete)])}
        both = own | {k + YOUNG: v for k, v in own.items() if k not in self.shared}
        both["since"] = np.array([float(self.watch.recovery)])
        return {k: v for k, v in both.items() if k in layout}

    @cached_property
    def contractor(self) -> Contractor:
        """What the data say by themselves."""
        return Contractor(self.plant, self.Ts, self.watch.cuts, self.precision)

    @cached_property
    def sweeps(self) -> Sweeps | None:
        """What the equations say in both directions, where that is asked for."""
        asked = self.discrete and "sweeps" in self.watch.cuts
        return Sweeps(self.contractor) if asked else None

    @cached_property
    def half_widths(self) -> HalfWidths:
        """How wide the sets are that the contractor leaves."""
        return HalfWidths(self.contractor, self.delay)

    @cached_property
    def settled(self) -> tuple[int, FloatArray | None, int]:
        """N, half widths of a core that settled since N calls, and the contractor's calls."""
        horizon = self.watch.horizon
        late = _LATE if horizon is None else min(_LATE, horizon - 1)
        passes = MOST_PASSES if horizon is None else min(MOST_PASSES, (horizon - late) // 2)
        given = None if horizon is None else horizon - late - passes
        found = None if self.settle is None else self.settle(self.half_widths.begun, given)
        if found is None:
            return self.watch.calls, None, min(MOST_PASSES, self.watch.calls - 1)
        calls, widths = found
        if np.isinf(widths).all():
            # what begins from a set without bounds would be lost for good
            return MOST_CALLS if horizon is None else horizon, None, passes
        if horizon is not None:
            return horizon, widths, passes
        passes = self.half_widths.steady(widths)[1]
        return calls + late + passes, widths, passes

    @property
    def horizon(self) -> int:
        """N."""
        return self.settled[0]

    def widths(self, core: FloatArray | None, nominal: bool = False) -> FloatArray | None:
        """Return steady half widths of the returned sets; nominal: predicted, not guaranteed."""
        _, own, passes = self.settled
        own = core if own is None else own
        own = np.full(len(self.plant.x) + len(self.plant.f), np.inf) if own is None else own
        found, _ = replace(self.half_widths, nominal=nominal).steady(own, passes)
        return found if np.isfinite(found).any() else None


def monitored(guarantee: Guarantee, guard: Guard, mean: bool) -> Guarantee:
    """Add what the guard makes of a guarantee, and where it ends; mean: of means of faults."""
    plant, N = guard.plant, guard.horizon
    faults = "what is claimed of the faults" if mean else "the faults"
    single = guard.precision == "single"
    claims = [
        f"the returned sets hold the state and {faults} at every instant k for which the "
        "assumptions held at all instants after the last void one (status bit 8), or from the "
        "first call on if there was none, up to k",
    ]
    if not single or N <= MOST_COUNTED:
        claims.append(
            f"whatever happened up to an instant v, noticed or not: the returned sets hold them "
            f"after v + {2 * N} calls if the assumptions hold after v"
        )
    if single:
        claims.append(
            "all of this with every number and operation of the step rounded to IEEE single "
            "precision, readings too: true ones that are rounded to it are read"
        )
    loose = [s for s in plant.x if not s.bounded]
    assumptions = [
        "a violation of an assumption that contradicts neither the readings nor the sets is not "
        f"noticed, and sets may then be wrong at status 0 for at most {2 * N} calls after its end",
        "a reading outside its declared range is left out (status bit 32); one that the declared "
        "ranges exclude, or an empty set, is void (bit 8): the declared ranges are returned, and "
        "sets begin anew from them",
    ]
    if single:
        assumptions.append(
            "inputs and measured scheduling are numbers of single precision, and what the plant "
            f"gets; signals without a declared range stay below {LIMITS['single'].far:.1e}"
        )
    limits = guard.contractor.domain[:, 0].tolist()
    at_once = [s for s, low in zip(plant.x, limits, strict=True) if s.bounded and low == -np.inf]
    if at_once:
        assumptions.append(
            f"{', '.join(s.name for s in at_once)} inside of declared ranges at the instants at "
            "which sets begin anew: after a void one or an input that is missing, after a missing "
            f"reading if nothing else bounds them, and every {N} calls"
        )
    if loose:
        assumptions.append(
            f"{', '.join(s.name for s in loose)} has no declared range: after a void instant it is "
            "unbounded until a reading or the equations bound it"
        )
    return Guarantee((*guarantee.claims, *claims), (*guarantee.assumptions, *assumptions))
