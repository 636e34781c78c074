"""One method on one plant, in a process that is ended in time, and a Kalman filter beside."""

import multiprocessing
import os
import re
import time
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, fields
from typing import Any

import casadi as ca
import numpy as np

from obsynth.derive.equilibrium import operating_values
from obsynth.designs import (
    BoundedErrorUIO,
    FilterBank,
    HinfUIO,
    IntervalObserver,
    QPVObserver,
    SetAdaptiveObserver,
    SetMembershipObserver,
)
from obsynth.designs.core.boxes import LIMITS
from obsynth.designs.core.method import Method
from obsynth.designs.core.stepping import clip, make_step
from obsynth.designs.detection.window import core_of
from obsynth.evaluate.data.estimated import Estimate
from obsynth.evaluate.run import Run
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

SIGMAS = 3.0
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


class ExtendedKalman:
    """The filter of a discrete plant, with a step like an observer's and sets of three sigma.

    Bounded signals of half range r have the variance r^2 / 3; a fault is a random walk by its rate,
    or by its half range; an unbounded signal has for half range what moves some state through its
    own. Estimated is (x, f, the f before, d, w) in half ranges; faults are told one call late.
    """

    method = "extended Kalman filter, 3 sigma"
    half_widths, ode, certificate, step_covered = None, None, None, False

    def __init__(self, plant: Plant) -> None:
        self.model, n, m = plant, len(plant.x), len(plant.f)
        self.fault_delay, self.kept = int(m > 0), n + 2 * m
        x, f, d, w, u, rho = (
            ca.SX.sym(kind, len(getattr(plant, kind))) for kind in ("x", "f", "d", "w", "u", "rho")
        )
        every = ca.vertcat(x, f, ca.SX.sym("before", m), d, w)
        moved, shown, *_ = plant.function()(x, u, d, f, w, operating_values(plant, "p"), rho)
        outs = [ca.vertcat(moved, f, f), shown]
        outs += [ca.densify(ca.jacobian(out, every)) for out in outs]
        self.both = ca.Function("both", [every, u, rho], outs)
        boxes = np.vstack([plant.box(kind).reshape(-1, 2) for kind in ("x", "f", "f", "d", "w")])
        known = np.isfinite(boxes).all(axis=1)
        boxes[~known] = [-1.0, 1.0]
        self.middle, self.half = boxes.mean(axis=1), 0.5 * np.diff(boxes, axis=1)[:, 0]
        middles = [0.0 if s.nominal is None else s.nominal for s in (*plant.u, *plant.rho)]
        at = self.both(self.middle, middles[: len(plant.u)], middles[len(plant.u) :])
        slopes = np.abs(np.array(at[2]))[:n]
        for j in np.flatnonzero(~known):
            hit = slopes[:, j] > 0
            self.half[j] = max(self.half[:n][hit] / slopes[hit, j], default=1.0) if j >= n else 1.0
        pairs = zip(plant.f, self.half[n : n + m], strict=True)
        walk = [0.0 if s.constant else 1.0 if s.rate is None else s.rate / h for s, h in pairs]
        self.walk = np.diag([0.0] * n + [step**2 for step in walk] + [0.0] * m)
        self.step = self._step()

    def _step(self) -> ca.Function:
        """Return the step: readings one by one, as noise is estimated and leaves none to invert."""
        plant, kept, half, box = self.model, self.kept, ca.DM(self.half), self.model.box("x")
        n, wide = len(plant.x), self.half.size
        memory, u = ca.SX.sym("memory", kept + kept * kept), ca.SX.sym("u", len(plant.u))
        y = ca.SX.sym("y", len(plant.output_names))
        known = ca.SX.sym("theta", sum(s.measured for s in plant.rho))
        theta = iter(ca.vertsplit(known))
        rho = ca.vertcat(*(next(theta) if s.measured else s.nominal or 0.0 for s in plant.rho))
        mean = start = ca.vertcat(memory[:kept], self.middle[kept:])
        P = ca.diagcat(ca.reshape(memory[kept:], kept, kept), ca.SX.eye(wide - kept) / 3.0)
        _, shown, _, C = self.both(mean, u, rho)
        for i in range(y.numel()):
            c, read = C[i, :].T * half, ca.fabs(y[i]) <= LIMITS["double"].finite
            seen, spread = P @ c, c.T @ P @ c
            gain = ca.if_else(ca.logic_and(read, spread > 1e-16 * c.T @ c), seen / spread, 0.0)
            off = ca.if_else(read, y[i], 0.0) - shown[i] - c.T @ ((mean - start) / half)
            mean, P = mean + half * gain * off, P - gain @ seen.T
        mean = ca.vertcat(clip(mean[:n], box), mean[n:])
        reach = SIGMAS * half * ca.sqrt(ca.fmax(ca.diag(P), 0.0))
        moved, _, A, _ = self.both(mean, u, rho)
        A = ca.diag(1.0 / half[:kept]) @ A @ ca.diag(half)
        after = ca.vertcat(clip(moved[:n], box), moved[n:], ca.vec(A @ P @ A.T + self.walk))
        outputs = {"memory_next": after, "status": ca.SX(0)}
        for letter, part in (("x", slice(0, n)), ("f", slice(kept - len(plant.f), kept))):
            outputs[f"{letter}hat"] = mean[part]
            outputs[f"{letter}_lower"] = mean[part] - reach[part]
            outputs[f"{letter}_upper"] = mean[part] + reach[part]
        inputs = {"memory": memory, "u": u, "y": y}
        given = {**inputs, "theta": known} if known.numel() else inputs
        return make_step(plant, given, outputs)

    def memory0(self, guess: Any, **_: Any) -> FloatArray:
        """Return the memory for a first state, with the variances of the declared ranges."""
        mean = np.append(guess, self.middle[len(guess) : self.kept])
        return np.concatenate([mean, np.eye(self.kept).ravel() / 3.0])


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
