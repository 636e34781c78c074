"""`BoundedErrorUIO`: options of the method, and the way from a model to an observer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds, Split, jacobian_bounds, split
from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.designs.bounded_error import claims, model, printed, step, synthesis
from obsynth.designs.bounded_error.claims import inverse_diagonal_bounds, prove_ellipsoid
from obsynth.designs.bounded_error.lmis import ErrorKind, ErrorSystem, ModelData, build_error_system
from obsynth.designs.bounded_error.model import CLASS, NoiseBox, UioModel, read
from obsynth.designs.bounded_error.record import EllipsoidBound, UioDesign
from obsynth.designs.bounded_error.rounding import settle
from obsynth.designs.bounded_error.synthesis import EllipsoidSolution, Objective
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.core.given import (
    CONTRACTION,
    WEIGHTS,
    changed,
    read_gains,
    read_weights,
    refuse_idle,
    refuse_no_weights,
)
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.observer import Observer
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.lmi.problem import Problem
from obsynth.symbolic import Plant, Role
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

# What the general class has no use for.
IDLE = ("multipliers", "error", "post", "objective")
# Beyond, one block with multipliers is solved in place of one per vertex.
FEW_VERTICES = 16
# Keeps sums of rounded weights at or below 1.
BELOW_ONE = 1.0 - 2.0**-48


@dataclass(frozen=True)
class BoundedErrorUIO(Method):
    """Unknown input observer with guaranteed intervals for states and actuator faults.

    For discrete-time plants ``x+ = A x + B u + D d + g(x, u) + B_f f + W1 w``,
    ``y = C x + W2 w`` with bounded w, bounded fault increments and rank(D) =
    rank(C D) = q.

    Parameters
    ----------
    gamma : float, optional
        Contraction per step of V = e'Pe, in (0, 1); searched where not given. Peak bounds have
        no use for it.
    multipliers : {"equal", "per_component"}
        Whether the boxes of w_k, eps_k, w_{k+1} share the noise ellipsoid in
        equal parts (eq. (19)) or with weights that the LMI chooses.
    error : {"plain", "shifted"}
        The error e of eq. (16), or zeta = T x - z, which w_{k+1} does not enter.
    post : {"common", "per_component"}
        One P for all components, or afterwards a P and gamma for each at the
        gain found.
    bounds : {"ellipsoid", "peak"}
        Intervals from the ellipsoid (eqs. (33)-(36)), or peak (l1) bounds with
        an elementwise small-gain argument, several times narrower, which are those of the general
        class whatever the form.
    objective : {"trace_inverse", "log_det", "lambda_min", "trace"}
        What is optimised: min trace(P^-1), max log det P, max lambda_min(P),
        max trace(P) (the paper's (49), which does not make the bounds small).
    weights : sequence of float, optional
        Of the components (states, then faults), for ``trace_inverse``; by default 1, in the
        general class 1 / half range (there of half widths, for ellipsoids of their squares).
    form : {"general", "corrected", "printed", "repaired"}, optional
        "general": plants ``x+ = F(x, u, f, d, w), y = h(x, u, f, w)`` of any form, in current form
        (the paper's observer predicts first), with one multiplier for every column of every
        nonlinearity in place of vertices; by default unless gamma or an option of the paper's
        class is given to a plant of that class with at most 16 vertices. The paper's class
        has: the direct LMI at the vertices of the exact Jacobian set ("corrected"); (51) as
        printed; (51) with diagonal multipliers, which is valid row by row.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    Notes
    -----
    M. Buciakowski, M. Witczak, V. Puig, D. Rotondo, F. Nejjari, J. Korbicz, "A
    bounded-error approach to simultaneous state and actuator fault estimation
    for a class of nonlinear systems". What does not hold as printed, and what
    shows it: docs/methods/bounded_error_uio.md.

    Examples
    --------
    >>> BoundedErrorUIO(gamma=0.005).objective
    'trace_inverse'
    """

    CLASS = CLASS
    SPLITS = True
    CONTRACT = Contract.of(
        "bounded_error_uio",
        UioDesign,
        claims,
        model,
        step,
        quiet=True,
        shared=("z", "fhat", "prediction"),
    )

    gamma: Annotated[float | None, CONTRACTION] = None
    multipliers: Literal["equal", "per_component"] = "equal"
    error: ErrorKind = "plain"
    post: Literal["common", "per_component"] = "common"
    bounds: Literal["ellipsoid", "peak"] = "ellipsoid"
    objective: Objective = "trace_inverse"
    weights: Annotated[tuple[float, ...] | None, WEIGHTS] = None
    form: Literal["general", "corrected", "printed", "repaired"] | None = None

    def _design(self, model: Plant | Split, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer."""
        if self.form == "general" or self.bounds == "peak":
            plant = model if isinstance(model, Plant) else model.model
            if self.form == "corrected":
                self.CLASS.check(plant)
            return self._as_general().design(plant)
        if self.form is not None or not isinstance(model, Plant):
            return super()._design(model, bounds)
        found = self._of_the_paper(model, bounds)
        if found is not None and (self.gamma is not None or changed(self, *IDLE)):
            return super()._design(*found)
        try:
            return self._beyond(model)
        except (SolverTrouble, InfeasibleDesign):
            if found is None:
                raise
            return super()._design(*found)

    def analyse(
        self,
        model: Plant | Split,
        gains: Mapping[str, ArrayLike],
        bounds: JacobianBounds | None = None,
    ) -> Observer:
        """Return what given gains guarantee: ``K`` and ``F``, or ``L``; see `Method.analyse`."""
        if self.form == "general" or (self.form is None and "L" in gains):
            return self._as_general().analyse(model, gains)
        if self.bounds == "peak":
            return self._peak_of(self._checked(model, bounds).design, gains)
        return super().analyse(model, gains, bounds)

    def _peak_of(self, design: UioDesign, gains: Mapping[str, ArrayLike]) -> Observer:
        """Bound the peaks of the paper's observer: -E reads first, and K, F what Pi leaves."""
        given = read_gains(gains, {"K": design.K.shape, "F": design.F.shape})
        L = np.vstack([-design.E, np.zeros_like(design.F)])
        found = {"L": L, **{name: gain @ design.Pi for name, gain in given.items()}}
        return self._as_general().analyse(design.plant, found)

    def _of_the_paper(
        self, model: Plant, bounds: JacobianBounds | None
    ) -> tuple[Split, JacobianBounds] | None:
        """Split a plant of the paper's class with few vertices; None for others, unless asked."""
        named = changed(self, *IDLE)
        try:
            self.CLASS.check(model)
            parts = split(model)
        except (StructureError, DerivationError):
            if named:
                raise
            return None
        found = jacobian_bounds(parts) if bounds is None else bounds
        few = bool(named) or found.family.vertex_count <= FEW_VERTICES
        return (parts, found) if few else None

    def _beyond(self, model: Plant) -> Observer:
        """Design for the general class; a state that needs a range is named by the paper's."""
        try:
            return self._as_general().design(model)
        except UnboundedError:
            replace(self.CLASS, forbids={}, faults=tuple(Role)).check(model)
            raise

    def _as_general(self) -> GeneralUIO:
        gamma = None if self.bounds == "peak" else self.gamma
        own = {"bounds": self.bounds, "gamma": gamma, "weights": self.weights}
        return GeneralUIO.instead_of(self, IDLE, **own)

    def check(self) -> None:
        """Refuse options that do not fit each other."""
        refuse_no_weights(self.weights)
        if self.bounds == "peak" and self.form in ("corrected", None):
            refuse_idle(self, 'bounds="peak", which has no ellipsoid', *IDLE)
        if self.form in ("printed", "repaired") and (
            self.error != "plain" or self.multipliers != "equal" or self.bounds != "ellipsoid"
        ):
            raise ObsynthError(
                f'form="{self.form}" stands for (51), which has error="plain", '
                'multipliers="equal" and bounds="ellipsoid"',
                option="form",
            )

    def read(self, given: Plant | Split, bounds: JacobianBounds | None = None) -> UioModel:
        """Split the plant, check the structural conditions, bound the Jacobian."""
        return read(given, bounds)

    def solve(self, model: UioModel) -> UioDesign:
        """Find gains and their bounds."""
        return settle(self._design_ellipsoid(model), model.split.proof.rounding)

    def fix(self, model: UioModel, gains: Mapping[str, ArrayLike]) -> UioDesign:
        """Bound the errors of given ``K`` of shape (n, m) and ``F`` of shape (n_f, m)."""
        blank = model.design
        found = read_gains(gains, {"K": blank.K.shape, "F": blank.F.shape})
        given = replace(blank, K=found["K"], F=found["F"], options=self.options())
        given = settle(given, model.split.proof.rounding)
        system, noise, weights = self._setting(model)
        gain = given.gain(self.error)

        def solve(gamma: float) -> EllipsoidSolution:
            return synthesis.synthesise(system, gamma, noise, self.objective, weights, gain)

        def complete(solution: EllipsoidSolution) -> tuple[UioDesign, bool]:
            return self._complete(given, system, solution, noise, weights)

        if self.gamma is None:
            return complete(synthesis.analyse_gain(system, gain, noise, weights))[0]
        return _at_or_explained(
            self.gamma, solve, complete, lambda: synthesis.largest_gamma(system, gain), system, gain
        )

    def problem(self, given: Plant | Split, bounds: JacobianBounds | None = None) -> Problem:
        """Return the design LMI at the given gamma, see `Problem.to_cvxpy`.

        Raises
        ------
        ObsynthError
            If gamma is not given.
        """
        if self.gamma is None:
            raise ObsynthError("the LMI is linear only for a fixed gamma: give gamma=")
        model: UioModel = self._checked(given, bounds)
        if self.form in ("printed", "repaired"):
            data = model.design.data.at(printed.box_vertices(model.bounds))
            return self._by_multipliers(model, data, self.gamma)
        system, free_or_fixed, weights = self._setting(model)
        return synthesis.design_problem(system, self.gamma, free_or_fixed, self.objective, weights)

    def _weights(self, model: UioModel) -> FloatArray:
        design = model.design
        n, weights = design.A.shape[0], read_weights(self.weights, design.plant)
        return np.concatenate([weights[:n][design.kept(self.error)], weights[n:]])

    @staticmethod
    def _noise(model: UioModel, blocks: int) -> FloatArray:
        design = model.design
        boxes = NoiseBox(design.w_centre, design.w_radius, design.rate)
        return boxes.equal_weights(blocks) * BELOW_ONE

    def _setting(self, model: UioModel) -> tuple[ErrorSystem, FloatArray | None, FloatArray]:
        system = build_error_system(model.design.data, self.error)
        noise = None if self.multipliers == "per_component" else self._noise(model, system.blocks)
        return system, noise, self._weights(model)

    def _design_ellipsoid(self, model: UioModel) -> UioDesign:
        system, noise, weights = self._setting(model)
        if self.form not in ("printed", "repaired"):

            def solve(gamma: float) -> EllipsoidSolution:
                return synthesis.synthesise(system, gamma, noise, self.objective, weights)

            def top() -> float:
                return synthesis.largest_gamma(system)

        else:
            solve, top = self._multiplier_form(model)
        n, m = model.design.K.shape
        kept = model.design.kept(self.error)

        def complete(solution: EllipsoidSolution) -> tuple[UioDesign, bool]:
            K = np.zeros((n, m))
            K[kept] = solution.gain[: len(kept)]
            F = solution.gain[len(kept) :]
            if self.error == "shifted":
                K, F = K @ model.design.Pi, F @ model.design.Pi
            given = replace(model.design, K=K, F=F, options=self.options())
            return self._complete(given, system, solution, noise, weights)

        if self.gamma is not None:
            return _at_or_explained(self.gamma, solve, complete, top, system)
        largest = top()
        if largest <= 0:
            raise InfeasibleDesign(
                "no gamma is feasible: no gain makes the error contract at all vertices with one P",
                [
                    "the bounds of disturbances and rates do not matter here: they only scale P",
                    "what helps: a smaller box of the states, or another measurement",
                ],
                largest_gamma=0.0,
            )
        return complete(synthesis.search_gamma(solve, weights, largest))[0]

    def _by_multipliers(self, model: UioModel, data: ModelData, gamma: float) -> Problem:
        form: Any = self.form
        noise, weights = self._noise(model, 3), self._weights(model)
        return printed.multiplier_problem(data, gamma, noise, self.objective, weights, form)

    def _multiplier_form(self, model: UioModel) -> tuple[Any, Any]:
        data, noise = (
            model.design.data.at(printed.box_vertices(model.bounds)),
            self._noise(model, 3),
        )
        if self.form == "printed":
            printed.refuse_printed(data, self.gamma or 0.0)

        def solve(gamma: float) -> EllipsoidSolution:
            problem = self._by_multipliers(model, data, gamma)
            return printed.solve_multipliers(problem, gamma, noise)

        return solve, partial(printed.largest_multiplier_gamma, data)

    def _complete(
        self,
        given: UioDesign,
        system: ErrorSystem,
        solution: EllipsoidSolution,
        noise: FloatArray | None,
        weights: FloatArray,
    ) -> tuple[UioDesign, bool]:
        """Attach the ellipsoids to a design with gains, backed off until they are proved or not."""
        gain = given.gain(self.error)
        solutions = [solution]
        if self.post == "per_component":
            solutions = [
                synthesis.analyse_gain(system, gain, noise, unit) for unit in np.eye(len(weights))
            ]
        shapes = np.stack([s.P for s in solutions])
        gammas = np.array([s.gamma for s in solutions])
        rows = np.stack([s.weights for s in solutions])
        # A smaller P asks less of the noise block of the LMI, so shrinking it buys the
        # margin that rounding and the solver's tolerance took.
        for loss in (0.0, 1e-7, 1e-6, 1e-5, 1e-4, 1e-3):
            P = shapes * (1.0 - loss)
            bound = EllipsoidBound(self.error, P, gammas, rows, inverse_diagonal_bounds(P))
            design = replace(given, bound=bound)
            if all(claim.holds for claim in prove_ellipsoid(design)):
                return design, True
        return design, False


def _at_or_explained(
    gamma: float,
    solve: Callable[[float], EllipsoidSolution],
    complete: Callable[[EllipsoidSolution], tuple[UioDesign, bool]],
    top: Callable[[], float],
    system: ErrorSystem,
    gain: FloatArray | None = None,
) -> UioDesign:
    """Design (with a gain (p, m): analyse) at gamma, or refuse by the largest that is feasible.

    Little above it the solver may neither refuse nor solve: what it leaves has no proof.
    """
    trouble: InfeasibleDesign | SolverTrouble | None = None
    try:
        design, proved = complete(solve(gamma))
        if proved:
            return design
    except (InfeasibleDesign, SolverTrouble) as error:
        trouble = error
    largest = top()
    told = f"the largest feasible gamma is about {largest:.5g}"
    if gamma >= largest:
        lines, share = synthesis.explain_infeasible(system, gamma, gain)
        raise InfeasibleDesign(
            f"gamma = {gamma:.6g} is infeasible"
            + (" for the given gain" if gain is not None else ""),
            [
                told,
                "the bounds of disturbances and rates do not enter feasibility: they only scale P",
                *lines,
            ],
            gamma=gamma,
            largest_gamma=largest,
            largest_share=share,
        ) from trouble
    if trouble is None:
        return design
    facts = {**trouble.facts, "largest_gamma": largest}
    facts["details"] = (*facts["details"], f"{told}: ask for less")
    raise type(trouble)(**facts) from trouble
