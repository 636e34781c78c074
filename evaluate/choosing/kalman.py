"""An extended Kalman filter as the familiar yardstick: no method of obsynth, and no guarantee."""

from typing import Any

import casadi as ca
import numpy as np

from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.boxes import LIMITS
from obsynth.designs.core.stepping import clip, make_step
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

SIGMAS = 3.0


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
