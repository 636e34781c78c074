"""What a fault detector did in a run: events, delays, false alarms."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.observer import STATUS
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown, card

BoolArray = NDArray[np.bool_]
LISTED = 5
VOID, RECOVERING = STATUS["void"], STATUS["recovering"]


@dataclass(frozen=True)
class Void:
    """Voids from first to last, how many, and the last instant that recovers from them."""

    first: int
    last: int
    count: int
    until: int

    def __str__(self) -> str:
        at = f"k = {self.first}" + (f" to {self.last}" if self.last > self.first else "")
        after = f", recovering until k = {self.until}" if self.until > self.last else ""
        return f"void at {self.count} instant{'s' if self.count > 1 else ''}, {at}{after}"


@dataclass(frozen=True)
class FaultEvent:
    """A stretch of instants at which one fault was there.

    Attributes
    ----------
    fault : str
    onset, end : int
        First and last instant of the fault.
    peak : float
        Its largest magnitude.
    promised : int or None
        Instant up to which an alarm was promised: by then the fault had been larger than its
        interval is long at as many consecutive valid samples as the alarm takes. None: it never
        was, so it may be missed, or the method does not predict steady widths of the fault.
    alarm : int or None
        Instant at which the alarm was first raised for it; None: missed.
    delay : float or None
        Seconds from the onset to the alarm.
    level : float or None
        Magnitude of the fault at the instant that the alarm speaks of.
    others : tuple of str
        Faults that were not there but whose alarm was raised together with it.
    violation : int or None
        Void instant that ended the alarm: some assumption failed before, so that the alarm proves
        nothing.
    """

    fault: str
    onset: int
    end: int
    peak: float
    promised: int | None
    alarm: int | None = None
    delay: float | None = None
    level: float | None = None
    others: tuple[str, ...] = ()
    violation: int | None = None

    @property
    def isolated(self) -> bool:
        """Whether the alarm pointed at this fault and at none that was not there."""
        return self.alarm is not None and not self.others

    def __str__(self) -> str:
        head = f"{self.fault} from k = {self.onset} to {self.end} (peak {self.peak:.4g})"
        if self.alarm is None:
            promise = "" if self.promised is None else f", promised at k = {self.promised}"
            return f"{head}: no alarm{promise}"
        others = f", together with {', '.join(self.others)}" if self.others else ""
        if self.violation is not None:
            others += f", before the violation at k = {self.violation}"
        return (
            f"{head}: alarm at k = {self.alarm}, {self.delay:.6g} s after its onset, at "
            f"{self.level:.4g}{others}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Detection(Shown):
    """Alarms of a run compared with the faults that were there.

    Attributes
    ----------
    alarm : (N + 1, n_f) bool
        The alarms that the detector raised at each instant.
    names : tuple of str
        The faults.
    events : tuple of FaultEvent
        In order of their onset.
    false_alarms : mapping of str to int
        Instants with an alarm for a fault that had not been there up to then.
    lingering : mapping of str to int
        Instants with an alarm for a fault that had been there and was zero again. Bounds of a
        fault at one instant never do that; bounds of its mean over a window may.
    before_violation : mapping of str to int
        Instants of alarms that stood until a void instant, right or wrong.
    violations : tuple of Void
        Stretches of void instants: at the first of each some assumption had failed since the
        last one, or the start. That is certain, whatever the faults.
    """

    alarm: BoolArray
    names: tuple[str, ...]
    events: tuple[FaultEvent, ...]
    false_alarms: Mapping[str, int]
    lingering: Mapping[str, int]
    before_violation: Mapping[str, int]
    violations: tuple[Void, ...]

    @property
    def delays(self) -> dict[str, float | None]:
        """Delay in seconds of the first event of every fault; None where it was missed.

        Faults without an event are left out.
        """
        first: dict[str, float | None] = {}
        for event in self.events:
            first.setdefault(event.fault, event.delay)
        return first

    @property
    def missed(self) -> tuple[FaultEvent, ...]:
        """Events without an alarm."""
        return tuple(event for event in self.events if event.alarm is None)

    def __str__(self) -> str:
        lines = [str(event) for event in self.events] or ["no fault was there"]
        kinds = ((self.false_alarms, "false"), (self.lingering, "after its end"))
        for count, words in (*kinds, (self.before_violation, "before a violation")):
            lines += [f"{name}: {n} instants of alarm {words}" for name, n in count.items() if n]
        if not any(self.false_alarms.values()):
            lines.append("no false alarm")
        lines += [f"some assumption failed: {void}" for void in list_voids(self.violations)]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return card("Detection", str(self).splitlines())


def compare(
    alarm: BoolArray,
    truth: FloatArray,
    t: FloatArray,
    names: Sequence[str],
    fault_delay: int,
    *,
    threshold: float,
    width: FloatArray | None,
    valid: BoolArray,
    status: NDArray[np.int64],
    persistence: Sequence[int],
) -> Detection:
    """Compare alarms (N + 1, n_f) with the true faults, instants t (N + 1,), of a run."""
    void = (status & VOID) != 0
    # An alarm that stands when a void instant sets the counters to zero, from its beginning.
    ended = np.zeros_like(alarm)
    for i in range(len(names)):
        for start, stop in stretches(alarm[:, i]):
            ended[start : stop + 1, i] = stop + 1 < len(void) and void[stop + 1]
    there: BoolArray = np.abs(truth) > threshold
    # Row k of `spoken` is about the same instant as row k of the alarms.
    spoken = np.zeros_like(there)
    spoken[fault_delay:] = there[: len(there) - fault_delay]
    size = np.zeros_like(truth)
    size[fault_delay:] = np.abs(truth[: len(truth) - fault_delay])
    before: BoolArray = np.logical_or.accumulate(spoken, axis=0)
    events = []
    for i, name in enumerate(names):
        for onset, end in stretches(there[:, i]):
            first, stop = onset + fault_delay, end + fault_delay + 1
            raised = first + np.flatnonzero(alarm[first:stop, i])
            counting = first + np.flatnonzero((valid | void)[first:stop])
            large = None
            if width is not None:
                large = _first_run(
                    valid[counting] & (size[counting, i] > width[counting, i]), persistence[i]
                )
            event = FaultEvent(
                fault=name,
                onset=onset,
                end=end,
                peak=float(np.abs(truth[onset : end + 1, i]).max()),
                promised=None if large is None else int(counting[large]),
            )
            if raised.size:
                at = int(raised[0])
                wrong = np.flatnonzero(alarm[at] & ~spoken[at])
                event = replace(
                    event,
                    alarm=at,
                    delay=float(t[at] - t[onset]),
                    level=float(size[at, i]),
                    others=tuple(names[j] for j in wrong.tolist()),
                    violation=int(at + np.argmax(void[at:])) if ended[at, i] else None,
                )
            events.append(event)
    events.sort(key=lambda event: event.onset)
    false = (alarm & ~before).sum(axis=0)
    after = (alarm & before & ~spoken).sum(axis=0)
    return Detection(
        alarm=alarm,
        names=tuple(names),
        events=tuple(events),
        false_alarms={name: int(n) for name, n in zip(names, false, strict=True)},
        lingering={name: int(n) for name, n in zip(names, after, strict=True)},
        before_violation={n: int(k) for n, k in zip(names, ended.sum(axis=0), strict=True)},
        violations=find_voids(status),
    )


def stretches(there: BoolArray) -> list[tuple[int, int]]:
    """Return first and last index of every run of True."""
    edges = np.diff(np.concatenate([[0], there.astype(np.int8), [0]]))
    starts, stops = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [(int(a), int(b) - 1) for a, b in zip(starts, stops, strict=True)]


def _first_run(there: BoolArray, length: int) -> int | None:
    """Return where `length` values True in a row are complete for the first time."""
    return next((a + length - 1 for a, b in stretches(there) if b - a + 1 >= length), None)


def list_voids(voids: Sequence[Void]) -> list[str]:
    """Say of the first few when they were, of the others how many."""
    more = [f"{len(voids) - LISTED} more such stretches"] if len(voids) > LISTED else []
    return [*map(str, voids[:LISTED]), *more]


def find_voids(status: NDArray[np.int64]) -> tuple[Void, ...]:
    """Return the stretches in which the status is void or recovering."""
    found = []
    for first, until in stretches((status & (VOID | RECOVERING)) != 0):
        at = first + np.flatnonzero(status[first : until + 1] & VOID)
        if at.size:
            found.append(Void(int(at[0]), int(at[-1]), int(at.size), until))
    return tuple(found)
