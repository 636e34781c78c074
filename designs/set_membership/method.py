"""`SetMembershipObserver`: options of the method, and the way from a plant to an observer."""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from obsynth.derive.errors import DerivationError, StructureError, UnboundedError
from obsynth.designs.core.contractor import EVERY_CUT
from obsynth.designs.core.errors import InfeasibleDesign, SolverTrouble
from obsynth.designs.core.given import WEIGHTS, Number, read_gains, read_weights, refuse_no_weights
from obsynth.designs.core.method import Contract, Method
from obsynth.designs.core.step import Step
from obsynth.designs.general import step as general
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.general.record import GeneralDesign
from obsynth.designs.set_membership import claims, step, synthesis
from obsynth.designs.set_membership.model import CLASS, SetMembershipModel, read
from obsynth.designs.set_membership.record import MOST_COLUMNS, SetMembershipDesign
from obsynth.designs.set_membership.step import build_core
from obsynth.designs.set_membership.synthesis import Gain, Wishes
from obsynth.symbolic import Plant
from obsynth.symbolic.errors import ObsynthError

MOST_RESTART = 1000
_SETTLE = 20
COLUMNS = Number(at_least=1, at_most=MOST_COLUMNS, because=f"it has to be 1 to {MOST_COLUMNS}")
COUNT = Number(at_least=0, at_most=10, because="it has to be a number from 0 to 10")
ROUND = Number(at_least=1, at_most=MOST_RESTART, because="it has to be a number of calls")
OPERATIONS = Number(at_least=1, because="it has to be a number of operations")
SHARE = Number(above=0.0, because="it is a share of the noise: positive and finite")


