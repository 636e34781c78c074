"""`HinfUIO`: options of the method, and the way from a model to an observer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds, Split
from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.core.given import Number, changed, read_gains, read_matrix, refuse_idle
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.observer import Observer
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.hinf import claims, model, step, synthesis
from obsynth.designs.hinf.claims import RESIDUAL, decoupling_residual, prove_level
from obsynth.designs.hinf.model import CLASS, HinfModel, read
from obsynth.designs.hinf.record import Bound, HinfDesign
from obsynth.designs.hinf.synthesis import Found, Structure
from obsynth.designs.hinf.system import Filter, Multipliers, SectorForm
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError

LEVEL = Number(above=0.0, because="a level is positive and finite")
SLACK = Number(above=0.0, because="it is positive, since an infimum is not attained")
DECAY = Number(0.0, 1.0, because="the factor of V per step lies between 0 and 1")
# What the general class has no use for.
IDLE = ("method", "multipliers", "drop_zero_rows", "mu", "slack", "decay", "majorant")
DIAGONAL = Number(at_least=0.0, because="it has to be the diagonal of M'M, not negative")


@dataclass(frozen=True)
class HinfUIO(Method):
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
    form : {"general", "corrected", "printed"}, optional
        "general": plants ``x+ = F(x, u, f, d, w), y = h(x, u, f, w)`` of any form, where by default
        those go that the paper's class does not have (noisy outputs, varying gains, ...), if their
        disturbances have bounds and their faults rates: both count in units of these, faults in
        units of half their ranges, and fhat is of the same instant. "printed": (45) with (37) as
        printed, with ``method="standard"`` and one multiplier.

    Raises
    ------
    ObsynthError
        For an option that is not known, out of range, or of no use with the others.

    Notes
    -----
    ``performance["l2_gain"]`` is the level that is proved; `obsynth.worst_case` shows how much of
    it a disturbance reaches. `analyse` takes the gain ``K`` of shape (n, m), and of the general
    filter ``F`` (n, m), ``H`` (n_f, m) and ``D`` (n_f, m), by default those of (18)-(19);
    ``method="polytopic"`` is the sharpest for given gains.

    M. Witczak, J. Korbicz, R. Jozefowicz, "A H-infinity approach to robust fault estimation of
    non-linear discrete-time systems". What does not hold as printed, and what
    shows it: docs/methods/hinf_uio.md.

    (45) with (37) holds as printed, but the factor 2 on P, Q and alpha buy nothing: one
    multiplier and V = e'Pe give a smaller mu. K is not unique.

    Examples
    --------
    >>> from obsynth.symbolic.plants import hinf_example
    >>> observer = HinfUIO(method="general").design(hinf_example())
    >>> round(observer.performance["least_mu"], 4), observer.certificate.valid
    (0.4586, True)
    """

    CLASS = CLASS
    SPLITS = True
    CONTRACT = Contract.of(
        "hinf_uio",
        HinfDesign,
        claims,
        model,
        step,
        shared=("prediction", "innovation", "running"),
        fault_delay=1,
    )

    method: Literal["standard", "polytopic", "general"] = "standard"
    multipliers: Multipliers | None = None
    drop_zero_rows: bool = True
    mu: Annotated[float | None, LEVEL] = None
    slack: Annotated[float, SLACK] = 5e-4
    decay: Annotated[float | None, DECAY] = None
    majorant: Annotated[tuple[float, ...] | None, DIAGONAL] = None
    form: Literal["general", "corrected", "printed"] | None = None

    def __post_init__(self) -> None:
        if self.majorant is not None:
            object.__setattr__(self, "majorant", _diagonal(self.majorant))
        super().__post_init__()

    def _design(self, model: Plant | Split, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer."""
        if self.form == "general":
            return self._as_general().design(model if isinstance(model, Plant) else model.model)
        try:
            found = self._checked(model, bounds)
        except (StructureError, DerivationError) as refusal:
            if not self._open or not isinstance(model, Plant):
                raise
            try:
                return self._as_general().design(model)
            except (StructureError, DerivationError, UnboundedError) as beyond:
                raise refusal from beyond
        return self._certified(self.solve(found), found)

    def analyse(
        self,
        model: Plant | Split,
        gains: Mapping[str, ArrayLike],
        bounds: JacobianBounds | None = None,
    ) -> Observer:
        """Return what given gains guarantee: ``K`` and more, or ``L``; see `Method.analyse`."""
        if self.form == "general" or (self._open and "L" in gains):
            return self._as_general().analyse(model, gains)
        return super().analyse(model, gains, bounds)

    @property
    def _open(self) -> bool:
        """Whether no option speaks of the paper's class alone."""
        return self.form is None and not changed(self, *IDLE)

    def _as_general(self) -> GeneralUIO:
        return GeneralUIO.instead_of(self, IDLE, bounds="l2")

    def check(self) -> None:
        """Refuse options that do not fit each other."""
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
        if self.mu is not None:
            refuse_idle(self, "mu=, which is the level itself", "slack")
        if self._multipliers is None:
            refuse_idle(self, "the vertices of the Jacobian", "drop_zero_rows")
        if self.form == "printed" and (
            self.method != "standard" or self._multipliers != "single" or self.decay is not None
        ):
            raise ObsynthError(
                'form="printed" stands for (45), which has method="standard", one multiplier and '
                "no decay",
                option="form",
            )

    def read(self, given: Plant | Split, bounds: JacobianBounds | None = None) -> HinfModel:
        """Split the plant, check the structural conditions, bound the nonlinearity."""
        form = None
        if self._multipliers is not None:
            drop = self.drop_zero_rows and self.form != "printed"
            form = SectorForm(self._multipliers, drop, self.majorant)
        return read(given, form, bounds)

    def solve(self, model: HinfModel) -> HinfDesign:
        """Find the filter with the smallest trace of P at the first level that is proved."""

        def find(level: float) -> tuple[Filter, Found]:
            return synthesis.find_filter(model.design.data, self._structure, level, self.decay)

        return self._first_proved(model, find)

    def fix(self, model: HinfModel, gains: Mapping[str, ArrayLike]) -> HinfDesign:
        """Bound the gain from w to f - fhat of a given filter."""
        chosen = _read_filter(model.design, gains)
        if self.form == "printed" and chosen.D.any():
            raise ObsynthError('form="printed" has no gain D; leave it out', option="D")
        unstable = synthesis.unstable_vertex(model.design.data, chosen)
        if unstable is not None:
            raise _unstable_gains(model, *unstable)

        def find(level: float) -> tuple[Filter, Found]:
            data = model.design.data
            return chosen, synthesis.find_storage(data, self._structure, level, chosen, self.decay)

        return self._first_proved(model, find, chosen)

    def problem(self, given: Plant | Split, bounds: JacobianBounds | None = None) -> Problem:
        """Return the design LMI in the plant's units, see `Problem.to_cvxpy`.

        Without ``mu`` it minimises ``mu2``, the square of the level; with it the trace of P.
        """
        model: HinfModel = self._checked(given, bounds)
        return synthesis.state_problem(model.design.data, self._structure, self.mu, self.decay)

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

    def _first_proved(
        self,
        model: HinfModel,
        find: Callable[[float], tuple[Filter, Found]],
        gains: Filter | None = None,
    ) -> HinfDesign:
        """Return the design at the first level that is proved, from just above the least one."""
        least = None
        if self.mu is not None:
            levels = [self.mu]
        else:
            least = synthesis.find_level(model.design.data, self._structure, self.decay, gains)
            growth = [self.slack * 2.0**k for k in range(12)]
            levels = [least * (1.0 + s) for s in growth if s <= max(self.slack, 0.01)]
        last: Exception | None = None
        for level in levels:
            try:
                design = self._proved(model, level, least, *find(level))
            except (InfeasibleDesign, SolverTrouble) as refusal:
                last = refusal
                continue
            if design is not None:
                return design
        if least is None and gains is None:
            raise self._refusal(model, last) from last
        if least is None and last is not None:
            raise last
        raise SolverTrouble(
            "no level was proved for these gains"
            if least is None
            else f"the least mu is {least:.6g}, but no filter was proved up to 1 % above it",
            [*(() if last is None else (str(last),)), "give a larger slack= or mu="],
            least_mu=least,
        ) from last

    def _proved(
        self, model: HinfModel, level: float, least: float | None, gains: Filter, found: Found
    ) -> HinfDesign | None:
        """Complete a design if its level can be proved, else look for a storage with more room."""
        given = replace(model.design, gains=gains, options=self.options())

        def complete(found: Found) -> HinfDesign:
            extra = None if self.decay is None else found.tau_decay
            bound = Bound(level, found.P, found.tau, found.printed, self.decay, extra, least)
            return replace(given, bound=bound)

        def holds(design: HinfDesign) -> bool:
            return all(claim.holds for claim in prove_level(design))

        design = complete(found)
        if holds(design):
            return design
        more = synthesis.find_storage(design.data, self._structure, level, gains, self.decay)
        # The nearer to the first one, the smaller is P.
        mixed = (complete(found.mixed(more, float(s))) for s in np.geomspace(1e-8, 1.0, 17))
        return next((design for design in mixed if holds(design)), None)

    def _refusal(
        self, model: HinfModel, last: Exception | None
    ) -> InfeasibleDesign | SolverTrouble:
        """Say which level was found where the given one is not; infeasible only what was shown."""
        data = model.design.data
        least = synthesis.find_level(data, self._structure, self.decay)
        details = [
            f"the least level of this form found with P <= {synthesis.CAP:g} I is {least:.6g}"
        ]
        facts = {"mu": self.mu, "least_mu": least}
        if not isinstance(last, InfeasibleDesign):
            return SolverTrouble(
                f"mu = {self.mu:.9g} leaves too little room for a proof, or for the solver",
                [*details, "ask for a level .01 % above it"],
                **facts,
            )
        if self.method != "general" and model.design.family.vertex_count == len(data.vertices):
            other = synthesis.find_level(replace(data, sector=None), "general", self.decay)
            details.append(f'method="general" reaches {other:.6g}')
        return InfeasibleDesign(
            f"mu = {self.mu:.9g} is {synthesis.NOT_FOUND}",
            [*last.details, *details],
            **facts,
        )


def _diagonal(value: Any) -> tuple[float, ...]:
    """Return the diagonal of M'M from a sequence or a diagonal matrix."""
    array = read_matrix("majorant", value, (1, 2))
    if array.ndim == 2:
        if not np.array_equal(array, np.diag(np.diag(array))):
            raise ObsynthError("majorant= has to be a diagonal M'M", option="majorant")
        array = np.diag(array)
    return tuple(array.tolist())


def _read_filter(design: HinfDesign, gains: Mapping[str, ArrayLike]) -> Filter:
    """Return the filter of given gains; F, H and D as in (18)-(19) where they are not given."""
    blank = design.gains
    shapes = {name: getattr(blank, name).shape for name in ("K", "F", "H", "D")}
    arrays = read_gains(gains, shapes, optional=("F", "H", "D"))
    chosen = replace(design.data.standard_filter(arrays["K"]), **arrays)
    state, fault = decoupling_residual(replace(design, gains=chosen))
    for name, left, identity in (("F", state, "(I - F C) L = 0"), ("H", fault, "H C L = I")):
        if left > RESIDUAL * max(1.0, float(np.abs(design.L).max())):
            raise ObsynthError(
                f"{name} does not decouple {', '.join(design.plant.names('f'))}: {identity} is "
                f"missed by {left:.3g}; round {name} so that it holds to the last digits",
                option=name,
                residual=left,
            )
    return chosen


def _unstable_gains(model: HinfModel, index: int, radius: float) -> InfeasibleDesign:
    """Return the refusal of gains whose error grows at a vertex of the Jacobian set."""
    vertex = model.design.data.vertices[index]
    varying = model.bounds.max > model.bounds.min
    names = model.design.plant.names("x")
    entries = {
        f"dg_{names[i]}/d{names[j]}": float(vertex[i, j])
        for i, j in np.argwhere(varying & (np.abs(vertex) > 1e-12))
    }
    where = ", ".join(f"{name} = {value:.6g}" for name, value in entries.items())
    return InfeasibleDesign(
        f"the error is unstable with these gains: spectral radius {radius:.6f} at the vertex "
        f"{where or index}",
        [
            "a Jacobian that the plant has there or near it makes the estimation error grow",
            "design gains for this plant, or narrow the ranges of the states",
        ],
        spectral_radius=radius,
        vertex=vertex,
        vertex_index=index,
        entries=entries,
    )
