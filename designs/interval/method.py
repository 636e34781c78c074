"""`IntervalObserver`: options of the method, and the way from a model to an observer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds
from obsynth.derive.errors import StructureError
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.core.given import MATRIX, changed, read_gains, read_rows
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.step import Step
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.interval import claims, model, step, synthesis
from obsynth.designs.interval.decoupling import check_detectable, find_transformation, shaped
from obsynth.designs.interval.model import CLASS, IntervalModel, Prefer, read
from obsynth.designs.interval.printed import refuse_printed
from obsynth.designs.interval.record import Bound, IntervalDesign
from obsynth.designs.interval.step import build_core
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

Matrix = Annotated[ArrayLike | None, MATRIX]


@dataclass(frozen=True)
class IntervalObserver(Method):
    """Interval observer for states and actuator faults of parameter-varying plants.

    For discrete-time plants ``x+ = A(rho) x + B(rho) u + o(rho) + F f + W1 w``, ``y = C x + W2 w``
    with bounded w, rho bounded (values of rho that are measured are not used), faults f and unknown
    inputs of any size, and rank(C F) = q. An orthogonal transformation takes the faults away; what
    remains is bounded from below and above, and the faults follow with a delay of one sample.
    `analyse` takes ``L`` of shape (n - q, m - q) and ``P``, by default the identity.

    Parameters
    ----------
    gains : "lp", "search", "sylvester" or (P, L)
        L by the linear programme that minimises the widths for P = I; both by a direct search on
        the predicted widths (which is also taken where P = I has no solution); both by
        P A2 - R P = Q C2; or given, where (P, None) lets the programme choose L.
    centred : bool
        Whether the paper's bound is taken around the middle of the matrices; False: around
        `nominal`. The vertex bound does not depend on it.
    bound : {"vertex", "paper"}
        One vertex of the polytope for y, w and r together, or (13)-(15), (26) and (32), corrected.
    contraction : bool
        Cut the set of every instant with what the measurement says of it.
    form : {"general", "corrected", "printed"}, optional
        ``"corrected"`` is for the class above; plants outside of it go to ``"general"``: peak
        bounds of the states whatever the faults do, and these found by dividing what moved the
        states by their gains. ``"printed"`` takes the theorem at its word and is refused with what
        fails: the widths, or else (32).
    nominal : array_like of shape (n, n), optional
        The nominal A of ``centred=False``.
    R, Q : array_like, optional
        Of the Sylvester equation; R nonnegative, shapes (n - q, n - q) and (n - q, m - q).
    H, R0, K0, N, R1, K1 : array_like, optional
        F = H [R0; 0] K0' and C H1 = N [R1; 0] K1' with orthogonal H and N; singular value
        decompositions by default. For n - q >= 2 the bounds depend on the choice.
    prefer : sequence of str or mapping, optional
        How the plant is written as a quasi-LPV form, see `obsynth.quasi_lpv`.

    Raises
    ------
    ObsynthError
        For an option that is not known or does not fit another one.

    Notes
    -----
    R. Lamouchi, T. Raissi, M. Amairi, M. Aoun, "Interval observer design for actuator fault
    estimation of linear parameter-varying systems", IFAC PapersOnLine 51-24, 2018. What does not
    hold as printed, and what shows it: docs/methods/interval_observer.md.

    Examples
    --------
    >>> IntervalObserver(bound="paper", contraction=False).gains
    'lp'
    """

    CLASS = CLASS
    CONTRACT = Contract.of("interval_observer", IntervalDesign, claims, model, step, fault_delay=1)

    gains: Any = "lp"
    centred: bool = True
    bound: Bound = "vertex"
    contraction: bool = True
    form: Literal["general", "corrected", "printed"] | None = None
    nominal: Matrix = None
    R: Matrix = None
    Q: Matrix = None
    H: Matrix = None
    R0: Matrix = None
    K0: Matrix = None
    N: Matrix = None
    R1: Matrix = None
    K1: Matrix = None
    prefer: Prefer = None

    def check(self) -> None:
        """Refuse options that do not fit each other."""
        object.__setattr__(self, "gains", _read_pair(self.gains))
        object.__setattr__(self, "prefer", _in_words(self.prefer))
        if self.centred and self.nominal is not None:
            raise ObsynthError(
                "nominal is the A of centred=False; with centred=True it is the middle",
                option="nominal",
            )
        if not self.centred and self.nominal is None:
            raise ObsynthError(
                "centred=False needs nominal=, the A around which DeltaA is taken",
                option="nominal",
            )
        if self.form == "printed" and (self.bound != "paper" or self.contraction):
            raise ObsynthError(
                'form="printed" stands for (13)-(32), which has bound="paper" and '
                "contraction=False",
                option="form",
            )
        if self.gains != "sylvester" and (self.R is not None or self.Q is not None):
            raise ObsynthError('R and Q belong to gains="sylvester"', option="R")
        if self.R is None and self.Q is not None:
            raise ObsynthError("Q is given without R: they belong together", option="Q")

    def _design(self, model: Any, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer."""
        if self.form == "general":
            return self._general().design(model)
        try:
            return super()._design(model, bounds)
        except StructureError as error:
            if changed(self, "form", *self._own) or not isinstance(model, Plant):
                raise
            try:
                return self._general().design(model)
            except (StructureError, SolverTrouble, InfeasibleDesign) as other:
                more = f"{error}\n  nor does the general class take it: {other}"
                raise StructureError(more, **error.facts) from error

    def _general(self) -> GeneralUIO:
        """Return the method of the general class, faults of any size divided out."""
        return GeneralUIO.instead_of(self, self._own, faults="divided")

    @property
    def _own(self) -> set[str]:
        """Options that speak of the paper's class alone."""
        return {option.name for option in fields(self)} - {"form", *self.watched}

    def read(self, given: Plant | QuasiLPV) -> IntervalModel:
        """Read the matrices and check the ranks; a form has to be the one of `prefer`."""
        self._check_shapes(given if isinstance(given, Plant) else given.model)
        return read(given, self.prefer)

    def _check_shapes(self, plant: Plant) -> None:
        """Refuse matrices of other shapes than the plant's before a form is derived."""
        n, m, q = len(plant.x), len(plant.output), len(plant.f) + len(plant.d)
        shapes = {"nominal": (n, n), "H": (n, n), "N": (m, m), "P": (n - q, n - q)}
        shapes |= dict.fromkeys(("R0", "K0", "R1", "K1"), (q, q))
        shapes |= {"R": shapes["P"], "Q": (n - q, m - q), "L": (n - q, m - q)}
        pair = (None, None) if isinstance(self.gains, str) else self.gains
        given = {**vars(self), "P": pair[0], "L": pair[1]}
        for name, shape in shapes.items():
            if given[name] is not None and min(shape) >= 0:
                shaped(given[name], shape, name, "gains" if name in "PL" else name)

    def solve(self, model: IntervalModel) -> IntervalDesign:
        """Find gains whose bounds stay bounded, or complete the given ones."""
        start = self._start(model)
        check_detectable(model.plant, start.reduced)
        if self.gains == "sylvester":
            design = synthesis.sylvester_design(start, self.R, self.Q)
        elif isinstance(self.gains, str):
            design = (
                synthesis.search_design(start)
                if self.gains == "search"
                else synthesis.lp_design(start)
            )
        else:
            design = synthesis.given_gains(start, *self.gains)
        if self.form == "printed":
            raise refuse_printed(design)
        return design

    def fix(self, model: IntervalModel, gains: Mapping[str, ArrayLike]) -> IntervalDesign:
        """Complete ``L`` of shape (n - q, m - q) and ``P``, by default the identity."""
        n2, m2 = model.n - model.q, len(model.C) - model.q
        found = read_gains(gains, {"L": (n2, m2), "P": (n2, n2)}, optional=("P",))
        pair = found.get("P", np.eye(n2)), found["L"]
        return replace(self, gains=pair, R=None, Q=None).solve(model)

    def unproved(
        self, model_or_form: Plant | QuasiLPV
    ) -> tuple[ca.Function, Callable[..., FloatArray]]:
        """Return the step of given gains and its `memory0`, although nothing is proved of them.

        For showing what a refused design does: its sets may grow without bound.

        Parameters
        ----------
        model_or_form : Plant or QuasiLPV

        Returns
        -------
        (casadi.Function, callable)
            As `Observer.step` and `Observer.memory0`.

        Raises
        ------
        ObsynthError
            If no pair (P, L) is given.
        """
        if isinstance(self.gains, str) or self.gains[1] is None:
            raise ObsynthError(
                "only given gains can go unproved: gains=(P, L)", option="gains", given=self.gains
            )
        start = self._start(self._checked(model_or_form))
        design = synthesis.with_gains(start, *synthesis.fitting_gains(start, *self.gains))
        step = Step(self.CONTRACT.guard(design), build_core(design)).build()
        return step, partial(self.CONTRACT.start, design)

    def problem(self, model_or_form: Plant | QuasiLPV) -> Problem:
        """Return the linear programme of L, for the given P or the identity.

        See Also
        --------
        obsynth.designs.lmi.problem.Problem.to_cvxpy
        """
        data = self._start(self._checked(model_or_form)).reduced
        P = np.eye(data.A.shape[1]) if isinstance(self.gains, str) else np.array(self.gains[0])
        return synthesis.lp_problem(data, P)

    def _start(self, model: IntervalModel) -> IntervalDesign:
        """Return the design without gains."""
        n, n2, m2 = model.n, model.n - model.q, len(model.C) - model.q
        nominal = model.middle if self.centred else np.array(self.nominal)
        if self.bound == "paper" and model.family.directions[:, :, n:].any():
            raise ObsynthError(
                "the input matrix or the offset varies with the scheduling variables, which the "
                "paper's bound does not have; use bound='vertex'",
                option="bound",
            )
        return IntervalDesign(
            model,
            find_transformation(model, vars(self)),
            nominal,
            np.eye(n2),
            np.zeros((n2, m2)),
            self.bound,
            self.contraction,
            np.zeros(0),
            np.zeros(0),
            self.options(),
        )


def _read_pair(value: Any) -> Any:
    named = isinstance(value, str)
    if named and value in ("lp", "search", "sylvester"):
        return value
    if named or not hasattr(value, "__len__") or len(value) != 2:
        raise ObsynthError(
            f"gains is {value!r}; it has to be 'lp', 'search', 'sylvester' or a pair (P, L)",
            option="gains",
        )
    P, L = value
    return read_rows("P", P), None if L is None else read_rows("L", L)


def _in_words(prefer: Any) -> Prefer:
    if prefer is None:
        return None
    if isinstance(prefer, Mapping):
        return {str(key): str(value) for key, value in prefer.items()}
    words = [prefer] if isinstance(prefer, str) else prefer
    if not isinstance(words, list | tuple) or not all(isinstance(word, str) for word in words):
        raise ObsynthError(
            f"prefer is {prefer!r}; it has to be names of signals, or a mapping of them",
            option="prefer",
        )
    return tuple(words)
