"""What a method gives for its step: what it knows of its own from call to call."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca

from obsynth.designs.core.backward import Pair
from obsynth.designs.core.boxes import Ends, every
from obsynth.symbolic.arrays import FloatArray

Parts = Mapping[str, ca.SX]
"""Parts of a memory by their names."""


@dataclass(frozen=True, eq=False)
class Seen:
    """What a core is given at one instant.

    memory: its parts
    u, theta: inputs and measured scheduling, made finite
    y: readings, zero where they are not used
    used: 1 where a reading is used, for every output
    around: boxes of this instant and the one before, where the sweeps find them
    """

    memory: Parts
    u: ca.SX
    theta: ca.SX
    y: ca.SX
    used: Sequence[ca.SX]
    around: Pair | None = None

    @property
    def all_used(self) -> ca.SX:
        """1 where no reading is missing."""
        return every(self.used)

    def readings(self, expected: ca.SX) -> ca.SX:
        """Return the readings, what is expected in place of those that are not used."""
        pairs = enumerate(self.used)
        return ca.vertcat(*(ca.if_else(bit, self.y[i], expected[i]) for i, bit in pairs))


@dataclass(frozen=True, eq=False)
class Known:
    """What a core says at one instant, and its memory for the next.

    xhat, fhat: estimates
    x, f: sets of the state, and of the fault `Core.delay` calls before; None without a bound
    moved: the parts of the memory
    sound: 1 where the next memory keeps the core's guarantee; it begins anew elsewhere
    empty: 1 where the core contradicts the readings
    outside: 1 where the sets are not inside the domain of the guarantee
    valid: 1 where the fault estimate means something
    """

    xhat: ca.SX
    fhat: ca.SX
    x: Ends | None
    f: Ends | None
    moved: Parts
    sound: ca.SX = field(default_factory=lambda: ca.SX(1))
    empty: ca.SX = field(default_factory=lambda: ca.SX(0))
    outside: ca.SX = field(default_factory=lambda: ca.SX(0))
    valid: ca.SX = field(default_factory=lambda: ca.SX(1))


@dataclass(frozen=True, eq=False)
class Core:
    """What a method knows, without what the data say by themselves.

    run: the instant's sets and the next memory
    advance: what the memory of the call before says of this instant, before its readings; for cores
        whose memory speaks of the call before
    begin: parts of the memory that hold for a state and a fault in boxes, around the estimates
        given; for parts that are not shared
    place: estimates (the parts that `Contract.shared` names) from boxes, where those given are of
        no use; None where nothing is shared
    domain: ranges that the method needs its states to stay in, (n, 2), infinite where it does not;
        None for those on which a derivative depends
    bridges: whether a missing reading is the core's own business; without, it begins anew after one
    mean_fault: whether its fault interval holds a mean over time
    nonnegative: parts of its memory that are never negative, and may be infinite; two parts called
        ``..._lower`` and ``..._upper`` are ends in order, all others are finite
    """

    run: Callable[[Seen], Known]
    begin: Callable[[Ends, Ends, Parts], Parts]
    place: Callable[[Ends, Ends, Parts], Parts] | None = None
    domain: FloatArray | None = None
    bridges: bool = False
    mean_fault: bool = False
    advance: Callable[[Seen], Parts] | None = None
    nonnegative: tuple[str, ...] = ()
