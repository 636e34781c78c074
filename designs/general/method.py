"""The observer of the general class, as the methods that serve it design it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive import JacobianBounds
from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.given import Number, read_gains
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.general.claims import claims, covers, guarantee, numbers
from obsynth.designs.general.fading import fade
from obsynth.designs.general.gain import find_gain, refuse_hidden
from obsynth.designs.general.model import CLASS, GeneralModel, read, read_again, without
from obsynth.designs.general.peak import error_sums, small_gain_solution, spectral_radius
from obsynth.designs.general.record import GeneralDesign, PeakBound
from obsynth.designs.general.rounding import settle
from obsynth.designs.general.step import (
    Limits,
    build_core,
    first_memory,
    memory_sizes,
    settling,
)
from obsynth.designs.general.system import error_system, extra_inputs
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError

WEIGHTS = Number(at_least=0.0, because="they have to be finite, not negative and not all zero")


@dataclass(frozen=True)
class GeneralUIO(Method):
    """Guaranteed intervals for plants ``x+ = F(x, u, f, d, w), y = h(x, u, f, w)`` of any form.

    bounds: what holds the errors
    weights: of the half widths (states, then faults), 1 / range by default
    """

    CLASS = CLASS
    CONTRACT = Contract(
        name="general_uio",
        record=GeneralDesign,
        read_again=read_again,
        claims=claims,
        covers=covers,
        guarantee=guarantee,
        numbers=numbers,
        memory=memory_sizes,
        first=first_memory,
        quiet=True,
        settle=settling,
        core=build_core,
        shared=("prediction",),
    )

    bounds: Literal["peak"] = "peak"
    weights: Annotated[tuple[float, ...] | None, WEIGHTS] = None

    def read(self, given: Plant, bounds: JacobianBounds | None = None) -> GeneralModel:
        """Extend the plant; faults that no output tells from the states are disturbances."""
        model = read(given)
        lost = refuse_hidden(model.design)
        while lost:
            model = without(model, lost)
            lost = refuse_hidden(model.design)
        return model

    def solve(self, model: GeneralModel) -> GeneralDesign:
        """Find a gain and its bounds."""
        given = replace(model.design, options=self.options())
        Z = find_gain(given, self._weights(model))
        return bound_peak(settle(replace(given, Z=Z)))

    def fix(self, model: GeneralModel, gains: Mapping[str, ArrayLike]) -> GeneralDesign:
        """Bound the errors of a given ``L`` of shape (n + n_f, m)."""
        blank = model.design
        L = read_gains(gains, {"L": blank.L0.shape})["L"]
        Z = L.copy()
        Z[:, list(model.extended.picked)] = 0.0
        design = replace(blank, Z=Z, options=self.options())
        if not np.allclose(design.L, L, rtol=1e-9, atol=1e-12 * np.abs(L).max(initial=0.0)):
            raise ObsynthError(
                f"L does not take {', '.join(model.extended.free)} away: (I - L C) D0 has to be "
                "zero",
                option="gains",
            )
        return bound_peak(settle(design))

    def _weights(self, model: GeneralModel) -> FloatArray:
        """Return the weights of states and followed faults."""
        plant, states = model.design.plant, model.extended.plant
        names = (*plant.names("x"), *plant.names("f"))
        box = states.box("x")
        half = 0.5 * np.diff(box, axis=1)[:, 0]
        if self.weights is None:
            return np.where(np.isfinite(half) & (half > 0.0), 1.0 / half, 1.0)
        if len(self.weights) != len(names):
            raise ObsynthError(
                f"weights are {len(self.weights)} numbers; {len(names)} are needed "
                f"({', '.join(names)})",
                option="weights",
            )
        given = dict(zip(names, self.weights, strict=True))
        return np.array([given[name] for name in states.names("x")])


def bound_peak(design: GeneralDesign) -> GeneralDesign:
    """Attach proved peak bounds to a design with a gain."""
    system = error_system(design)
    sums = error_sums(system, extra_inputs(system, design))
    rho = spectral_radius(sums.G)
    if not rho < 1.0:
        raise InfeasibleDesign(
            f"peak bounds: the small-gain condition fails, spectral radius of G is {rho:.6g}",
            [
                "the Jacobian varies too much for these gains",
                "use other gains, or a smaller domain",
            ],
            rho=rho,
        )
    b = small_gain_solution(sums.G, sums.n)
    widest = np.diff(Limits.of(design.extended.plant).x, axis=1)[:, 0]
    return replace(design, bound=PeakBound(b, fade(system, b, widest)))
