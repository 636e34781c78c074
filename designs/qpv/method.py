"""`QPVObserver`: options of the method, and the way from a model to an observer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import QPV
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.given import POSITIVE, Number, read_gains, read_matrix
from obsynth.designs.core.guard import MOST_CALLS
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.lmi.problem import Problem
from obsynth.designs.qpv import claims, model, step
from obsynth.designs.qpv.claims import prove_rounding
from obsynth.designs.qpv.model import (
    CLASS,
    QPVModel,
    check_faults,
    check_polytope,
    cover,
    default_sets,
    reach,
    read_apart,
    read_form,
    read_noise,
    read_performance_output,
    read_region,
    takes_rate,
    unit_shape,
)
from obsynth.designs.qpv.printed import printed_refusal
from obsynth.designs.qpv.record import FormOfN, Norm, QPVDesign
from obsynth.designs.qpv.rounding import settle
from obsynth.designs.qpv.sets import Ellipsoid
from obsynth.designs.qpv.step import SETTLED, found_again
from obsynth.designs.qpv.synthesis import Setting, search_eta, state_problem, synthesise
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

ETA = Number(0.0, at_most=1.0, because="1 / eta enlarges the polytopes, so it lies in (0, 1]")
DECAY = Number(at_least=0.0, because="a decay rate is not negative")
TRIES = 4
"""How often a design in single precision is solved for the room that its rounding needs."""
ORDER = Number(at_least=2.0, because="the order s of the relaxation is an integer from 2 on")


@dataclass(frozen=True, eq=False)
class QPVObserver(Method):
    """Observer of states and process faults of parameter-varying plants, in continuous time.

    For ``x' = A(theta) x + B(theta) u + G(theta) w + sum_k A_fk(theta) f_k x``, ``y = C(theta) x +
    H(theta) w`` with measured theta: faults become states, which makes the plant quadratic, and
    the gain is scheduled, ``L(theta) = sum_l mu_l(theta) L_l``. Gains that are given are ``L1``,
    ``L2``, ... of shape (n, m), one per vertex of the scheduling, the last variable fastest.

    Parameters
    ----------
    norm : {"h2", "hinf"}
        What is minimised: mu, a bound of trace(Cz P^-1 Cz') with V' < w'w, or gamma, a bound of
        the squared L2 gain from w to z = Cz e.
    region : Ellipsoid, optional
        X of (18), in which states and faults are assumed to stay; states first, then faults. By
        default the smallest one of the declared ranges' proportions that holds all of them; `E_x`
        (half of the half ranges), `initial_error` (a tenth of the half ranges of the states, no
        fault: tell `Observer.memory0` an `x_range`) and, where disturbances have bounds and with
        ``norm="h2"``, `alpha_q` (`alpha`) then have defaults too.
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
    systems using robust QPV observers". What does not hold as printed, and what
    shows it: docs/methods/qpv_observer.md.

    Examples
    --------
    >>> import obsynth as ob
    >>> region = ob.Ellipsoid([0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [10, 10, 10, 0, 0, 0])
    >>> QPVObserver(region=region, eta=0.2).norm
    'h2'
    """

    CLASS = CLASS
    CONTRACT = Contract.of("qpv_observer", QPVDesign, claims, model, step, quiet=True)

    norm: Norm = "h2"
    region: Ellipsoid | None = None
    polytope: Any = "box"
    kappa: Annotated[float | None, POSITIVE] = None
    eta: Annotated[float | None, ETA] = None
    alpha: Annotated[float, DECAY] = 0.1
    performance_output: ArrayLike | None = None
    polya: Annotated[int | None, ORDER] = None
    initial_error: ArrayLike | None = None
    E_x: ArrayLike | None = None
    alpha_q: Annotated[float | None, POSITIVE] = None
    gain_cap: Annotated[float | None, POSITIVE] = None
    form_of_N: FormOfN = "upper"
    Ts: Annotated[float | None, POSITIVE] = None
    form: Literal["corrected", "printed"] = "corrected"

    def check(self) -> None:
        """Read what is an array; refuse options that do not fit each other."""
        if self.region is not None and not isinstance(self.region, Ellipsoid):
            raise ObsynthError(
                f"region is {self.region!r}; the quadratic error dynamics contract only where "
                "state and faults stay in a known set: give region=Ellipsoid(Q, c)",
                option="region",
            )
        for name in ("polytope", "performance_output", "initial_error", "E_x"):
            value = getattr(self, name)
            if value is not None and not (name == "polytope" and isinstance(value, str)):
                object.__setattr__(self, name, read_matrix(name, value, (1, 2, 3)))
        if isinstance(self.polytope, str) and self.polytope not in ("box", "cross"):
            raise ObsynthError(
                f"polytope is {self.polytope!r}; it has to be 'box', 'cross' or an array of "
                "vertices, offsets from the centre c",
                option="polytope",
            )
        if self.region is not None and (self.E_x is None) != (self.initial_error is None):
            missing = "initial_error" if self.initial_error is None else "E_x"
            raise ObsynthError(
                f"{missing} is missing: to take P_e apart from P_x give both initial_error (where "
                "e(0) lies) and E_x (how far the error may go on its way)",
                option=missing,
            )
        apart = self.region is None or self.E_x is not None
        if self.form == "printed" and (self.alpha_q is not None or apart):
            raise ObsynthError(
                'form="printed" stands for (19)-(23) and (39)-(41), which have neither alpha_q '
                "nor E_x, nor defaults: give region= alone",
                option="form",
            )

    def read(self, given: Plant | QPV) -> QPVModel:
        """Derive the quadratic form; read the sets, the performance output and the noise."""
        form = read_form(given, self.form_of_N)
        sets = {name: getattr(self, name) for name in ("region", "E_x", "initial_error")}
        rate = self.alpha_q
        if self.region is None:
            sets = {k: v if sets[k] is None else sets[k] for k, v in default_sets(form).items()}
            if rate is None and self.norm == "h2" and self.alpha > 0.0 and takes_rate(form.model):
                rate = self.alpha
        region = read_region(sets["region"], form)
        if self.norm == "hinf" and not form.model.w:
            raise ObsynthError(
                'norm="hinf" is a gain from disturbances, and the plant has none; declare '
                'plant.disturbances(...), or use norm="h2"',
                option="norm",
            )
        unit = unit_shape(self.polytope, region)
        apart = read_apart(sets["E_x"], sets["initial_error"], form)
        kappa, eta = self.kappa, self._fixed_eta(apart is not None)
        if kappa is None and apart is None:
            kappa = 1.0 / reach(unit, region)
        elif kappa is None:
            kappa = cover(unit, region) * (1.0 if eta is None else eta)
        model = QPVModel(
            form,
            region,
            unit,
            kappa,
            apart,
            read_performance_output(self.performance_output, form),
            read_noise(rate, form.model),
        )
        return check_polytope(model, eta)

    def solve(self, model: QPVModel) -> QPVDesign:
        """Find P and the gains; refuse ``form="printed"`` with what its optimum does not prove."""
        return self._solve(model)

    def fix(self, model: QPVModel, gains: Mapping[str, ArrayLike]) -> QPVDesign:
        """Find P for gains L1, L2, ...; a P among them is not looked at."""
        n, m, _ = model.data.sizes
        shapes = {f"L{k}": (n, m) for k in range(1, len(model.data.A) + 1)}
        found = read_gains({k: value for k, value in gains.items() if k != "P"}, shapes)
        return self._solve(model, np.stack([found[name] for name in shapes]))

    def problem(self, given: Plant | QPV) -> Problem:
        """Return the design problem at the given eta, see `Problem.to_cvxpy`.

        Raises
        ------
        ObsynthError
            If eta is not given: the inequalities are linear only for a fixed one.
        """
        model = self._checked(given)
        if self._fixed_eta(model.apart is not None) is None:
            raise ObsynthError("the inequalities are linear only for a fixed eta: give eta=")
        return state_problem(self.setting(model))

    def setting(self, model: QPVModel) -> Setting:
        """Return what the inequalities depend on, at the given eta or else at the largest one."""
        eta = self._fixed_eta(model.apart is not None)
        return Setting(
            model,
            model.largest_eta if eta is None else eta,
            self.norm,
            self.alpha,
            self.polya,
            self.gain_cap,
            self.form == "printed",
        )

    def options(self) -> Mapping[str, Any]:
        """Return the options as JSON-able data, the region apart."""
        return {name: value for name, value in super().options().items() if name != "region"}

    def _rounded(self, setting: Setting, gains: FloatArray | None) -> QPVDesign:
        """Solve; in single precision again, with room for what rounding adds."""
        for _ in range(TRIES):
            design = settle(synthesise(setting, self.options(), gains, self.Ts))
            if self.precision == "double" or not design.bounded:
                return design
            if not np.isfinite(design.rounding):
                break
            if prove_rounding(design).holds:
                return design
            setting = replace(setting, room=2.0 * design.rounding)
        half = np.sqrt(design.inverse_diagonal)
        raise InfeasibleDesign(
            "rounding in single precision leaves the error set no room: take precision='double'",
            [
                f"{name}: +-inf in single precision, +-{near:.3g} in doubles"
                for name, near in zip(setting.model.form.names, half, strict=True)
            ],
            option="precision",
        )

    def _fixed_eta(self, apart: bool) -> float | None:
        """Return the given eta; 1 for sets apart from each other, None to search it."""
        return 1.0 if self.eta is None and apart else self.eta

    def _solve(self, model: QPVModel, gains: FloatArray | None = None) -> QPVDesign:
        setting = self.setting(model)
        if self._fixed_eta(model.apart is not None) is None:
            setting = search_eta(setting, gains)
        check_faults(setting.data, setting.sets, model.form.names)
        if setting.printed:
            raise printed_refusal(setting, gains)
        design = self._rounded(setting, gains)
        rate = design.alpha if design.noise is None else design.noise.rate
        most = MOST_CALLS * design.Ts
        seconds = min(SETTLED / rate, most) if rate > 0.0 and found_again(design) else most
        return replace(design, options=self.settling(seconds, design.Ts))
