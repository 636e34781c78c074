"""`FaultDetector`: alarms from guaranteed fault bounds."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.errors import DetectorError
from obsynth.designs.core.observer import (
    ALARM_OUTPUT,
    MEAN_OUTPUTS,
    STATUS,
    STEP_OUTPUTS,
    Observer,
)
from obsynth.designs.core.stepping import StepFunction, counter, named_step
from obsynth.designs.detection.comparison import Detection, compare
from obsynth.designs.detection.observed import Handed, bounded_faults, core_of, whole_numbers
from obsynth.designs.detection.window import Window
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import Shown
from obsynth.symbolic.taking import check_kind

SKIPPED = ("not_initialised", "non_finite_input", "void", "fault_not_valid", "recovering")
"""Bits of the status at which a sample never counts; at a void one all counters return to 0."""

_COUNT = "alarm_count"


@dataclass(frozen=True, eq=False, repr=False)
class FaultDetector(Shown):
    """Raises one alarm per fault when zero has left the fault's guaranteed interval.

    Parameters
    ----------
    observer : Observer
        Of any method that bounds the faults.
    persistence : int or sequence of int
        Consecutive valid samples at which zero has to be outside before the alarm is raised:
        one number, or one for each fault. 1 raises it at once.
    also_skip : tuple of str
        Further bits of the status, by their names in ``STATUS``, at which a sample does not
        count, for example ``("outside_domain",)``. Samples that are not initialised, void or
        recovering, saw an input that is not finite or have no valid fault interval never count.
    window : int, optional
        A number m of instants, over which the step then returns the mean of every fault too,
        guaranteed for any course of the fault.

    Raises
    ------
    DetectorError
        The observer gives no bounds of its faults, or bounds of a mean where a window is asked
        for, or the plant has no faults; the message names the reason.

    Notes
    -----
    A fault that lies in [f_lower, f_upper] and an interval without zero together prove that
    the fault is not zero; where the method encloses a mean of the fault, that it was not zero
    throughout. As long as the observer's assumptions hold there is therefore no false
    alarm, for any persistence; persistence guards against single samples at which an assumption
    is broken. A sample that does not count leaves counter and alarm as they are, a void one
    (status bit 8) sets them to 0. The alarm at instant k speaks of instant k - `fault_delay`.

    **Violations.** Bit 8 is an event of its own, and a certain one: some assumption failed since
    the last void instant or the start. An alarm that stood until then proves nothing; `detect`
    lists the violations and marks such alarms.

    **Smallest detectable fault.** Let w_i be the steady half width of fault i. An interval of
    length at most 2 w_i that holds f_i excludes zero whenever abs(f_i) > 2 w_i, wherever in the
    interval f_i lies. So the alarm is promised if abs(f_i) > 2 w_i at `persistence` consecutive
    valid samples at which the interval is not longer than 2 w_i; before the transient is over
    the half width of that instant stands for w_i. A smaller fault may be detected, but may also
    remain inside an interval that holds zero for ever. Where a method does not predict its
    steady widths nothing is promised.

    **Window.** At call k the mean of f over k - m..k - 1 is enclosed by what the states moved
    meanwhile (see ``docs/step.md``), far narrower than f at one instant. ``mean_status`` joins the
    statuses of these calls; its bit 16 says that there are fewer than m since the first, a void one
    or a missing input. Where it lets a sample count, a mean without zero counts as f does; it may
    keep the alarm up for m - 1 instants after the fault's end.

    The detector can be simulated and turned into C like an observer: its step has the
    observer's outputs and, behind them, ``alarm`` (n_f,), each 0 or 1; with a window also
    ``mean_lower``, ``mean_upper`` (n_f,) and ``mean_status``.

    Examples
    --------
    >>> import obsynth as ob                                        # doctest: +SKIP
    >>> detector = ob.FaultDetector(observer, persistence=3)        # doctest: +SKIP
    >>> run = ob.simulate(model, detector, scenario)                # doctest: +SKIP
    >>> print(detector.detect(run))                                 # doctest: +SKIP
    f1 from k = 1001 to 3099 (peak 5): alarm at k = 1015, 14 s after its onset, at 0.75
    no false alarm
    """

    observer: Observer
    persistence: int | Sequence[int] = 1
    also_skip: tuple[str, ...] = ()
    window: int | None = None

    def __post_init__(self) -> None:
        check_kind("FaultDetector", "observer", "Observer", self.observer)
        model, method = self.observer.model, self.observer.method
        names = model.names("f")
        if not names:
            raise DetectorError(
                f"{model.name!r} declares no fault, so there is nothing to detect: declare faults "
                "by actuator_faults, sensor_faults or process_faults.",
                model=model.name,
            )
        if not bounded_faults(self.observer).any():
            raise DetectorError(
                f"{method} estimates {', '.join(names)} without bounds (its fault intervals are "
                "infinite, or those declared), so that zero never leaves them: a detector needs a "
                "method that bounds its faults.",
                method=method,
                faults=names,
            )
        object.__setattr__(self, "persistence", whole_numbers(self.persistence, names))
        unknown = [name for name in self.also_skip if name not in STATUS]
        if unknown:
            raise DetectorError(
                f"also_skip names {', '.join(map(repr, unknown))}; the bits of the status are "
                f"{', '.join(STATUS)}.",
                also_skip=self.also_skip,
            )
        if self.window is not None:
            (length,) = whole_numbers(self.window, names[:1], "window")
            object.__setattr__(self, "window", length)
            if self._of_mean:
                raise DetectorError(
                    f"window={length}: {method} encloses a mean of {', '.join(names)} already, and "
                    "a mean of means is none of the fault: leave the window out.",
                    window=length,
                )

    @property
    def counts(self) -> tuple[int, ...]:
        """Samples that the alarm of each fault takes."""
        counts: Any = self.persistence
        return tuple(counts)

    @property
    def _skipped(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*SKIPPED, *self.also_skip)))

    @property
    def method(self) -> str:
        """Name of the observer's method, with the detector's."""
        return f"{self.observer.method} with fault_detector"

    model = Handed("The observer's discrete plant.")
    fault_delay = Handed("By how many samples bounds and alarms lag behind.")
    half_widths = Handed("The observer's steady half widths.")
    ode = Handed("The observer's right-hand side; nothing of the detector flows.")
    step_covered = Handed("Whether the observer's guarantee covers its step.")
    gains = Handed("The observer's gains.")
    performance = Handed("The observer's performance.")
    figures = Handed("The observer's performance as it is shown.")
    certificate = Handed("The observer's certificate; an alarm rests on nothing else.")

    @property
    def smallest_detectable(self) -> FloatArray | None:
        """Magnitude (n_f,) from which on an alarm is promised in the steady state: 2 w.

        Of the mean, for methods that enclose one. Infinite for a fault without bounds and where
        no fault of its declared range is as large; None where the method does not predict its
        steady widths. See the notes of the class for the conditions.
        """
        if self.half_widths is None:
            return None
        widths = np.asarray(self.half_widths, dtype=np.float64)[len(self.model.x) :]
        # any filter of a bank raises the alarm, the narrowest interval first
        means: Any = self.performance.get("mean_half_widths") if self._of_mean else None
        widths = widths if means is None else np.minimum(widths, means.min(axis=1))
        largest = np.abs(np.asarray(self.model.box("f"), dtype=np.float64)).max(axis=1)
        return np.where(2.0 * widths < largest, 2.0 * widths, np.inf)

    @cached_property
    def _of_mean(self) -> bool:
        core = core_of(self.observer)
        return core is not None and core.mean_fault

    @cached_property
    def mean(self) -> Window | None:
        """The recursion of the means; None without a window."""
        return None if self.window is None else Window(self.observer, self.window)

    @cached_property
    def decide(self) -> ca.Function:
        """The decision alone: (count, f_lower, f_upper, status, *means) -> (count, alarm)."""
        n_f = len(self.model.f)
        sizes = {"f_lower": n_f, "f_upper": n_f, "status": 1}
        if self.window is not None:
            sizes |= dict(zip(MEAN_OUTPUTS, (n_f, n_f, 1), strict=True))
        count, told = ca.SX.sym("count", n_f), [ca.SX.sym(k, size) for k, size in sizes.items()]

        def bit(name: str, status: ca.SX) -> Any:
            return ca.fmod(ca.floor(status / STATUS[name]), 2) >= 1

        valid = []
        for status in told[2::3]:
            valid.append(ca.SX(1))
            for name in self._skipped:
                valid[-1] = ca.logic_and(valid[-1], ca.logic_not(bit(name, status)))
        following, alarm = [], []
        for i, needed in enumerate(self.counts):
            outside = ca.SX(0)
            for lower, upper, sound in zip(told[::3], told[1::3], valid, strict=True):
                apart = ca.logic_or(lower[i] > 0, upper[i] < 0)
                outside = ca.logic_or(outside, ca.logic_and(sound, apart))
            before = counter(count[i], needed)
            counted = ca.if_else(outside, ca.fmin(before + 1, needed), 0)
            kept = ca.if_else(bit("void", told[2]), 0, before)
            following.append(ca.if_else(ca.logic_or(valid[0], outside), counted, kept))
            alarm.append(following[-1] >= needed)
        return ca.Function(
            "decide",
            [count, *told],
            [ca.vertcat(*following), ca.vertcat(*alarm)],
            ["count", *sizes],
            ["count_next", ALARM_OUTPUT],
        )

    @cached_property
    def step(self) -> StepFunction:
        """Observer and decision as one step, with the further output ``alarm``.

        (memory, u, y[, theta]) -> (memory_next, xhat, fhat, x_lower, x_upper, f_lower, f_upper,
        status, alarm[, mean_lower, mean_upper, mean_status]); the memory is the observer's with
        the counters, and what the means remember, behind it.
        """
        step, layout = self.observer.step, self.memory_layout
        n_memory, names = int(step.numel_in(0)), list(step.name_in())
        ports = [ca.MX.sym("memory", max(place.stop for place in layout.values()))]
        ports += [ca.MX.sym(name, step.numel_in(i)) for i, name in enumerate(names) if i]
        outputs = list(step.call([ports[0][:n_memory], *ports[1:]]))
        sets = dict(zip(STEP_OUTPUTS, outputs, strict=True))
        means: list[Any] = []
        following: list[Any] = []
        if self.mean is not None:
            recursion: Any = self.mean.step
            remembered = ports[0][layout[_COUNT].stop :]
            theta = ports[3] if names[3:] else ca.MX(0, 1)
            told = (sets[name] for name in STEP_OUTPUTS[3:])
            following, *means = recursion(remembered, ports[1], theta, *told)
        decision: Any = self.decide
        told = (sets[name] for name in STEP_OUTPUTS[5:])
        count, alarm = decision(ports[0][layout[_COUNT]], *told, *means)
        outputs[0] = ca.vertcat(outputs[0], count, following)
        results = [ca.densify(output) for output in (*outputs, alarm, *means)]
        labels = [*STEP_OUTPUTS, ALARM_OUTPUT, *(MEAN_OUTPUTS if means else ())]
        composed = ca.Function("step", ports, results, names, labels)
        with suppress(RuntimeError):
            composed = composed.expand("step")
        return named_step(composed, self.model)

    @property
    def memory_layout(self) -> dict[str, slice]:
        """The observer's layout, the counters as ``alarm_count``, and what means remember."""
        n_memory = int(self.observer.step.numel_in(0))
        end = n_memory + len(self.model.f)
        means = {} if self.mean is None else self.mean.layout
        behind = {name: slice(end + p.start, end + p.stop) for name, p in means.items()}
        return {**self.observer.memory_layout, _COUNT: slice(n_memory, end), **behind}

    @property
    def outputs(self) -> Mapping[str, tuple[str, ...]]:
        """Labels of every output of the step, by the names of the plant's signals."""
        names = self.model.names("f")
        labels = {ALARM_OUTPUT: tuple(f"{name}_alarm" for name in names)}
        if self.window is not None:
            ends = {key: tuple(f"{name}_{key}" for name in names) for key in MEAN_OUTPUTS[:2]}
            labels |= ends | {MEAN_OUTPUTS[2]: MEAN_OUTPUTS[2:]}
        return {**self.observer.outputs, **labels}

    @property
    def guarantee(self) -> Guarantee:
        """The observer's guarantee, and what it makes of an alarm."""
        own = self.observer.guarantee
        names, smallest = self.model.names("f"), self.smallest_detectable
        claims = [
            f"an alarm of {name} proves that what its interval encloses was not zero at {count} "
            "samples, the latest ones that count: the fault was there"
            for name, count in zip(names, self.counts, strict=True)
        ]
        for i, (name, count) in enumerate(zip(names, self.counts, strict=True)):
            if smallest is not None and np.isfinite(smallest[i]):
                whose = f"of the mean of {name}" if self._of_mean else f"of {name}"
                claims.append(
                    f"in the steady state a magnitude {whose} above {smallest[i]:.6g} at {count} "
                    "consecutive samples that count raises its alarm"
                )
        if self.window is not None:
            claims.append(
                f"the mean of {', '.join(names)} over the {self.window} instants before a call "
                "lies in [mean_lower, mean_upper], whatever the course, where what is claimed of "
                "the returned sets holds at these calls; an alarm of it proves that the fault was "
                "there at some of these instants"
            )
        claims.append(
            "a void sample (status bit 8) proves that some assumption failed since the last void "
            "one or the start; it ends every alarm, and one that stood until then proves nothing"
        )
        return Guarantee((*own.claims, *claims), tuple(own.assumptions))

    def memory0(
        self, guess: Any, x_range: Any = None, f_range: Any = None, y0: Any = None, **options: Any
    ) -> FloatArray:
        """Return the memory for the first call of `step`; see `Observer.memory0`."""
        memory = self.observer.memory0(guess, x_range=x_range, f_range=f_range, y0=y0, **options)
        means = () if self.mean is None else self.mean.first
        return np.concatenate([memory, np.zeros(len(self.model.f)), means])

    def alarms(
        self,
        f_lower: FloatArray,
        f_upper: FloatArray,
        status: NDArray[np.int64],
        *means: FloatArray,
    ) -> NDArray[np.bool_]:
        """Decide for recorded bounds, from counters at zero.

        Parameters
        ----------
        f_lower, f_upper : (N + 1, n_f)
        status : (N + 1,)
        *means : (N + 1, n_f), (N + 1, n_f) and (N + 1,)
            With a window: mean_lower, mean_upper, mean_status.

        Returns
        -------
        (N + 1, n_f) bool
        """
        decide: Any = self.decide.mapaccum(len(status))
        rows = (f_lower, f_upper, status, *means)
        columns = [np.asarray(row, dtype=float).reshape(len(status), -1).T for row in rows]
        _, alarm = decide(np.zeros(len(self.model.f)), *columns)
        return np.asarray(np.array(alarm).T > 0.5)

    def valid(self, status: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which samples count, from their status."""
        mask = sum(STATUS[name] for name in self._skipped)
        return np.asarray((np.asarray(status, dtype=np.int64) & mask) == 0)

    def detect(self, run: Any, threshold: float = 0.0) -> Detection:
        """Compare the alarms of a run with the faults that were there.

        Parameters
        ----------
        run : Run
            Of this detector or of its observer, with either engine: the decision is made
            again from the recorded bounds.
        threshold : float
            Magnitude up to which a fault counts as not there.

        Returns
        -------
        Detection
            Events with their delays, false alarms, alarms that outlast a fault, violations.

        Raises
        ------
        DetectorError
            The run is of another plant.
        """
        names = self.model.names("f")
        if tuple(run.names["f"]) != names or run.fault_delay != self.fault_delay:
            raise DetectorError(
                f"the run has the faults {', '.join(run.names['f']) or 'none'} with a delay of "
                f"{run.fault_delay}, the detector {', '.join(names)} with {self.fault_delay}: "
                "give a run of its observer.",
                faults=tuple(run.names["f"]),
            )
        # A fault enters its mean slowly: nothing is promised for its present value.
        width = None
        if self.half_widths is not None and not self._of_mean:
            width = np.asarray(run.f_upper - run.f_lower, dtype=np.float64)
        return compare(
            self.alarms(run.f_lower, run.f_upper, run.status, *self.means(run)),
            run.f,
            run.t,
            names,
            self.fault_delay,
            threshold=threshold,
            width=width,
            valid=self.valid(run.status),
            status=np.asarray(run.status, dtype=np.int64),
            persistence=self.counts,
        )

    def means(self, run: Any) -> list[FloatArray]:
        """Return mean_lower, mean_upper, mean_status of a run; nothing without a window."""
        if self.mean is None:
            return []
        known = [s.name for s in self.model.rho if s.measured and self.mean.sizes["theta"]]
        theta = run.rho[:, [run.names["rho"].index(name) for name in known]] if known else ()
        sets = (run.x_lower, run.x_upper, run.f_lower, run.f_upper, run.status)
        return self.mean.over(run.u, theta, *sets)

    def __str__(self) -> str:
        lines = [f"fault detector over {self.observer.method} for {self.model.name}"]
        smallest = self.smallest_detectable
        for i, (signal, count) in enumerate(zip(self.model.f, self.counts, strict=True)):
            unit = f" {signal.unit}" if signal.unit else ""
            least = np.inf if smallest is None else smallest[i]
            size = f"above {least:.4g}{unit}" if np.isfinite(least) else "of no size"
            mean = " for the mean" if self._of_mean else ""
            lines.append(f"  {signal.name}: alarm after {count} samples, promised {size}{mean}")
        return "\n".join(lines)
