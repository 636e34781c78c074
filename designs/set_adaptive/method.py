"""`SetAdaptiveObserver`: options of the method, and the way from a plant to an observer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds, Split
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.given import POSITIVE, read_gains, read_rows, refuse_idle
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.observer import Observer
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.set_adaptive import claims, equations, model, step
from obsynth.designs.set_adaptive.equations import MONITORS
from obsynth.designs.set_adaptive.gain import (
    Choice,
    Gain,
    analyse_gain,
    complete,
    design_gain,
    gain_problem,
    given_coordinates,
    middle,
    modal_coordinates,
    modes_of,
    settled_response,
)
from obsynth.designs.set_adaptive.model import CLASS, SetModel, output_of_fault, read
from obsynth.designs.set_adaptive.printed import printed_gain
from obsynth.designs.set_adaptive.record import (
    Coordinates,
    SetDesign,
    System,
    build_frame,
    read_coordinates,
)
from obsynth.designs.set_adaptive.transition import uniformisation
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

_DECADE = (5.0, 2.0, 1.0)
_SETTLED = 10.0
"""Time constants of the slowest bound for which a copy of the sets is kept at least."""


@dataclass(frozen=True)
class SetAdaptiveObserver(Method):
    """Intervals of states and constant faults by two bounding systems.

    For continuous plants x' = A(rho) x + B u + phi + G theta + W1 w, y = C x + v with
    nonnegative states and C >= 0, every output showing one state.

    Parameters
    ----------
    law : {"cooperative", "printed"}
        How the fault bounds move. The cooperative law keeps their order for every Gamma; the
        printed (8) keeps it only in an averaged sense, so its bounds are not reported as such
        (they stand in the memory).
    Gamma : float or sequence of float
        Adaptation gains, one for all faults or one each.
    gain_cap : float
        Largest entry of L that the design may use; the best decay is a supremum that only an
        unbounded gain reaches. The gain multiplies the noise: a small cap often gives narrower
        intervals.
    Ts : float, optional
        Sample time of `Observer.step`, which is exact for any; by default at most a 32nd of the
        longest step for which explicit Euler would keep the order and at most the time constant
        of the adaptation, so that `Observer.ode` can be integrated with it, as 1, 2 or 5 times a
        power of ten.
    noise : bool
        Include the declared disturbances in the bounds. Without, the bounds are the paper's
        functions of y and hold for exact measurements.
    window : float, optional
        Time constant in seconds of the monitors (13); all time by default.
    robust : bool
        Design a `FilterBank` with the options ``filters``, ``region`` and ``Ts`` instead; it has
        none of the others.
    filters, region
        Of the `FilterBank`.
    form : {"corrected", "printed"}
        ``"printed"``: the printed gain condition, law and bounds.
    coordinates : None, "auto" or array_like of shape (n, n)
        S of the coordinates z = S x in which the bounding systems run, for plants whose A - L C
        cannot be made Metzler in their own, or whose states may be negative. Their bounds are
        carried back by the exact inverse, rounded outwards; what S leaves of D, and what A varies
        by, is added to the drive between bounds of x. With a matrix the cap holds for S L. By
        default x itself where no state may be negative; ``"auto"``: x where that has a design, else
        real modal coordinates of A - L C, for the middle of the bounds of A, with the smallest
        predicted widths, which are also taken where a state may be negative.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    See Also
    --------
    FilterBank

    Notes
    -----
    D. Efimov, T. Raissi, A. Zolghadri, "Set adaptive observers for linear parameter-varying
    systems: application to fault detection", J. Dynamic Systems, Measurement, and Control 136
    (2014). What does not hold as printed, and what
    shows it: docs/methods/set_adaptive_observer.md.

    Examples
    --------
    >>> SetAdaptiveObserver(Gamma=0.02).law
    'cooperative'
    """

    CLASS = CLASS
    SPLITS = True
    CONTRACT = Contract.of(
        "set_adaptive_observer",
        SetDesign,
        claims,
        equations,
        model,
        step,
        shared=MONITORS,
        step_covered=True,
    )

    law: Literal["cooperative", "printed"] = "cooperative"
    Gamma: Annotated[float | tuple[float, ...], POSITIVE] = 0.01
    gain_cap: Annotated[float, POSITIVE] = 3.0
    Ts: Annotated[float | None, POSITIVE] = None
    noise: bool = True
    window: Annotated[float | None, POSITIVE] = None
    robust: bool = False
    filters: Annotated[tuple[float, ...], POSITIVE] = FilterBank.filters
    region: tuple[tuple[float, float], ...] | None = None
    form: Literal["corrected", "printed"] = "corrected"
    coordinates: Literal["auto"] | tuple[tuple[float, ...], ...] | None = None

    def check(self) -> None:
        """Refuse a printed bank; the printed form has the printed law and no noise."""
        if self.coordinates is not None and not isinstance(self.coordinates, str):
            object.__setattr__(self, "coordinates", read_rows("coordinates", self.coordinates))
        elif self.coordinates not in (None, "auto"):
            raise ObsynthError(
                f'coordinates is {self.coordinates!r}; it takes "auto" or S of z = S x',
                option="coordinates",
            )
        own = ("law", "Gamma", "gain_cap", "noise", "window", "coordinates")
        bank = ("filters", "region")
        refuse_idle(self, f"robust={self.robust}", *(own if self.robust else bank))
        if self.form == "printed":
            if self.robust:
                raise ObsynthError(
                    'form="printed" is the paper\'s observer; the bank (robust=True) is not in '
                    "the paper",
                    option="form",
                )
            refuse_idle(self, 'form="printed"', "gain_cap", "coordinates")
            object.__setattr__(self, "law", "printed")
            object.__setattr__(self, "noise", False)

    def _design(self, model: Plant | Split, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer, or that of the bank."""
        if self.robust:
            own = (self.filters, self.region, self.Ts)
            return FilterBank(*own, **self.watched).design(model)
        return super()._design(model, bounds)

    def read(self, given: Plant | Split) -> SetModel:
        """Bring the plant into the form (3) and bound its matrices elementwise."""
        found = read(given, self.noise, own=self.form == "printed")
        if isinstance(self.coordinates, tuple):
            read_coordinates(self.coordinates, found.plant.names("x"))
        return found

    def solve(self, model: SetModel) -> SetDesign:
        """Find the gain of the fastest decay within the cap, or the printed one, or coordinates."""
        A_lower, A_upper = model.A_span
        if self.form == "printed":
            return self._complete(model, printed_gain(A_lower, A_upper, model.C))
        names, cap = model.plant.names("x"), self.gain_cap
        return self._in_coordinates(
            model,
            lambda: design_gain(model.A_lower_box, A_upper, model.C, cap, names),
            lambda S: given_coordinates(model, S, cap),
            lambda: modal_coordinates(model, cap, self.Ts),
        )

    def fix(self, model: SetModel, gains: Mapping[str, ArrayLike]) -> SetDesign:
        """Find the decay of a given ``L`` of shape (n, m), of the plant's own coordinates."""
        L = read_gains(gains, {"L": model.C.T.shape})["L"]
        return self._in_coordinates(
            model,
            lambda: analyse_gain(model.A_lower_box, model.A_span[1], model.C, L),
            lambda S: complete(model, S, S @ L),
            lambda: modes_of(model, L),
        )

    def _in_coordinates(
        self,
        model: SetModel,
        own: Callable[[], Gain],
        given: Callable[[FloatArray], Choice],
        modal: Callable[[], Choice],
    ) -> SetDesign:
        """Complete what was found in the coordinates of the option."""
        found: Gain | Choice
        if isinstance(self.coordinates, tuple):
            found = given(np.array(self.coordinates))
        elif model.plant.box("x").min() < 0.0:
            found = modal()
        else:
            try:
                return self._complete(model, _decaying(own()))
            except InfeasibleDesign:
                if self.coordinates is None:
                    raise
            found = modal()
        return self._complete(model, _decaying(found.gain), found)

    def problem(self, model: Plant | Split, alpha: float) -> Problem:
        """Return the gain program for a decay alpha, see `Problem.to_cvxpy`.

        The decay is possible where the optimal ``margin`` is not negative; L = P^-1 W.

        Raises
        ------
        ObsynthError
            For the bank, which needs no program.
        """
        if self.coordinates is not None:
            raise ObsynthError(
                "the program is that of the plant's own coordinates: leave coordinates out",
                option="coordinates",
            )
        self._checked(model)
        found = read(model, self.noise)
        return gain_problem(found.A_lower_box, found.A_span[1], found.C, self.gain_cap, alpha)

    def _checked(self, given: Any, bounds: JacobianBounds | None = None) -> Any:
        if self.robust:
            raise ObsynthError(
                "the bank (robust=True) has no gains and needs no program: use design",
                option="robust",
            )
        return super()._checked(given, bounds)

    def _complete(self, model: SetModel, gain: Gain, choice: Choice | None = None) -> SetDesign:
        """Add what the step needs to a gain, or refuse its sample time."""
        A_lower, A_upper = model.A_span
        Gamma, names = self._adaptation(model.plant), model.plant.names("f")
        flow = np.maximum(model.A_lower_box, 0.0) if choice is None else middle(model)[0]
        outputs = output_of_fault(model.C, flow, model.G, names)
        coordinates = None if choice is None else Coordinates(choice.S, choice.D, *model.motion)
        frame = build_frame(model.C, model.G, model.W1, gain.L, coordinates)

        def error_matrix(A: FloatArray) -> FloatArray:
            return A - gain.L @ model.C if choice is None else choice.D

        # Gamma N^2 is how fast theta moves when N has settled
        settled = settled_response(-error_matrix(A_upper), frame.C, frame.G)
        if choice is not None:
            outputs = np.argmax(settled, axis=0).tolist()
        adaptation = Gamma * settled[outputs, np.arange(len(names))] ** 2
        longest = 1.0 / float((-np.diag(error_matrix(A_lower))).max())
        shortest = min(longest / 32.0, 1.0 / float(adaptation.max()))
        Ts = round_down(shortest) if self.Ts is None else self.Ts
        uniformisation(Ts, float((-np.diag(error_matrix(model.A_lower_box))).max()))
        A_upper_step = model.extremes(Ts)[1]
        M = error_matrix(A_upper_step)
        alpha_step = float((-(gain.p @ M) / gain.p).min())
        if alpha_step <= 0.0:
            raise InfeasibleDesign(
                f"Ts = {Ts:g} is too long: the outputs move so far within it that the frozen "
                "bounds are not Hurwitz",
                [f"the decay falls from {gain.alpha:.6g} to {alpha_step:.6g}: take a shorter Ts"],
                alpha=alpha_step,
            )
        alpha_step -= 1e-12 * (float(np.abs(M).max()) + alpha_step)
        return SetDesign(
            **{one.name: getattr(model, one.name) for one in fields(System)},
            Ts=Ts,
            noisy=self.noise,
            A_lower=A_lower,
            A_upper=A_upper,
            A_upper_step=A_upper_step,
            A_lower_box=model.A_lower_box,
            L=gain.L,
            p=gain.p,
            alpha=gain.alpha,
            alpha_step=alpha_step,
            Gamma=Gamma,
            law=self.law,
            fault_outputs=np.array(outputs),
            window=self.window,
            coordinates=coordinates,
            options=self.settling(_SETTLED / min(alpha_step, float(adaptation.min())), Ts),
        )

    def _adaptation(self, plant: Plant) -> FloatArray:
        """Return Gamma of every fault."""
        Gamma = np.atleast_1d(np.asarray(self.Gamma, dtype=float))
        if Gamma.shape not in ((1,), (len(plant.f),)):
            raise ObsynthError(
                f"Gamma has {Gamma.size} numbers; {len(plant.f)} are needed "
                f"({', '.join(plant.names('f'))})",
                option="Gamma",
            )
        return np.broadcast_to(Gamma, (len(plant.f),)).copy()


def _decaying(gain: Gain) -> Gain:
    """Refuse a gain that is not stable."""
    if gain.alpha <= 0.0:
        raise InfeasibleDesign(
            "A_M - L C is not Hurwitz for this gain",
            [f"its largest eigenvalue over the range of the outputs is {-gain.alpha:.6g}"],
            alpha=gain.alpha,
        )
    return gain


def round_down(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a positive number."""
    exponent = int(np.floor(np.log10(value)))
    for digit in _DECADE:
        candidate = float(f"{digit:g}e{exponent}")
        if candidate <= value:
            return candidate
    return float(f"5e{exponent - 1}")
