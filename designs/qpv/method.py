"""`QPVObserver`: options of the method, and the way from a model to an observer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.qpv.region import Ellipsoid
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

if TYPE_CHECKING:
    from obsynth.derive import QPV
    from obsynth.designs.core.observer import Observer
    from obsynth.designs.lmi import Problem
    from obsynth.designs.qpv.work import Workspace
    from obsynth.symbolic import Plant


@dataclass(frozen=True, eq=False)
class QPVObserver:
    """Observer of states and process faults of parameter-varying plants, in continuous time.

    For ``x' = A(theta) x + B(theta) u + G(theta) w + sum_k A_fk(theta) f_k x``, ``y = C(theta) x +
    H(theta) w`` with measured theta: faults become states, which makes the plant quadratic, and
    the gain is scheduled, ``L(theta) = sum_l mu_l(theta) L_l``.

    Parameters
    ----------
    norm : {"h2", "hinf"}
        What is minimised: mu, a bound of trace(Cz P^-1 Cz') with V' < w'w, or gamma, a bound of
        the squared L2 gain from w to z = Cz e.
    region : Ellipsoid
        X of (18), in which states and faults are assumed to stay; states first, then faults.
    polytope : {"box", "cross"} or array_like of shape (p, n)
        P_x - c = P_e of (16), (17): half widths or semi-axes kappa sqrt(Q_ii), or kappa times
        given vertices.
    kappa : float, optional
        By default the largest that keeps P_x in X.
    eta : float, optional
        1/eta enlarges the polytopes, in (0, 1]; searched where not given.
    alpha : float
        Decay rate of V = e'P e; the error decays with alpha/2.
    performance_output : array_like of shape (n_z, n) or (V, n_z, n), optional
        Cz, constant or at every vertex of the scheduling; the faults by default.
    polya : int, optional
        Order s of Polya's relaxation for C or H that vary, 2 by default; where they are constant
        the double sums are single ones and nothing is relaxed.
    initial_error : array_like of shape (n,) or (r, n), optional
        Half widths of the box of e(0), or its vertices, in place of P_e; needs `E_x`.
    E_x : array_like of shape (n_x,) or (n,), optional
        Half widths of the box that the error may use, of the states or of states and faults: takes
        P_e apart from P_x, for which the polytope with kappa / eta as small as possible is taken.
        Half-spaces for errors that Psi does not contain are then left out, which the coupled
        conditions state as the paper does; that alone makes mu smaller.
    alpha_q : float, optional
        Rate of quadratic boundedness V' < alpha_q (1 - V) for the declared bounds of disturbances
        and fault rates: bounds every state and fault at all times. It takes the place of V' < w'w.
    gain_cap : float, optional
        Limit of the largest singular value of every L_l.
    form_of_N : {"upper", "symmetric"}
        Where x_a x_b stands in N_i: the same plant, different inequalities.
    Ts : float, optional
        Sample time of the step; chosen from the fastest mode where not given.
    form : {"corrected", "printed"}
        With "printed", (19) and (20) as they stand; they do not prove what the paper claims, and
        the design is refused with the numbers that show it.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    Notes
    -----
    D. Rotondo, M. Buciakowski, M. Witczak, "Simultaneous state and process fault estimation in LPV
    systems using robust QPV observers". What does not hold as printed:

    =================  ===========================================================
    in print           correct
    =================  ===========================================================
    (19), (20)         describe e'P^-1 e <= 1; for V = e'P e they are
                       (x_i - c)'P(x_i - c) <= 1 and [P, eta a_k; eta a_k', 1] >= 0
    mu = 2.0024        follows from (20) as printed; the corrected minimum for a
                       box or cross-polytope of the example is .005 to .1
    (47)               1 <= p_k <= N, and the permutations are those of a multiset
    (49)               eta alpha P belongs inside the sum
    (29), (31), (32)   Ntilde and Nbar are swapped; He{...} closes after e
    (12)               bounds the squared ratio: the L2 gain is sqrt(gamma)
    decay rate         V decays with alpha, the norm of e with alpha / 2
    xhat(0), Fig. 6    xhat(0) lies outside P_e; the ellipsoid function reaches
                       45.42 in FS1 and 2.815 in FS2, not below 1
    w other than 0     the claims need e to stay in E, which (39)-(41) do not give;
                       alpha_q does
    L_4                equals L_3 in the first list, an error of copying
    =================  ===========================================================

    Examples
    --------
    >>> import obsynth as ob
    >>> region = ob.Ellipsoid([0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [10, 10, 10, 0, 0, 0])
    >>> QPVObserver(region=region, eta=0.2).norm
    'h2'
    """

    norm: Literal["h2", "hinf"] = "h2"
    region: Ellipsoid | None = None
    polytope: Any = "box"
    kappa: float | None = None
    eta: float | None = None
    alpha: float = 0.1
    performance_output: ArrayLike | None = None
    polya: int | None = None
    initial_error: ArrayLike | None = None
    E_x: ArrayLike | None = None
    alpha_q: float | None = None
    gain_cap: float | None = None
    form_of_N: Literal["upper", "symmetric"] = "upper"
    Ts: float | None = None
    form: Literal["corrected", "printed"] = "corrected"

    def __post_init__(self) -> None:
        for name, values in (
            ("norm", ("h2", "hinf")),
            ("form_of_N", ("upper", "symmetric")),
            ("form", ("corrected", "printed")),
        ):
            given = getattr(self, name)
            if given not in values:
                raise ObsynthError(
                    f"{name} is {given!r}; it has to be one of {', '.join(map(repr, values))}",
                    option=name,
                )
        if not isinstance(self.region, Ellipsoid):
            raise ObsynthError(
                f"region is {self.region!r}; the quadratic error dynamics contract only where "
                "state and faults stay in a known set: give region=Ellipsoid(Q, c)",
                option="region",
            )
        self._check_numbers()
        for name in ("polytope", "performance_output", "initial_error", "E_x"):
            value = getattr(self, name)
            if value is not None and not (name == "polytope" and isinstance(value, str)):
                object.__setattr__(self, name, _array(name, value))
        if isinstance(self.polytope, str) and self.polytope not in ("box", "cross"):
            raise ObsynthError(
                f"polytope is {self.polytope!r}; it has to be 'box', 'cross' or an array of "
                "vertices, offsets from the centre c",
                option="polytope",
            )
        if (self.E_x is None) != (self.initial_error is None):
            missing = "initial_error" if self.initial_error is None else "E_x"
            raise ObsynthError(
                f"{missing} is missing: to take P_e apart from P_x give both initial_error (where "
                "e(0) lies) and E_x (how far the error may go on its way)",
                option=missing,
            )
        if self.form == "printed" and (self.alpha_q is not None or self.E_x is not None):
            raise ObsynthError(
                'form="printed" stands for (19)-(23) and (39)-(41), which have neither alpha_q '
                "nor E_x",
                option="form",
            )

    def _check_numbers(self) -> None:
        for name in ("kappa", "eta", "alpha_q", "gain_cap", "Ts"):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0):
                raise ObsynthError(f"{name} is {value!r}; it has to be positive", option=name)
        if self.eta is not None and self.eta > 1:
            raise ObsynthError(
                f"eta is {self.eta!r}; 1 / eta enlarges the polytopes, so it lies in (0, 1]",
                option="eta",
            )
        if not (np.isfinite(self.alpha) and self.alpha >= 0):
            raise ObsynthError(
                f"alpha is {self.alpha!r}; a decay rate is not negative", option="alpha"
            )
        if self.polya is not None:
            from obsynth.designs.qpv.polya import polya_terms

            polya_terms(1, self.polya)

    def design(self, model_or_form: Plant | QPV) -> Observer:
        """Design, prove and return the observer.

        Parameters
        ----------
        model_or_form : Plant or QPV
            Continuous time.

        Returns
        -------
        Observer
            With a certificate in which every claim is proved.

        Raises
        ------
        StructureError
            If the plant is outside the class, or a fault is not seen everywhere in the sets;
            before any LMI.
        InfeasibleDesign
            If the sets do not fit together, or no gain exists; says what binds.
        CertificateError
            For ``form="printed"``, with the printed optimum and what it does not prove.
        """
        return self._work(model_or_form).design()

    def analyse(self, model_or_form: Plant | QPV, gains: Mapping[str, ArrayLike]) -> Observer:
        """Return what the given gains guarantee, proved.

        Parameters
        ----------
        model_or_form : Plant or QPV
        gains : mapping
            ``L1``, ``L2``, ... of shape (n, m), one per vertex of the scheduling variables, the
            last variable fastest.

        Raises
        ------
        InfeasibleDesign
            If no P shows the required property for these gains.
        """
        work = self._work(model_or_form)
        return work.design(work.read_gains(gains))

    def problem(self, model_or_form: Plant | QPV) -> Problem:
        """Return the design problem at the given eta, see `Problem.to_cvxpy`.

        Raises
        ------
        ObsynthError
            If eta is not given: the inequalities are linear only for a fixed one.
        """
        from obsynth.designs.qpv.synthesis import state_problem

        work = self._work(model_or_form)
        if work.eta is None:
            raise ObsynthError("the inequalities are linear only for a fixed eta: give eta=")
        return state_problem(work.setting(work.eta))

    def _work(self, model_or_form: Plant | QPV) -> Workspace:
        from obsynth.designs.qpv.work import Workspace

        return Workspace.of(self, model_or_form)

    def options(self) -> dict[str, Any]:
        """Return the options as JSON-able data, the region apart."""
        values: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if name != "region":
                values[name] = value.tolist() if isinstance(value, np.ndarray) else value
        return values

    def with_eta(self, eta: float) -> QPVObserver:
        """Return the same options with another eta."""
        return replace(self, eta=eta)


def _array(name: str, value: ArrayLike) -> FloatArray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ObsynthError(f"{name} is no array of numbers: {value!r}", option=name) from error
    if array.ndim not in (1, 2, 3) or not np.isfinite(array).all():
        raise ObsynthError(f"{name} has to hold finite numbers; got {value!r}", option=name)
    return array
