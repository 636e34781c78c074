"""`IntervalObserver`: options of the method, and the way from a model to an observer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.forms.quasi_lpv.build import quasi_lpv
from obsynth.derive.forms.quasi_lpv.form import QuasiLPV
from obsynth.derive.rigour import UNIT
from obsynth.designs.interval.decoupling import decouple_exactly, transformation
from obsynth.designs.interval.gains import Reduced, check_detectable, lp_problem
from obsynth.designs.interval.model import IntervalModel, model_of
from obsynth.designs.interval.record import Bound, IntervalDesign
from obsynth.designs.interval.rows import Precision
from obsynth.designs.interval.synthesis import (
    given_gains,
    lp_design,
    read_gains,
    search_design,
    sylvester_design,
    with_gains,
)
from obsynth.symbolic import ObsynthError, Plant
from obsynth.symbolic.arrays import FloatArray

if TYPE_CHECKING:
    import casadi as ca

    from obsynth.designs.core.observer import Observer
    from obsynth.designs.lmi import Problem


TRANSFORMATION = ("H", "R0", "K0", "N", "R1", "K1")
Matrix = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class IntervalObserver:
    """Interval observer for states and actuator faults of parameter-varying plants.

    For discrete-time plants ``x+ = A(rho) x + B(rho) u + o(rho) + F f + W1 w``, ``y = C x + W2 w``
    with bounded w, rho bounded (values of rho that are measured are not used), faults f and unknown
    inputs of any size, and rank(C F) = q. An orthogonal transformation takes the faults away; what
    remains is bounded from below and above, and the faults follow with a delay of one sample.

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
    form : {"corrected", "printed"}
        ``"printed"`` takes the theorem at its word and is refused with what fails: the widths, or
        else (32).
    nominal : array_like of shape (n, n), optional
        The nominal A of ``centred=False``.
    precision : {"double", "single"}
        In which the step may be evaluated with its bounds still enclosing.
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
    hold as printed:

    ===============  ==========================================================
    in print         correct
    ===============  ==========================================================
    Assumption 3     full rank of C and F does not give rank(C F) = q, which the
                     decoupling needs
    before (7)       H, N, K0, K1 have to be orthogonal
    Section 5        with the printed P, L and DeltaA the widths grow by 8.27 per
                     step; alpha is 21.85, not .057, and (20) is feasible for
                     alpha < .4 only; u is not given, and the plant is unstable
                     for u = 0
    DeltaA           has constant entries; its middle belongs to A
    (13)             with r_0 = P+ z_0 - P- z_0 of the other end
    (26)             bounds H12 z2 and E1 z2 apart; (H12 - E1) z2 is bounded once
    (29), (36)       plus signs between the nonnegative shares
    (30)             comes from (8), not (9)
    (31)             G3 = A11 E Ct2 - A12, with Ct2 the last n - q columns of C H
    (32)             y_k, not y_{k+1}, in Gamma_f; the lower theta_1 in the lower
                     bound; K0 R0^-1 multiplies bounds only by its positive and
                     negative parts; f_k needs y_{k+1}, a delay of one sample
    Remark 1         a nonnegative R needs real poles that can be placed freely
    Theorem 1        also needs bounded x
    ===============  ==========================================================

    Examples
    --------
    >>> IntervalObserver(bound="paper", contraction=False).gains
    'lp'
    """

    gains: Any = "lp"
    centred: bool = True
    bound: Bound = "vertex"
    contraction: bool = True
    form: Literal["corrected", "printed"] = "corrected"
    nominal: Any = None
    precision: Precision = "double"
    R: Any = None
    Q: Any = None
    H: Any = None
    R0: Any = None
    K0: Any = None
    N: Any = None
    R1: Any = None
    K1: Any = None
    prefer: Any = None

    def __post_init__(self) -> None:
        allowed: dict[str, tuple[Any, ...]] = {
            "centred": (True, False),
            "bound": ("vertex", "paper"),
            "contraction": (True, False),
            "form": ("corrected", "printed"),
            "precision": tuple(UNIT),
        }
        for name, values in allowed.items():
            given = getattr(self, name)
            if given not in values:
                raise ObsynthError(
                    f"{name} is {given!r}; it has to be one of {', '.join(map(repr, values))}",
                    option=name,
                )
        for name in ("nominal", "R", "Q", *TRANSFORMATION):
            object.__setattr__(self, name, _read_matrix(name, getattr(self, name)))
        if not isinstance(self.gains, str):
            object.__setattr__(self, "gains", _read_pair(self.gains))
        elif self.gains not in ("lp", "search", "sylvester"):
            raise ObsynthError(
                f"gains is {self.gains!r}; it has to be 'lp', 'search', 'sylvester' or a pair "
                "(P, L)",
                option="gains",
            )
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

    def design(self, model_or_form: Plant | QuasiLPV) -> Observer:
        """Design, prove and return the observer.

        Parameters
        ----------
        model_or_form : Plant or QuasiLPV
            Discrete time; a form has to be the one that `obsynth.quasi_lpv` gives for its plant
            and this method's `prefer`.

        Returns
        -------
        Observer
            With a certificate in which every claim is proved; ``fault_delay`` is 1.

        Raises
        ------
        StructureError
            If the model is outside the class, rank(C F) < q, or the pair (A2, C2) is not
            detectable.
        InfeasibleDesign
            If the bounds diverge; ``radius``, ``alpha`` and ``largest_alpha`` are the numbers.
        UnboundedError
            If a matrix is unbounded over the declared ranges.
        """
        from obsynth.designs.interval.assembly import assemble

        model, start = self._prepare(model_or_form)
        check_detectable(model, start.plant)
        if self.form == "printed":
            from obsynth.designs.interval.printed import refuse_printed

            raise refuse_printed(self._finish(start))
        return assemble(self._finish(start), derived=model)

    def analyse(self, model_or_form: Plant | QuasiLPV, gains: Mapping[str, ArrayLike]) -> Observer:
        """Return what given gains guarantee, proved.

        Parameters
        ----------
        model_or_form : Plant or QuasiLPV
        gains : mapping
            ``P`` of shape (n - q, n - q), the identity where it is missing, and ``L`` of shape
            (n - q, m - q).

        Raises
        ------
        InfeasibleDesign
            If the bounds diverge.
        """
        from dataclasses import replace

        if "L" not in gains:
            raise ObsynthError("gains needs L, and P unless it is the identity", option="gains")
        L = np.asarray(gains["L"], dtype=float)
        P = np.eye(len(L)) if "P" not in gains else gains["P"]
        return replace(self, gains=(P, L), R=None, Q=None).design(model_or_form)

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
        from obsynth.designs.interval.start import make_start
        from obsynth.designs.interval.step import build_step

        if isinstance(self.gains, str) or self.gains[1] is None:
            raise ObsynthError(
                "only given gains can go unproved: gains=(P, L)", option="gains", given=self.gains
            )
        _, start = self._prepare(model_or_form)
        design = with_gains(start, *read_gains(start, *map(np.array, self.gains)))
        return build_step(design), make_start(design)

    def problem(self, model_or_form: Plant | QuasiLPV) -> Problem:
        """Return the linear programme of L, for the given P or the identity.

        See Also
        --------
        obsynth.designs.lmi.Problem.to_cvxpy
        """
        _, start = self._prepare(model_or_form)
        data = Reduced.of(start.model, start.plant)
        P = np.eye(data.A.shape[1]) if isinstance(self.gains, str) else np.array(self.gains[0])
        return lp_problem(data, P)

    def _prepare(self, model_or_form: Plant | QuasiLPV) -> tuple[IntervalModel, IntervalDesign]:
        form = model_or_form
        if isinstance(form, Plant):
            if form.Ts is None:
                raise _continuous(form)
            form = quasi_lpv(form, prefer=_plain(self.prefer))
        elif quasi_lpv(form.model, prefer=_plain(self.prefer)).matrix != form.matrix:
            raise ObsynthError(
                "the form is not the one that is derived from its plant; give the plant, and "
                "prefer= to choose how it is written",
                option="prefer",
            )
        model = model_of(form)
        given = {name: _array(getattr(self, name)) for name in TRANSFORMATION}
        chosen = transformation(model, given)
        n, n2, m2 = model.n, model.n - model.q, len(model.C) - model.q
        nominal = model.middle if self.centred else _array(self.nominal)
        if nominal is None or nominal.shape != (n, n):
            raise ObsynthError(f"nominal has to have the shape {(n, n)}", option="nominal")
        constant = model.family.directions[:, :, n:]
        if self.bound == "paper" and constant.any():
            raise ObsynthError(
                "the input matrix or the offset varies with the scheduling variables, which the "
                "paper's bound does not have; use bound='vertex'",
                option="bound",
            )
        start = IntervalDesign(
            model,
            chosen,
            nominal,
            np.eye(n2),
            np.zeros((n2, m2)),
            self.bound,
            self.contraction,
            self.precision,
            np.zeros(0),
            np.zeros(0),
            self._options(),
        )
        decouple_exactly(model, chosen)
        return model, start

    def _finish(self, start: IntervalDesign) -> IntervalDesign:
        if not isinstance(self.gains, str):
            P, L = self.gains
            return given_gains(start, np.array(P), None if L is None else np.array(L))
        if self.gains == "search":
            return search_design(start)
        if self.gains == "sylvester":
            return sylvester_design(start, _array(self.R), _array(self.Q))
        return lp_design(start)

    def _options(self) -> dict[str, Any]:
        def listed(value: Any) -> Any:
            return [listed(v) for v in value] if isinstance(value, tuple) else value

        values = {field.name: listed(getattr(self, field.name)) for field in fields(self)}
        values["prefer"] = _plain(self.prefer)
        return values


def _continuous(plant: Plant) -> Exception:
    from obsynth.derive.errors import StructureError

    return StructureError(
        f"{plant.name} is in continuous time and the interval observer works in discrete time: "
        'call discretise("euler", Ts=...) first'
    )


def _plain(prefer: Any) -> Any:
    """Return the option as JSON-able data."""
    if prefer is None:
        return None
    if isinstance(prefer, Mapping):
        return {str(key): str(value) for key, value in prefer.items()}
    return [str(value) for value in prefer]


def _array(matrix: Any) -> FloatArray | None:
    return None if matrix is None else np.array(matrix, dtype=float)


def _read_matrix(name: str, value: Any) -> Any:
    if value is None:
        return None
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ObsynthError(f"{name} is no matrix: {value!r}", option=name) from error
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or not np.isfinite(array).all():
        raise ObsynthError(f"{name} has to be a finite matrix; got {value!r}", option=name)
    return tuple(tuple(float(v) for v in row) for row in array)


def _read_pair(value: Any) -> tuple[Any, Any]:
    try:
        P, L = value
    except (TypeError, ValueError) as error:
        raise ObsynthError(
            f"gains is {value!r}; it has to be 'lp', 'search', 'sylvester' or a pair (P, L)",
            option="gains",
        ) from error
    return _read_matrix("P", P), _read_matrix("L", L)