@dataclass(frozen=True)
class SetMembershipObserver(Method):
    """Sets of states and faults from the equations themselves, for any discrete plant.

    x+ = F(x, u, d, f, w, p), y = h(x, u, f, w, p) of any form without jumps: gains of faults that
    vary, sensor faults, nonlinear outputs, feedthrough, parameters known to an interval, unknown
    inputs of any size. No LMI, no equilibrium and no constant gain; the price is the number of
    operations of a step.

    Parameters
    ----------
    columns : int, optional
        The most generators of a zonotope; by default as many as pay in the predicted widths for
        the operations that they take. Fewer make a smaller step and wider sets.
    zonotopes : int, optional
        How many zonotopes begin anew from the box of states and faults, uncorrected but cut,
        beside the one that the gain corrects; by default none or one, chosen alike.
    restart : int, optional
        Every how many calls each of them does; by default as long as all generators are kept.
    gain : float, optional
        Share of the readings' noise in the Kalman filter that gives the gain; by default the gain
        that predicts the narrowest sets among those of shares .1, .3, 1 and 3 and that of the
        narrowest peak bounds. With the latter, these bounds are guaranteed as well.
    coordinates : {"modal", "covariance", "states"}, optional
        In which generators that are dropped become a box; by default what predicts the narrowest.
    weights : tuple of float, optional
        Of states and faults in what is compared, in units of half their ranges; by default 1.
    operations : int, optional
        The most operations of a step, for small targets: the narrowest bank that keeps to it.

    Raises
    ------
    ObsynthError
        For an option that is not known or out of range.

    Notes
    -----
    One step: the boxes of two instants are contracted over the equations in both directions; the
    equations are enclosed by affine functions on what is left; zonotopes of states and faults are
    moved by these, cut and corrected with the readings, and reduced. The sets hold the truth by
    induction, whatever gains and coordinates are. What is compared and shown are predictions.

    J. S. Shamma, K.-Y. Tu, "Approximate set-valued observers for nonlinear systems", IEEE TAC 42
    (1997); T. Alamo, J. M. Bravo, E. F. Camacho, "Guaranteed state estimation by zonotopes",
    Automatica 41 (2005); C. Combastel, "Zonotopes and Kalman observers: gain optimality under
    distinct uncertainty paradigms and robust convergence", Automatica 55 (2015); F. Benhamou,
    F. Goualard, L. Granvilliers, J.-F. Puget, "Revising hull and box consistency", ICLP 1999.

    Examples
    --------
    >>> SetMembershipObserver(columns=24).columns
    24
    """

    CLASS = CLASS
    CONTRACT = Contract.of("set_membership", SetMembershipDesign, claims, step)

    columns: Annotated[int | None, COLUMNS] = None
    zonotopes: Annotated[int | None, COUNT] = None
    restart: Annotated[int | None, ROUND] = None
    gain: Annotated[float | None, SHARE] = None
    coordinates: Literal["modal", "covariance", "states"] | None = None
    weights: Annotated[tuple[float, ...] | None, WEIGHTS] = None
    operations: Annotated[int | None, OPERATIONS] = None

    def check(self) -> None:
        """Refuse options that do not fit each other."""
        if (self.zonotopes or 0) > (self.restart or MOST_RESTART):
            raise ObsynthError(
                f"zonotopes is {self.zonotopes} and restart {self.restart}: at most one of them "
                "begins anew at a call",
                option="zonotopes",
            )
        refuse_no_weights(self.weights)

    def read(self, given: Plant) -> SetMembershipModel:
        """Enclose the equations around the point of operation; leave out faults nothing shows."""
        model = synthesis.watched(read(self.CLASS.check(given)))
        with suppress(StructureError, DerivationError, UnboundedError):
            model = replace(model, general=self._general.read(given))
        return model

    @property
    def _general(self) -> GeneralUIO:
        return GeneralUIO(weights=self.weights, precision=self.precision)

    def solve(self, model: SetMembershipModel) -> SetMembershipDesign:
        """Choose gain, coordinates and columns by what they predict."""
        shares = synthesis.SHARES if self.gain is None else (self.gain,)
        kinds: Any = ("modal", "covariance", "states")
        if self.coordinates is not None:
            kinds = (self.coordinates,)
        peak = None
        if model.general is not None and self.gain is None:
            with suppress(StructureError, InfeasibleDesign, SolverTrouble):
                peak = self._general.solve(model.general)
        gains = [*synthesis.candidates(model, peak, shares, kinds)]
        if not gains:
            raise InfeasibleDesign(
                "the modes of (I - L C) A are nearly dependent, so that they are no coordinates",
                ['leave coordinates out, or take "covariance" or "states"'],
            )
        return self._of(model, gains, peak, refuse=True)

    def fix(self, model: SetMembershipModel, gains: Mapping[str, ArrayLike]) -> SetMembershipDesign:
        """Build the bank around a given ``L`` of shape (N, m)."""
        around = model.nearest
        L = read_gains(gains, {"L": around.H.T.shape})["L"]
        closed = (np.eye(len(L)) - L @ around.H) @ around.J
        bases = [synthesis.modes(closed, model.half), np.diag(model.half)]
        found = [(L, basis) for basis in bases if basis is not None]
        return self._of(model, found, None, refuse=False)

    def options(self) -> Mapping[str, Any]:
        """Return the options by name, as a design stores them: every cut unless some are named."""
        named = EVERY_CUT if self.cuts is None else self.cuts
        return {**super().options(), "cuts": (*named, *({"sweeps"} - {*named}))}

    def _of(
        self,
        model: SetMembershipModel,
        gains: list[Gain],
        peak: GeneralDesign | None,
        refuse: bool,
    ) -> SetMembershipDesign:
        size = len(model.plant.x) + len(model.plant.f)
        held = np.full(size, np.inf) if peak is None else general.steady(peak)
        weights, fitting = read_weights(self.weights, model.plant), self.operations is not None
        wishes = Wishes(self.columns, self.zonotopes, self.restart, weights, held, fitting)
        counts = []
        for chosen in synthesis.choose(model, gains, wishes):
            if refuse:
                synthesis.refuse_wide(model, chosen.found)
            options = dict(self.options())
            if self.horizon is None and peak is None:
                options["horizon"] = max(chosen.found.calls, _SETTLE) + chosen.bank.restart
            design = synthesis.complete(model, chosen, peak, options)
            if self.operations is None:
                return design
            step = Step(self.CONTRACT.guard(design), build_core(design)).build()
            if step.n_instructions() <= self.operations:
                return design
            counts.append(step.n_instructions())
        raise InfeasibleDesign(
            f"a step of at most {self.operations} operations is asked for; the smallest of the "
            f"banks that were tried takes {min(counts)}",
            ["what helps: columns= of one call, zonotopes=0, or another method, see ob.choose"],
            operations=min(counts),
        )
