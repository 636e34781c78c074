"""One method on one plant, in a process of its own that is ended when its time is up."""

import multiprocessing
import os
import re
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from obsynth.designs import (
    BoundedErrorUIO,
    FilterBank,
    HinfUIO,
    IntervalObserver,
    QPVObserver,
    SetAdaptiveObserver,
    SetMembershipObserver,
)
from obsynth.designs.core.method import Method
from obsynth.designs.detection.observed import core_of
from obsynth.evaluate.data.estimated import Estimate
from obsynth.evaluate.run import Run
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

METHODS: tuple[Method, ...] = (
    IntervalObserver(),
    IntervalObserver(gains="search"),
    BoundedErrorUIO(bounds="peak"),
    BoundedErrorUIO(),
    HinfUIO(),
    SetAdaptiveObserver(coordinates="auto"),
    FilterBank(),
    QPVObserver(),
    SetMembershipObserver(),
)
"""What is tried by default; a further method is a further line."""

CLASSES = {type(method).__name__: method.CLASS for method in METHODS}
"""The class of plants of every method, as data."""


@dataclass(frozen=True, eq=False)
class Try:
    """What came of a method: an observer and its run, or a reason.

    seconds: of the design and its proof
    means: whether its intervals of faults hold means over time, see `FilterBank`
    """

    name: str
    seconds: float
    observer: Any = None
    run: Run | Estimate | None = None
    reason: str = ""
    means: bool = False

    @property
    def operations(self) -> Any:
        """How many operations a step takes; None without an observer."""
        return None if self.observer is None else int(self.observer.step.n_instructions())

    @property
    def half_widths(self) -> FloatArray:
        """Of states and faults at every instant that is known of, (N, n + n_f)."""
        run: Any = self.run
        rows = [run[name].half_width for name in run.estimated]
        return np.column_stack([row[: min(map(len, rows))] for row in rows])

    @property
    def missed(self) -> float | None:
        """The largest share of instants at which an interval did not hold the truth, if known."""
        if self.run is None or isinstance(self.run, Estimate):
            return None
        names = self.run.names["x"] if self.means else self.run.estimated
        return max(1.0 - self.run.coverage[name] for name in names)


def named(method: Method) -> str:
    """Write a method with the options that are not its defaults."""
    told = [(f.name, repr(getattr(method, f.name)), repr(f.default)) for f in fields(method)]
    said = ", ".join(f"{name}={value}" for name, value, usual in told if value != usual)
    return f"{type(method).__name__}({said})" if said else type(method).__name__


def first_sentence(text: str) -> str:
    """Return the beginning of a refusal, in one line of at most 120 characters."""
    line = re.split(r"(?<=[a-z)\]0-9])[.;] ", " ".join(text.split()), maxsplit=1)[0]
    return line if len(line) <= 120 else f"{line[:118]} …"


def attempt(method: Method, model: Plant, run: Callable[[Any], Run | Estimate]) -> Try:
    """Design for a discrete plant, or for the continuous one behind it, and run the observer."""
    name, start, given, fitted = named(method), time.perf_counter(), model, method
    if method.CLASS.time == "continuous" and model.continuous is not None:
        given, options = model.continuous, {**method.options(), "Ts": model.Ts}
        fitted = type(method)(**options)
    try:
        observer = fitted.design(given)
        seconds, core = time.perf_counter() - start, core_of(observer)
        means = core is not None and core.mean_fault
        return Try(name, seconds, observer, run(observer), means=means)
    except Exception as error:  # one that is no refusal is a bug, and no reason to stop the others
        told = str(getattr(error, "headline", error))
        word = "" if isinstance(error, ObsynthError) else f"{type(error).__name__}: "
        return Try(name, time.perf_counter() - start, reason=word + first_sentence(told))


def in_time(name: str, job: Callable[[], Try], limit: float | None) -> Try:
    """Run a job in a process that is ended after so many seconds, which a thread could not be.

    Without a limit, and where processes cannot be forked, it runs in this one.
    """
    if limit is None or "fork" not in multiprocessing.get_all_start_methods():
        return job()
    receive, send = multiprocessing.Pipe(duplex=False)

    def child() -> None:
        # its own bars would show among those of this process, of notebooks too
        with open(os.devnull, "w") as quiet, redirect_stdout(quiet), redirect_stderr(quiet):
            os.dup2(quiet.fileno(), 1)
            os.dup2(quiet.fileno(), 2)
            send.send(job())

    process = multiprocessing.get_context("fork").Process(target=child, daemon=True)
    process.start()
    send.close()
    try:
        if receive.poll(limit):
            told: Try = receive.recv()
            return told
        return Try(name, limit, reason=f"no design within {limit:.3g} s")
    except EOFError:
        process.join()
        return Try(name, 0.0, reason=f"its process ended with exit code {process.exitcode}")
    finally:
        process.kill()
        process.join()
