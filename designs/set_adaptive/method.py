"""`SetAdaptiveObserver`: options of the method, and the way from a plant to an observer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.set_adaptive.transition import PRECISIONS
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

if TYPE_CHECKING:
    from obsynth.derive import Split
    from obsynth.designs.core.observer import Observer
    from obsynth.designs.lmi import Problem
    from obsynth.designs.set_adaptive.gain import Gain
    from obsynth.designs.set_adaptive.model import Structure
    from obsynth.designs.set_adaptive.record import SetDesign
    from obsynth.symbolic import Plant


_LAWS = ("cooperative", "printed")
_FORMS = ("corrected", "printed")
_DECADE = (5.0, 2.0, 1.0)


@dataclass(frozen=True)
class SetAdaptiveObserver:
    """Intervals of states and constant faults by two bounding systems.

    For continuous plants x' = A(rho) x + B u + phi + G theta + W1 w, y = C x + v with
    nonnegative states, C >= 0 and G >= 0, every output showing one state; or, with
    ``robust=True``, for monotone balances whose faults enter measured states only.

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
        The bank of filters in place of (6)-(8), see Notes.
    filters : sequence of float
        Rates of the bank per second; the first one gives ``f_lower`` and ``f_upper``.
    region : sequence of (float, float), optional
        Box of the states in which the bank's monotonicity is proved and which it assumes; the
        declared ranges by default.
    precision : {"double", "single"}
        In which the step runs: what its rounding may do is added to the bounds.
    form : {"corrected", "printed"}
        ``"printed"``: the printed gain condition, law and bounds.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    Notes
    -----
    D. Efimov, T. Raissi, A. Zolghadri, "Set adaptive observers for linear parameter-varying
    systems: application to fault detection", J. Dynamic Systems, Measurement, and Control 136
    (2014). What does not hold as printed:

    ==================  =======================================================================
    in print            correct
    ==================  =======================================================================
    (19), row 2         the sign of a32 rho(x3 - x2) is +, as in (20)
    gain LMI            L = p w' does not solve p'L = w', and the condition with r is vacuous;
                        with W = diag(p) L it is a linear program (`gain.py`)
    (8), (12)           a system with a nonnegative matrix N'N is not ordered: for coupled faults
                        the "upper" bound may end below the fault (a counterexample is among the
                        tests); averaging does not help, a cooperative law does
    Theorem 1 (ii)      R_m^-1 b_m > theta_M does not hold in Section 6 unless Theta = {0}; there
                        it is a certificate against false alarms, not one of the fault's range
    (17)                in case (a) theta_m is the upper bound, so the test as printed is always 1
    Theorem 1, noise    with noisy outputs the printed A_m, A_M do not bound A (11.5 per cent of
                        samples violate an entry); y - v and y + v do, with -+ |L| v in (6), (14)
    Section 6, delays   .35 s and .45 s cannot be reached without noise: d1 is .974 s for
                        Gamma = .01 (s1 .695 s whatever Gamma); theta2 = 6e-5 is never detected
    Section 6, x in X   the faulted plant leaves the range that the bounds are derived for, after
                        221.5 s (x1), 297.3 s (x3) and 304.2 s (x2)
    ==================  =======================================================================

    The bank, for ``robust=True``: the unmeasured states come from both ends of their own
    monotone equations, which no fault enters; every measured state with a fault gets filters
    z' = c + l (y - z) from below and from above, and its interval encloses the mean of the fault
    with the weights exp(-l age). Nothing singular is evaluated and no gain is needed.

    Examples
    --------
    >>> SetAdaptiveObserver(Gamma=0.02).law
    'cooperative'
    """

    law: Literal["cooperative", "printed"] = "cooperative"
    Gamma: float | Sequence[float] = 0.01
    gain_cap: float = 3.0
    Ts: float | None = None
    noise: bool = True
    window: float | None = None
    robust: bool = False
    filters: Sequence[float] = (0.1, 0.2, 0.3, 0.5)
    region: Sequence[Sequence[float]] | None = None
    precision: Literal["double", "single"] = "double"
    form: Literal["corrected", "printed"] = "corrected"

    def __post_init__(self) -> None:
        for name, values in (("law", _LAWS), ("form", _FORMS), ("precision", PRECISIONS)):
            if getattr(self, name) not in values:
                raise ObsynthError(
                    f"{name} is {getattr(self, name)!r}; it has to be one of "
                    f"{', '.join(map(repr, values))}",
                    option=name,
                )
        for name in ("Gamma", "gain_cap", "Ts", "window", "filters"):
            given = getattr(self, name)
            if given is None and name in ("Ts", "window"):
                continue
            if not _positive(given):
                raise ObsynthError(
                    f"{name} is {given!r}; it has to be positive and finite", option=name
                )
        if self.form == "printed":
            if self.robust:
                raise ObsynthError(
                    'form="printed" is the paper\'s observer; the bank (robust=True) is not in '
                    "the paper",
                    option="form",
                )
            object.__setattr__(self, "law", "printed")
            object.__setattr__(self, "noise", False)
        if np.ndim(self.Gamma) == 1:
            object.__setattr__(self, "Gamma", tuple(np.asarray(self.Gamma, dtype=float).tolist()))
        rates = np.atleast_1d(np.asarray(self.filters, dtype=float))
        object.__setattr__(self, "filters", tuple(rates.tolist()))
        if self.region is not None:
            box = tuple((float(low), float(high)) for low, high in self.region)
            object.__setattr__(self, "region", box)

    def design(self, model: Plant | Split) -> Observer:
        """Design, prove and return the observer.

        Parameters
        ----------
        model : Plant or Split
            Continuous, or a discretisation of a continuous plant; of a split only the plant is
            used.

        Returns
        -------
        Observer

        Raises
        ------
        StructureError
            If the plant is outside the class; the signal is named.
        InfeasibleDesign
            If no gain makes the bounds Metzler and Hurwitz.
        UnboundedError
            If an entry of A has no bound over the declared ranges.
        """
        from obsynth.designs.set_adaptive.assembly import assemble
        from obsynth.designs.set_adaptive.gain import design_gain
        from obsynth.designs.set_adaptive.model import read_structure

        if self.robust:
            from obsynth.designs.filter_bank.model import design_bank

            return assemble(design_bank(model, self), level="full")
        structure = read_structure(model, self.noise)
        A_lower, A_upper = structure.bounds.extremes(structure.reach(0.0))
        A_lower_box = structure.bounds.extremes(np.inf)[0]
        names = structure.form.model.names("x")
        if self.form == "printed":
            from obsynth.designs.set_adaptive.printed import printed_gain

            gain = printed_gain(A_lower, A_upper, structure.C)
        else:
            gain = design_gain(A_lower_box, A_upper, structure.C, self.gain_cap, names)
        return assemble(self._complete(structure, gain, A_lower, A_upper, A_lower_box), structure)

    def analyse(self, model: Plant | Split, gains: Mapping[str, ArrayLike]) -> Observer:
        """Return what a given gain guarantees, proved.

        Parameters
        ----------
        model : Plant or Split
        gains : mapping
            ``L`` of shape (n, m).

        Raises
        ------
        InfeasibleDesign
            If A_m - L C is not Metzler or A_M - L C not Hurwitz.
        """
        from obsynth.designs.set_adaptive.assembly import assemble
        from obsynth.designs.set_adaptive.gain import analyse_gain
        from obsynth.designs.set_adaptive.model import read_structure

        if self.robust:
            raise ObsynthError("the bank (robust=True) has no gains: use design", option="robust")
        structure = read_structure(model, self.noise)
        L = np.asarray(gains.get("L"), dtype=float)
        if set(gains) != {"L"} or L.shape != structure.C.T.shape or not np.all(np.isfinite(L)):
            raise ObsynthError(
                f"gains has to hold L alone, of shape {structure.C.T.shape}, finite; given were "
                f"{', '.join(gains) or 'none'}",
                option="gains",
            )
        A_lower, A_upper = structure.bounds.extremes(structure.reach(0.0))
        A_lower_box = structure.bounds.extremes(np.inf)[0]
        gain = analyse_gain(A_lower_box, A_upper, structure.C, L)
        if gain.alpha <= 0.0:
            raise InfeasibleDesign(
                "A_M - L C is not Hurwitz for this gain",
                [f"its largest eigenvalue over the range of the outputs is {-gain.alpha:.6g}"],
                alpha=gain.alpha,
            )
        return assemble(self._complete(structure, gain, A_lower, A_upper, A_lower_box), structure)

    def problem(self, model: Plant | Split, alpha: float) -> Problem:
        """Return the gain program for a decay alpha, see `Problem.to_cvxpy`.

        The decay is possible where the optimal ``margin`` is not negative; L = P^-1 W.

        Raises
        ------
        ObsynthError
            For the bank, which needs no program.
        """
        from obsynth.designs.set_adaptive.gain import gain_problem
        from obsynth.designs.set_adaptive.model import read_structure

        if self.robust:
            raise ObsynthError("the bank (robust=True) needs no program", option="robust")
        structure = read_structure(model, self.noise)
        A_upper = structure.bounds.extremes(structure.reach(0.0))[1]
        A_lower = structure.bounds.extremes(np.inf)[0]
        return gain_problem(A_lower, A_upper, structure.C, self.gain_cap, alpha)

    def _complete(
        self,
        structure: Structure,
        gain: Gain,
        A_lower: FloatArray,
        A_upper: FloatArray,
        A_lower_box: FloatArray,
    ) -> SetDesign:
        from obsynth.designs.set_adaptive.model import output_of_fault
        from obsynth.designs.set_adaptive.record import SetDesign
        from obsynth.designs.set_adaptive.transition import uniformisation

        plant = structure.form.model
        q = len(plant.f)
        Gamma = np.atleast_1d(np.asarray(self.Gamma, dtype=float))
        if Gamma.shape not in ((1,), (q,)):
            raise ObsynthError(
                f"Gamma has {Gamma.size} numbers; {q} are needed ({', '.join(plant.names('f'))})",
                option="Gamma",
            )
        outputs = output_of_fault(structure.C, A_lower_box, structure.G, plant.names("f"))
        Gamma = np.broadcast_to(Gamma, (q,)).copy()
        # -(A_M - L C)^-1 G is where -Omega settles, and Gamma N^2 how fast theta then moves
        settled = structure.C @ np.linalg.solve(gain.L @ structure.C - A_upper, structure.G)
        adaptation = float((Gamma * settled[outputs, np.arange(q)] ** 2).max())
        longest = 1.0 / float((-np.diag(A_lower - gain.L @ structure.C)).max())
        if self.Ts is None:
            Ts = round_down(min(longest / 32.0, 1.0 / adaptation))
        else:
            Ts = float(self.Ts)
        uniformisation(Ts, float((-np.diag(A_lower_box - gain.L @ structure.C)).max()))
        A_upper_step = structure.bounds.extremes(structure.reach(Ts))[1]
        M = A_upper_step - gain.L @ structure.C
        alpha_step = float((-(gain.p @ M) / gain.p).min())
        if alpha_step <= 0.0:
            raise InfeasibleDesign(
                f"Ts = {Ts:g} is too long: the outputs move so far within it that the frozen "
                "bounds are not Hurwitz",
                [f"the decay falls from {gain.alpha:.6g} to {alpha_step:.6g}: take a shorter Ts"],
                alpha=alpha_step,
            )
        alpha_step -= 1e-12 * (float(np.abs(M).max()) + alpha_step)
        options = asdict(self)
        options["filters"] = list(self.filters)
        options["Gamma"] = np.atleast_1d(self.Gamma).tolist()
        options["region"] = None
        return SetDesign(
            plant=plant,
            Ts=Ts,
            bounds=structure.bounds,
            C=structure.C,
            G=structure.G,
            W1=structure.W1,
            W2=structure.W2,
            w_centre=structure.w_centre,
            w_radius=structure.w_radius,
            rate=structure.rate,
            input_rate=structure.input_rate,
            A_lower=A_lower,
            A_upper=A_upper,
            A_upper_step=A_upper_step,
            A_lower_box=A_lower_box,
            L=gain.L,
            p=gain.p,
            alpha=gain.alpha,
            alpha_step=alpha_step,
            Gamma=Gamma,
            fault_outputs=np.array(outputs),
            options=options,
        )


def _positive(given: Any) -> bool:
    """Return whether something is a number, or some numbers, all positive and finite."""
    try:
        numbers = np.asarray(given, dtype=float)
    except (TypeError, ValueError):
        return False
    return bool(numbers.ndim <= 1 and numbers.size and ((numbers > 0) & (numbers < np.inf)).all())


def round_down(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that is not above a positive number."""
    exponent = int(np.floor(np.log10(value)))
    for digit in _DECADE:
        candidate = float(f"{digit:g}e{exponent}")
        if candidate <= value:
            return candidate
    return float(f"5e{exponent - 1}")
