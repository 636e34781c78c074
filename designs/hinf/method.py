"""`HinfUIO`: options of the method, and the way from a model to an observer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.hinf.claims import prove_level
from obsynth.designs.hinf.given import read_diagonal, read_gains, unstable_gains
from obsynth.designs.hinf.model import Prepared, prepare
from obsynth.designs.hinf.problems import Structure, state_problem
from obsynth.designs.hinf.record import Bound, HinfDesign
from obsynth.designs.hinf.sector import MULTIPLIERS, Multipliers
from obsynth.designs.hinf.synthesis import (
    Found,
    find_filter,
    find_level,
    find_storage,
    unstable_vertex,
)
from obsynth.designs.hinf.system import Filter
from obsynth.symbolic.errors import ObsynthError

if TYPE_CHECKING:
    from obsynth.derive import JacobianBounds, Split
    from obsynth.designs.core.observer import Observer
    from obsynth.designs.lmi import Problem
    from obsynth.symbolic import Plant


METHODS = ("standard", "polytopic", "general")
FORMS = ("corrected", "printed")


@dataclass(frozen=True)
class HinfUIO:
    """Unknown input observer with a guaranteed energy gain from disturbances to fault errors.

    For discrete-time plants ``x+ = A x + B u + g(x, u) + L f + W w``, ``y = C x`` with
    rank(C L) = rank(L). The fault f is decoupled and estimated one sample later; unknown
    inputs of the plant are decoupled with it.

    Parameters
    ----------
    method : {"standard", "polytopic", "general"}
        The filter (18)-(19) by multipliers; the same filter by the vertices of the Jacobian; the
        filter with free F = L (C L)^+ + Z, H = (C L)^+ + Y and D, which feeds the last
        innovation to the fault estimate.
    multipliers : {"single", "per_row", "per_entry"}, optional
        How finely the nonlinearity is bounded: one number for g as a whole (the default of
        ``"standard"``), one per row of g, one per entry of its Jacobian. Without them
        ``"general"`` takes the vertices.
    drop_zero_rows : bool
        Leave rows of g that are zero out of s. The paper keeps them, and so allows for a
        nonlinearity that is not there.
    mu : float, optional
        A level to guarantee; the least one where not given.
    slack : float
        The level that is guaranteed in place of the infimum ``least_mu``, at the smallest trace
        of P: several infima are reached only as P grows without bound.
    decay : float, optional
        Also guarantee V+ < decay V where w = 0, in (0, 1).
    majorant : sequence of float, optional
        Diagonal of M'M in (5), proved to be one; `obsynth.majorant` by default. For
        ``multipliers="single"``.
    form : {"corrected", "printed"}
        (45) with (37) as printed, with ``method="standard"`` and one multiplier.

    Raises
    ------
    ObsynthError
        For an option that is not known, out of range, or of no use with the others.

    Notes
    -----
    M. Witczak, J. Korbicz, R. Jozefowicz, "A H-infinity approach to robust fault estimation of
    non-linear discrete-time systems". What does not hold as printed:

    ===========  ==============================================================
    in print     correct
    ===========  ==============================================================
    (11)         matrices have no largest one in this order: no M within the
                 bounds need satisfy M_x'M_x <= M'M
    (12)-(13)    lambda is +gamma^2, and its largest value over a box is a
                 maximum of a convex function (vertices), no generalised
                 eigenvalue problem
    (14)         gamma^2 I in place of (52) gives mu = 2.104, not .499
    (15)         observability is not enough: (Abar, C) has to be detectable,
                 that is, the zeros of (A, L, C) stable
    (31)         the terms A'Hbar A, Hbar A and s_{k+1}'Q s_{k+1} carry a plus
    (34), (41)   A1'Hbar is A'Hbar
    (43)         diag(I, I, I, I, P)
    (50)         cos(12 x1) where (51)-(53) belong to cos(12 x2); for the
                 printed g the printed K is unstable
    (55)         white noise is not in l2; (25) can be checked over finite
                 horizons only
    ===========  ==============================================================

    (45) with (37) holds as printed, but the factor 2 on P, Q and alpha buy nothing: one
    multiplier and V = e'Pe give a smaller mu. K is not unique.

    Examples
    --------
    >>> from obsynth.symbolic.plants import hinf_example
    >>> observer = HinfUIO(method="general").design(hinf_example())
    >>> round(observer.performance["least_mu"], 4), observer.certificate.valid
    (0.4586, True)
    """

    method: Literal["standard", "polytopic", "general"] = "standard"
    multipliers: Multipliers | None = None
    drop_zero_rows: bool = True
    mu: float | None = None
    slack: float = 5e-4
    decay: float | None = None
    majorant: tuple[float, ...] | None = None
    form: Literal["corrected", "printed"] = "corrected"

    def __post_init__(self) -> None:
        allowed: dict[str, tuple[Any, ...]] = {
            "method": METHODS,
            "multipliers": (None, *MULTIPLIERS),
            "form": FORMS,
        }
        for name, values in allowed.items():
            given = getattr(self, name)
            if given not in values:
                raise ObsynthError(
                    f"{name} is {given!r}; it has to be one of {', '.join(map(repr, values))}",
                    option=name,
                )
        if self.mu is not None and not 0.0 < self.mu < np.inf:
            raise ObsynthError(f"mu is {self.mu!r}; a level is positive and finite", option="mu")
        if not 0.0 < self.slack < np.inf:
            raise ObsynthError(
                f"slack is {self.slack!r}; it is positive, since an infimum is not attained",
                option="slack",
            )
        if self.decay is not None and not 0.0 < self.decay < 1.0:
            raise ObsynthError(
                f"decay is {self.decay!r}; the factor of V per step lies between 0 and 1",
                option="decay",
            )
        if self.majorant is not None:
            object.__setattr__(self, "majorant", read_diagonal(self.majorant))
        self._refuse_contradictions()

    def _refuse_contradictions(self) -> None:
        if self.method == "polytopic" and self.multipliers is not None:
            raise ObsynthError(
                'method="polytopic" takes the vertices of the Jacobian and no multipliers',
                option="multipliers",
            )
        if self.majorant is not None and self._multipliers != "single":
            raise ObsynthError(
                'majorant= is the diagonal of one M\'M and needs multipliers="single"',
                option="majorant",
            )
        if self.form == "printed" and (
            self.method != "standard" or self._multipliers != "single" or self.decay is not None
        ):
            raise ObsynthError(
                'form="printed" stands for (45), which has method="standard", one multiplier and '
                "no decay",
                option="form",
            )

    @property
    def _multipliers(self) -> Multipliers | None:
        if self.multipliers is None and self.method == "standard":
            return "single"
        return self.multipliers

    @property
    def _structure(self) -> Structure:
        if self.form == "printed":
            return "printed"
        return "general" if self.method == "general" else "standard"

    def design(
        self, model_or_split: Plant | Split, bounds: JacobianBounds | None = None
    ) -> Observer:
        """Design, prove and return the observer.

        Parameters
        ----------
        model_or_split : Plant or Split
            Discrete time; a plant is split into its linear terms and the rest.
        bounds : JacobianBounds, optional
            Of the split's g, where they are at hand.

        Returns
        -------
        Observer
            ``performance["l2_gain"]`` is the level that is proved.

        Raises
        ------
        StructureError
            If the model is outside the class, or a rank or detectability condition fails;
            before any LMI.
        InfeasibleDesign
            If no observer of this form exists at the level; says which level is feasible.
        UnboundedError
            If the Jacobian is unbounded over the declared box.
        """
        prepared = self._prepare(model_or_split, bounds)
        data = prepared.design.data
        least = None
        if self.mu is None:
            least = find_level(data, self._structure, self.decay)
        last: Exception | None = None
        for level in self._levels(least):
            try:
                gains, found = find_filter(data, self._structure, level, self.decay)
            except InfeasibleDesign as refusal:
                last = refusal
                if self.mu is not None:
                    break
                continue
            except SolverTrouble as trouble:
                last = trouble
                continue
            design = self._certified(prepared, level, least, gains, found)
            if design is not None:
                return self._assemble(design, prepared)
        if self.mu is not None:
            raise self._refusal(prepared) from last
        raise SolverTrouble(
            f"the least mu is {least:.6g}, but no filter was proved up to 1 % above it",
            [*(() if last is None else (str(last),)), "give a larger slack= or mu="],
            least_mu=least,
        ) from last

    def analyse(
        self,
        model_or_split: Plant | Split,
        gains: Mapping[str, ArrayLike],
        bounds: JacobianBounds | None = None,
    ) -> Observer:
        """Return what given gains guarantee, proved.

        Parameters
        ----------
        model_or_split : Plant or Split
        gains : mapping
            ``K`` of shape (n, m); ``F`` (n, m), ``H`` (n_f, m) and ``D`` (n_f, m) of the
            general filter, by default those of (18)-(19).
        bounds : JacobianBounds, optional

        Returns
        -------
        Observer
            ``performance["l2_gain"]`` is an upper bound of the worst-case gain; compare
            `obsynth.worst_case`. Its tightness depends on ``method``: ``"polytopic"`` is the
            sharpest.

        Raises
        ------
        InfeasibleDesign
            If the error is unstable at a vertex of the Jacobian set, which is named, or the gains
            guarantee nothing.
        """
        prepared = self._prepare(model_or_split, bounds)
        data = prepared.design.data
        chosen = read_gains(prepared.design, gains)
        if self.form == "printed" and chosen.D.any():
            raise ObsynthError('form="printed" has no gain D; leave it out', option="D")
        unstable = unstable_vertex(data, chosen)
        if unstable is not None:
            raise unstable_gains(prepared, *unstable)
        least = None
        if self.mu is None:
            least = find_level(data, self._structure, self.decay, chosen)
        for level in self._levels(least):
            try:
                found = find_storage(data, self._structure, level, chosen, self.decay)
            except InfeasibleDesign:
                if self.mu is not None:
                    raise
                continue
            design = self._certified(prepared, level, least, chosen, found)
            if design is not None:
                return self._assemble(design, prepared)
        raise SolverTrouble(
            "no level was proved for these gains", ["give a larger slack= or mu="], least_mu=least
        )

    def problem(
        self, model_or_split: Plant | Split, bounds: JacobianBounds | None = None
    ) -> Problem:
        """Return the design LMI in the plant's units, see `Problem.to_cvxpy`.

        Without ``mu`` it minimises ``mu2``, the square of the level; with it the trace of P.
        """
        data = self._prepare(model_or_split, bounds).design.data
        return state_problem(data, self._structure, self.mu, self.decay)

    def _prepare(
        self, model_or_split: Plant | Split, bounds: JacobianBounds | None = None
    ) -> Prepared:
        drop = self.drop_zero_rows and self.form != "printed"
        prepared = prepare(model_or_split, self._multipliers, drop, self.majorant, bounds)
        options = asdict(self) | {"multipliers": self._multipliers, "drop_zero_rows": drop}
        return replace(prepared, design=replace(prepared.design, options=options))

    def _levels(self, least: float | None) -> list[float]:
        if self.mu is not None:
            return [self.mu]
        growth = [self.slack * 2.0**k for k in range(12)]
        return [(least or 0.0) * (1.0 + s) for s in growth if s <= max(self.slack, 0.01)]

    def _certified(
        self,
        prepared: Prepared,
        level: float,
        least: float | None,
        gains: Filter,
        found: Found,
    ) -> HinfDesign | None:
        """Complete a design if its level can be proved, else look for a storage with more room."""
        options = dict(prepared.design.options) | {"least_mu": least}
        design = replace(prepared.design, gains=gains, options=options)
        design = replace(design, bound=self._bound(level, found))
        if all(claim.holds for claim in prove_level(design)):
            return design
        try:
            more = find_storage(design.data, self._structure, level, gains, self.decay)
        except (InfeasibleDesign, SolverTrouble):
            return None
        # The nearer to the first one, the smaller is P.
        for share in np.geomspace(1e-8, 1.0, 17):
            design = replace(design, bound=self._bound(level, found.mixed(more, float(share))))
            if all(claim.holds for claim in prove_level(design)):
                return design
        return None

    def _bound(self, level: float, found: Found) -> Bound:
        decays = self.decay is not None
        return Bound(
            level,
            found.P,
            found.tau,
            found.printed,
            self.decay,
            found.tau_decay if decays else None,
        )

    def _assemble(self, design: HinfDesign, prepared: Prepared) -> Observer:
        from obsynth.designs.hinf.assembly import assemble

        return assemble(design, derived=(prepared.split, prepared.bounds, prepared.majorant))

    def _refusal(self, prepared: Prepared) -> InfeasibleDesign:
        """Say which level is feasible where the given one is not."""
        data = prepared.design.data
        least = find_level(data, self._structure, self.decay)
        details = [f"the least level of this form is {least:.6g}"]
        if self.mu is not None and self.mu > least:
            return InfeasibleDesign(
                f"mu = {self.mu:.6g} leaves too little room for a proof",
                [*details, "ask for a level .01 % above it"],
                mu=self.mu,
                least_mu=least,
            )
        if self.method != "general" and prepared.design.family.vertex_count == len(data.vertices):
            other = find_level(replace(data, sector=None), "general", self.decay)
            details.append(f'method="general" reaches {other:.6g}')
        return InfeasibleDesign(
            f"mu = {self.mu:.6g} is infeasible", details, mu=self.mu, least_mu=least
        )
