"""The observer of the general class, as the methods that serve it design it."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds
from obsynth.derive.errors import StructureError
from obsynth.derive.rigour import TINY
from obsynth.derive.structure.following import follow, hidden_somewhere
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.core.given import CONTRACTION, WEIGHTS, read_gains, read_weights, refuse_idle
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.observer import Observer
from obsynth.designs.general import claims, model, step
from obsynth.designs.general.fading import fade
from obsynth.designs.general.gain import find_gain
from obsynth.designs.general.model import CLASS, GeneralModel, of
from obsynth.designs.general.peak import error_sums, small_gain_solution, spectral_radius
from obsynth.designs.general.record import EllipsoidBound, GeneralDesign, PeakBound
from obsynth.designs.general.rounding import settle
from obsynth.designs.general.storage import attained_gain, with_ellipsoid, with_energy
from obsynth.designs.general.synthesis import Units, solve_ellipsoid, solve_energy, units
from obsynth.designs.general.system import error_system, extra_inputs
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

WAYS: tuple[Literal["divided", "bounded"], ...] = ("divided", "bounded")
"""What is done with faults that cannot be followed, in this order."""


@dataclass(frozen=True)
class GeneralUIO(Method):
    """Guaranteed intervals for plants ``x+ = F(x, u, f, d, w), y = h(x, u, f, w)`` of any form.

    faults: "followed" as states, by their rates; "divided": of any size and rate, taken away from
        the errors and found one call later from what moved the states; "bounded": disturbances
        within their ranges, told by the data alone
    bounds: what holds the errors: peak bounds, an ellipsoid, or an energy gain ("l2"), which holds
        no set
    gamma: contraction per step of the ellipsoid, searched where not given
    weights: of the half widths (states, then faults), 1 / range by default; of their squares for
        ellipsoids, and of the errors for an energy gain, there of faults alone by default
    """

    CLASS = CLASS
    CONTRACT = Contract.of(
        "general_uio", GeneralDesign, claims, model, step, quiet=True, shared=("prediction",)
    )

    bounds: Literal["peak", "ellipsoid", "l2"] = "peak"
    faults: Literal["followed", "divided", "bounded"] = "followed"
    gamma: Annotated[float | None, CONTRACTION] = None
    weights: Annotated[tuple[float, ...] | None, WEIGHTS] = None

    def check(self) -> None:
        """Refuse options that do not fit each other."""
        if self.bounds != "ellipsoid":
            refuse_idle(self, f'bounds="{self.bounds}", which has no ellipsoid', "gamma")

    @classmethod
    def instead_of(cls, other: Method, idle: Iterable[str], **options: Any) -> "GeneralUIO":
        """Return what stands in for a method of a paper, some of whose options are of no use."""
        refuse_idle(other, "the observer of the general class", *idle)
        return cls(**options, **other.watched)

    def _design(self, model: Any, bounds: JacobianBounds | None) -> Observer:
        """Design, prove and return the observer; by `WAYS` where faults are not followed."""
        followed = self.faults == "followed" and bool(model.f)
        loose = not any(s.rate is not None or s.constant for s in model.f)
        if followed and loose and self.bounds != "l2":
            with suppress(StructureError, SolverTrouble, InfeasibleDesign):
                return self._otherwise(model, "divided")
        try:
            return super()._design(model, bounds)
        except (SolverTrouble, InfeasibleDesign) as trouble:
            # what a search of peak bounds refuses says nothing of other gains, nor of other ways
            for way in WAYS if followed and self.bounds == "peak" else ():
                with suppress(StructureError, SolverTrouble, InfeasibleDesign):
                    return self._otherwise(model, way)
            where = hidden_somewhere(self.read(model).extended)
            if where is None:
                raise trouble from None
            told = str(trouble).splitlines()[0].split(";")[0]
            facts = {**trouble.facts, "headline": f"{model.name}: {where}", "details": (told,)}
            raise type(trouble)(**facts) from None

    def _otherwise(self, model: Plant, way: Literal["divided", "bounded"]) -> Observer:
        """Design with another way for the faults than was asked for, which is what is stored."""
        other = replace(self, faults=way)
        found = other.read(self.CLASS.check(model))
        return self._certified(other.solve(found).changed(options=self.options()), found)

    def read(self, given: Plant, bounds: JacobianBounds | None = None) -> GeneralModel:
        """Extend the plant; faults that no output tells from the states are disturbances."""
        names = given.names("f")
        divided = names if self.faults == "divided" else ()
        found = follow(given, divided, names if self.faults == "bounded" else ())
        rest = (*divided, *found.extended.followed)
        unfollowed = [name for name in names if name not in rest]
        return of(given, found.extended, found.bounds, unfollowed, divided)

    def solve(self, model: GeneralModel) -> GeneralDesign:
        """Find a gain and its bounds."""
        given, weights = model.design.changed(options=self.options()), self._weights(model)
        if self.bounds == "peak":
            return bound_peak(settle(given.changed(Z=find_gain(given, weights))))
        return self._stored(given, weights, units(given, weights))

    def fix(self, model: GeneralModel, gains: Mapping[str, ArrayLike]) -> GeneralDesign:
        """Bound the errors of ``L`` (n + n_f, m); ``K``, ``F`` (., m) move the next prediction."""
        blank, n = model.design, len(model.design.plant.x)
        N, m = blank.L0.shape
        shapes = {"L": (N, m), "K": (n, m), "F": (N - n, m)}
        found = read_gains(gains, shapes, () if {"K", "F"} & set(gains) else ("K", "F"))
        L, K = found["L"], blank.K
        if "K" in found:
            K = np.vstack([found["K"], found["F"]])
        Z = L.copy()
        Z[:, list(model.extended.picked)] = 0.0
        design = blank.changed(Z=Z, K=K, options=self.options())
        if not np.allclose(design.L, L, rtol=1e-9, atol=1e-12 * np.abs(L).max(initial=0.0)):
            raise ObsynthError(
                f"L does not take {', '.join(model.extended.free)} away: (I - L C) D0 has to be "
                "zero",
                option="gains",
            )
        if self.bounds == "peak":
            return bound_peak(settle(design))
        if np.any(K):
            raise ObsynthError(
                f'K and F move predictions, of which bounds="{self.bounds}" knows nothing: give '
                'L alone, or bounds="peak"',
                option="gains",
            )
        weights = self._weights(model)
        return self._stored(design, weights, units(design, weights), Z)

    def _stored(
        self,
        given: GeneralDesign,
        weights: FloatArray,
        measured: Units,
        Z: FloatArray | None = None,
    ) -> GeneralDesign:
        """Find an ellipsoid or an energy gain, for a given Z or with it."""
        if self.bounds == "ellipsoid":
            found = solve_ellipsoid(given, weights, measured, self.gamma, Z)
            return cut_with_peak(settle(with_ellipsoid(given, found)))
        found = solve_energy(given, weights, measured, Z)
        chosen = given.changed(Z=found.Z)
        return settle(with_energy(given, found, weights, attained_gain(chosen, weights)))

    def _weights(self, model: GeneralModel) -> FloatArray:
        """Return the weights of states and followed faults."""
        plant, states = model.design.plant, model.extended.plant
        names = (*plant.names("x"), *plant.names("f"))
        box = states.box("x")
        half = 0.5 * np.diff(box, axis=1)[:, 0]
        if self.weights is None:
            found = np.where(np.isfinite(half) & (half > 0.0), 1.0 / np.maximum(half, TINY), 1.0)
            if self.bounds == "l2":
                found[: len(plant.x)] = 0.0
            if not found.any():
                raise StructureError(
                    f"{plant.name} has no fault that the outputs tell from its states, so there is "
                    "no fault error to bound the energy of",
                    condition="faults",
                )
            return found
        given = dict(zip(names, read_weights(self.weights, plant).tolist(), strict=True))
        return np.array([given[name] for name in states.names("x")])


def bound_peak(design: GeneralDesign) -> GeneralDesign:
    """Attach proved peak bounds to a design with a gain."""
    return design.changed(bound=peak_bounds(design))


def cut_with_peak(design: GeneralDesign) -> GeneralDesign:
    """Attach peak bounds of the same gain to an ellipsoid, where small gain holds."""
    bound = design.bound
    with suppress(InfeasibleDesign):
        if isinstance(bound, EllipsoidBound):
            return design.changed(bound=replace(bound, peak=peak_bounds(design)))
    return design


def peak_bounds(design: GeneralDesign) -> PeakBound:
    """Return peak bounds of a gain, or refuse."""
    system = error_system(design)
    sums = error_sums(system, extra_inputs(system, design))
    rho = spectral_radius(sums.G)
    if not rho < 1.0:
        names = design.extended.plant.names("x")
        strongest = names[int(np.argmax(sums.G.max(axis=0))) % len(names)]
        raise InfeasibleDesign(
            f"peak bounds: the small-gain condition fails, spectral radius of G is {rho:.6g}",
            [
                "the Jacobian varies too much for these gains; the strongest feedback is through "
                f"the error of {strongest}",
                "use other gains, or a smaller domain",
            ],
            rho=rho,
        )
    b = small_gain_solution(sums.G, sums.n)
    widest = np.diff(design.limits.x, axis=1)[:, 0]
    return PeakBound(b, fade(system, b, widest))
