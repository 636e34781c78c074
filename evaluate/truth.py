"""The truth of a simulation: one step of the plant, discrete or integrated."""

from typing import Any

import casadi as ca
import numpy as np

from obsynth.codegen.kernel import dense
from obsynth.derive.equilibrium import operating_values
from obsynth.designs.core.observer import Observer
from obsynth.designs.detection.detector import FaultDetector
from obsynth.evaluate.errors import SimulationError
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.discretise import PREFIX, runge_kutta


class Truth:
    """One plant step (x, u, d, f, w, rho) -> (next x, y) and what the run says about it."""

    def __init__(
        self, model: Plant, observer: Observer | FaultDetector, substeps: int | None
    ) -> None:
        own = observer.model
        if model is own.continuous and substeps is not None and own.remainder is not None:
            # the plant behind the observer's model, whose remainder follows from its motion
            model = own
        same_signals(model, own)
        self.model = model
        self.rest: ca.Function | None = None
        self.Ts = sample_time(own)
        self.outside: tuple[str, ...] = ()
        self._ode = observer.ode
        p = operating_values(model, "p")
        if substeps is not None:
            self._continuous(substeps, own)
            step = _held(self.plant, self.Ts, substeps, p)
            if model.remainder:
                step = self._with_remainder(step, p)
        else:
            self._discrete(own)
            signals = _symbols(model)
            step = ca.Function("truth", signals, _call(model, p, *signals))
        if self._ode is not None and not observer.step_covered:
            self.outside += (
                "the guarantee speaks of the observer's differential equation; its sampled step, "
                f"with everything measured held over {self.Ts:g} s, is outside it",
            )
        self.function = dense(step)
        self.description += parameter_text(model, p)

    def _with_remainder(self, step: ca.Function, p: FloatArray) -> ca.Function:
        """Let a step of the continuous plant take all disturbances; remember what it adds to ours.

        `rest` maps (x, u, d, f, w, rho) to the next state of the discrete plant without remainder.
        """
        x, u, d, f, w, rho = _symbols(self.model)
        kept = w[: w.numel() - len(self.model.remainder or ())]
        quiet = ca.vertcat(kept, ca.SX.zeros(w.numel() - kept.numel()))
        ours = _call(self.model, p, x, u, d, f, quiet, rho)[0]
        self.rest = ca.Function("rest", [x, u, d, f, w, rho], [ours])
        moved, y = step(x, u, d, f, kept, rho)
        return ca.Function("truth", [x, u, d, f, w, rho], [moved, y])

    def remainders(self, fields: dict[str, FloatArray], x: FloatArray) -> FloatArray:
        """Return the disturbances with the remainder that the motion had, (N + 1, n_w)."""
        w = fields["w"]
        if self.rest is None:
            return w
        signals = {**fields, "x": x}
        rows = [signals[kind][:-1].T for kind in ("x", "u", "d", "f", "w", "rho")]
        moved = x[1:] - np.array(self.rest(*rows)).T
        carriers = self.model.remainder or ()
        index = [self.model.names("x").index(s.name.removeprefix(PREFIX)) for s in carriers]
        found = w.copy()
        found[:-1, len(self.model.w) - len(carriers) :] = moved[:, index]
        return found

    def _continuous(self, substeps: int, own: Plant) -> None:
        substeps = substeps_of(substeps)
        self.plant = continuous_plant(self.model, f"substeps={substeps}")
        self.description = f"continuous plant, {substeps} Runge-Kutta steps per sample, inputs held"
        if self.model.remainder is not None and self.model.to_dict() == own.to_dict():
            self.description += ", what a step leaves out is in the guarantee"
        elif self._ode is None:
            self.outside = (
                "the truth is the continuous plant; the error of its discretisation is no declared "
                "disturbance, so the guarantee does not cover it",
            )

    def _discrete(self, own: Plant) -> None:
        if self.model.Ts is None:
            raise SimulationError(
                f"{self.model.name!r} is a continuous plant: give substeps= to integrate it, or "
                "the discrete model for which the observer was designed (observer.model).",
                model=self.model.name,
            )
        if self.model.Ts != own.Ts:
            raise SimulationError(
                f"the model's sample time {self.model.Ts:g} is not the observer's {own.Ts:g}.",
                Ts=self.model.Ts,
            )
        self.plant = self.model
        way = f" ({self.model.discretisation})" if self.model.discretisation else ""
        if self.model is own or self.model.to_dict() == own.to_dict():
            self.description = f"the observer's own discrete model{way}"
        else:
            self.description = f"another discrete model{way}"
            self.outside = ("the truth is not the model for which the observer was designed",)
        if self._ode is not None:
            self.outside += (
                "the truth is a discretisation of the plant; the guarantee speaks of the "
                "differential equation",
            )


def same_signals(model: Plant, own: Plant) -> None:
    """Refuse a truth whose signals are not those of the observer's model."""
    groups = {"x": "states", "u": "inputs", "d": "unknown inputs", "f": "faults"}
    groups |= {"w": "disturbances", "rho": "scheduling signals"}
    pairs = [(word, model.names(key), own.names(key)) for key, word in groups.items()]
    pairs.append(("outputs", tuple(model.output_names), tuple(own.output_names)))
    for word, given, expected in pairs:
        if given != expected:
            raise SimulationError(
                f"the {word} of the model ({', '.join(given) or 'none'}) are not those of the "
                f"observer's model ({', '.join(expected) or 'none'}): simulate the plant for "
                "which the observer was designed.",
                given=given,
                expected=expected,
            )


def sample_time(own: Plant) -> float:
    """Return the observer's sample time in seconds."""
    if own.Ts is None:
        raise SimulationError("the observer's model is continuous: its step has no sample time.")
    return float(own.Ts)


def substeps_of(substeps: int) -> int:
    """Return the number of Runge-Kutta steps per sample, or refuse it."""
    if isinstance(substeps, bool) or int(substeps) != substeps or substeps < 1:
        raise SimulationError(
            f"substeps={substeps!r} is not a positive whole number.", substeps=substeps
        )
    return int(substeps)


def continuous_plant(model: Plant, why: str) -> Plant:
    """Return the differential equation that a model is or comes from."""
    source = model if model.Ts is None else model.continuous
    if source is None:
        raise SimulationError(
            f"{why} needs a continuous plant, but {model.name!r} was declared in discrete time: "
            "leave it out, or give the plant that was discretised.",
            model=model.name,
        )
    return source


def parameter_text(model: Plant, p: FloatArray) -> str:
    """Say which parameters the truth has, to be put behind its description."""
    if not p.size:
        return ""
    return "; " + ", ".join(f"{s.name} = {v:g}" for s, v in zip(model.p, p, strict=True))


def _symbols(plant: Plant) -> list[Any]:
    return [ca.SX.sym(key, len(plant.names(key))) for key in ("x", "u", "d", "f", "w", "rho")]


def _call(plant: Plant, p: FloatArray, *signals: Any) -> tuple[Any, Any]:
    *others, rho = signals
    rhs, y = plant.function()(*others, p, rho)
    return rhs, y


def _held(plant: Plant, Ts: float, substeps: int, p: FloatArray) -> ca.Function:
    """Classical Runge-Kutta over one sample with everything but x held."""
    x, *held = _symbols(plant)
    state: Any = x
    for _ in range(substeps):
        state = runge_kutta(lambda at: _call(plant, p, at, *held)[0], state, Ts / substeps)
    return ca.Function("truth", [x, *held], [state, _call(plant, p, x, *held)[1]])
