"""From options and a plant to a design: sets, settings, the search of eta, refusals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.lmi import Knob, largest_margin, search_line, smallest_changes
from obsynth.designs.qpv.claims import inverse_bounds, prove_design, region_factor
from obsynth.designs.qpv.error_matrix import ErrorSets, entering
from obsynth.designs.qpv.model import Prepared, check_faults, prepare
from obsynth.designs.qpv.option_meanings import (
    cover,
    noise_centre,
    one_of_each_pair,
    reach,
    read_performance_output,
    start_corners,
    unit_shape,
)
from obsynth.designs.qpv.polytopes import Shape, box
from obsynth.designs.qpv.record import NoiseBound, QPVDesign
from obsynth.designs.qpv.refusals import Accepted, printed_refusal
from obsynth.designs.qpv.region import Ellipsoid
from obsynth.designs.qpv.schedule import choose_sample_time, fastest_mode
from obsynth.designs.qpv.synthesis import (
    Setting,
    Unknowns,
    rough_objective,
    solve,
    state_problem,
)
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.text import write_text

if TYPE_CHECKING:
    from obsynth.designs.core.observer import Observer
    from obsynth.designs.qpv.method import QPVObserver


# Outwards, so that inclusions that hold with equality can be proved in floating point.
_OUTWARDS = 1.0 + 2.0**-40
_TOLERANCE = 1e-9
# Keeps sums of rounded weights at or below 1.
_BELOW_ONE = 1.0 - 2.0**-48
# Shares of the largest eta that are tried before the golden sections.
_SHARES = (0.2, 0.4, 0.6, 0.8)
_REFINE = 3


@dataclass(frozen=True, eq=False)
class Workspace:
    """Options and plant, checked against each other.

    Cz (V, n_z, n)
    unit: the polytope for kappa = 1
    """

    options: QPVObserver
    prepared: Prepared
    Cz: FloatArray
    unit: Shape
    kappa: float

    @classmethod
    def of(cls, options: QPVObserver, model_or_form: Any) -> Workspace:
        """Check options and plant, derive the form."""
        prepared = prepare(model_or_form, options.form_of_N)
        region, names = options.region, prepared.names
        if region is None or region.dimension != len(names):
            size = 0 if region is None else region.dimension
            raise ObsynthError(
                f"region has {size} coordinates; {len(names)} are needed: {', '.join(names)}",
                option="region",
            )
        if options.norm == "hinf" and not prepared.model.w:
            raise ObsynthError(
                'norm="hinf" is a gain from disturbances, and the plant has none; declare '
                'plant.disturbances(...), or use norm="h2"',
                option="norm",
            )
        unit = unit_shape(options.polytope, region)
        Cz = read_performance_output(options.performance_output, prepared)
        kappa = options.kappa
        if kappa is None:
            if options.E_x is None:
                kappa = 1.0 / reach(unit, region)
            else:
                kappa = cover(unit, region) * (1.0 if options.eta is None else options.eta)
        work = cls(options, prepared, Cz, unit, kappa)
        work._check_polytope(region)
        return work

    @property
    def region(self) -> Ellipsoid:
        """X."""
        region = self.options.region
        if region is None:
            raise ObsynthError("region is missing", option="region")
        return region

    @property
    def apart(self) -> bool:
        """Whether the errors' polytope is taken apart from the states'."""
        return self.options.E_x is not None

    @property
    def eta(self) -> float | None:
        """The given eta; 1 for sets apart from each other, None to search it."""
        if self.options.eta is None and self.apart:
            return 1.0
        return self.options.eta

    @property
    def largest_eta(self) -> float:
        """The largest eta with X inside the enlarged polytope, (21)."""
        return min(self.kappa / cover(self.unit, self.region), 1.0)

    def _check_polytope(self, region: Ellipsoid) -> None:
        needed = cover(self.unit, region)
        largest = 1.0 / reach(self.unit, region)
        eta = self.eta
        smallest = 0.0 if eta is None else eta * needed
        if self.kappa < smallest * (1.0 - _TOLERANCE):
            raise InfeasibleDesign(
                f"kappa = {self.kappa:.6g} is too small for eta = {eta:g}: the region X does not "
                "lie in the enlarged polytope of the state, (21)",
                [
                    f"kappa has to be at least {smallest:.6g} at this eta",
                    f"or eta at most {self.kappa / needed:.6g} at this kappa",
                ],
                kappa=self.kappa,
                smallest=smallest,
                largest=largest,
            )
        if not self.apart and self.kappa > largest * (1.0 + _TOLERANCE):
            raise InfeasibleDesign(
                f"kappa = {self.kappa:.6g} is too large: the polytope P_x leaves the region X, "
                "which Assumption 2 of the paper does not allow",
                [f"kappa has to be at most {largest:.6g} for this polytope and region"],
                kappa=self.kappa,
                smallest=smallest,
                largest=largest,
            )

    def sets(self, eta: float) -> ErrorSets:
        """Return the polytopes for a given eta."""
        base = self.unit.scaled(self.kappa)
        enlarged = base.scaled(_OUTWARDS / eta)
        options, n = self.options, self.unit.dimension
        state_in, error_in = entering(self.prepared.form.vertices().N)
        if options.E_x is None or options.initial_error is None:
            start = one_of_each_pair(base.vertices)
            places, error = tuple(range(n)), enlarged
        else:
            sides = np.asarray(options.E_x)
            n_x = len(self.prepared.model.x)
            if sides.shape not in ((n_x,), (n,)) or np.any(sides <= 0):
                raise ObsynthError(
                    f"E_x holds {n_x} positive half widths (of the states), or {n} (of states and "
                    f"faults); given was {sides.tolist()}",
                    option="E_x",
                )
            places, error = tuple(range(sides.size)), box(sides)
            start = start_corners(np.asarray(options.initial_error), self.prepared.names)
            missing = [self.prepared.names[k] for k in error_in if k not in places]
            if missing:
                raise ObsynthError(
                    f"E_x says nothing of {', '.join(missing)}, whose error enters the dynamics "
                    f'(form_of_N="{self.prepared.form.form_of_N}"); give {n} half widths',
                    option="E_x",
                )
        return ErrorSets(self.region.c, enlarged, error, places, start, state_in, error_in)

    def setting(self, eta: float, alpha: float | None = None) -> Setting:
        """Everything the inequalities depend on, for a given eta."""
        options, sets = self.options, self.sets(eta)
        data = self.prepared.data(self.Cz)
        noise = self.noise_bound()
        if noise is not None:
            data = data.with_rates(list(noise.faults))
        half = np.abs(sets.start).max(axis=0)
        half = np.where(half > 0, half, self.region.half_widths)
        return Setting(
            data=data,
            sets=sets,
            norm=options.norm,
            alpha=options.alpha if alpha is None else alpha,
            alpha_q=options.alpha_q,
            noise=None if noise is None else noise.weights,
            polya=options.polya,
            gain_cap=options.gain_cap,
            printed=options.form == "printed",
            half=half,
        )

    def noise_bound(self) -> NoiseBound | None:
        """Weights of disturbances and fault rates for quadratic boundedness, equal parts."""
        rate = self.options.alpha_q
        if rate is None:
            return None
        model = self.prepared.model
        free = [s.name for s in model.w if not np.isfinite([s.lower, s.upper]).all()]
        if free:
            raise ObsynthError(
                f"alpha_q bounds the error for bounded disturbances, and {', '.join(free)} has no "
                "bound; declare it with bound= or range=",
                option="alpha_q",
                symbols=tuple(free),
            )
        centre, w = noise_centre(model), model.box("w")
        radius = np.maximum(w[:, 1] - centre, centre - w[:, 0])
        moving = [k for k, s in enumerate(model.f) if s.rate]
        rates = [float(model.f[k].rate or 0.0) for k in moving]
        both = np.nextafter(np.concatenate([radius, rates]), np.inf)
        if not both.size:
            raise ObsynthError(
                "alpha_q bounds the error under disturbances and fault rates, and the plant has "
                "neither; without them the error decays with alpha",
                option="alpha_q",
            )
        weights = _BELOW_ONE / (both.size * both**2)
        n = len(model.x)
        return NoiseBound(rate, weights, both, tuple(n + k for k in moving))

    def design(self, gains: FloatArray | None = None) -> Observer:
        """Solve, prove and assemble."""
        from obsynth.designs.qpv.assembly import assemble

        eta = self.eta
        if eta is None:
            eta = self._search_eta(gains)
        setting = self.setting(eta)
        check_faults(setting.data, setting.sets, self.prepared.names)
        if setting.printed:
            raise printed_refusal(setting, gains)
        try:
            unknowns, _ = solve(setting, lambda found: self._prove(found, setting, eta), gains)
        except InfeasibleDesign as error:
            raise self._explained(error, setting, eta, gains) from error
        return assemble(self._complete(unknowns, setting, eta), form=self.prepared.form)

    def _search_eta(self, gains: FloatArray | None) -> float:
        largest = self.largest_eta

        def attempt(eta: float) -> float:
            return rough_objective(self.setting(eta), gains)

        found = search_line(
            attempt, float, [share * largest for share in _SHARES], refine=_REFINE, name="eta"
        )
        return found.value

    def _prove(self, unknowns: Unknowns, setting: Setting, eta: float) -> Accepted:
        if np.linalg.eigvalsh(unknowns.P)[0] <= 0 or not np.isfinite(unknowns.gains).all():
            return Accepted(False)
        claims = prove_design(self._complete(unknowns, setting, eta, check=False))
        return Accepted(all(claim.holds for claim in claims))

    def _complete(
        self, unknowns: Unknowns, setting: Setting, eta: float, check: bool = True
    ) -> QPVDesign:
        """Put everything that is stored together; sample time and monitors only if checked."""
        options, form = self.options, self.prepared.form
        P, n = unknowns.P, len(unknowns.P)
        given = {**options.options(), "eta_used": eta, "kappa_used": self.kappa}
        rows = inverse_bounds(P, self.Cz.reshape(-1, n)).reshape(self.Cz.shape[:2])
        design = QPVDesign(
            plant=form.model,
            form_of_N=form.form_of_N,
            family=form.vertices().family,
            scheduling=tuple(write_text(v.expression) for v in form.scheduling),
            region=self.region,
            state=setting.sets.state,
            error=setting.sets.error,
            error_coordinates=setting.sets.error_coordinates,
            start=setting.sets.start,
            norm=options.norm,
            alpha=float(options.alpha),
            noise=self.noise_bound(),
            polya=options.polya,
            Cz=self.Cz,
            w_centre=noise_centre(form.model),
            P=P,
            L=unknowns.gains,
            gamma=unknowns.level if options.norm == "hinf" else np.inf,
            rows=rows,
            inverse_diagonal=inverse_bounds(P, np.eye(n)),
            reset=region_factor(P, self.region.Q),
            Ts=1.0,
            options=given,
        )
        if not check:
            return design
        return replace(design, Ts=choose_sample_time(fastest_mode(design), options.Ts))

    def read_gains(self, gains: Mapping[str, ArrayLike]) -> FloatArray:
        """Check gains L1, L2, ... of one matrix per vertex."""
        n, m = len(self.prepared.names), len(self.prepared.model.output)
        wanted = [f"L{k}" for k in range(1, self.prepared.vertices + 1)]
        missing = [name for name in wanted if name not in gains]
        if missing:
            raise ObsynthError(
                f"gains has {sorted(gains)}; {', '.join(wanted)} of shape {(n, m)} are needed, one "
                "per vertex of the scheduling variables",
                missing=tuple(missing),
            )
        arrays = [np.asarray(gains[name], dtype=float) for name in wanted]
        for name, array in zip(wanted, arrays, strict=True):
            if array.shape != (n, m) or not np.isfinite(array).all():
                raise ObsynthError(
                    f"{name} has shape {array.shape}; finite numbers of shape {(n, m)} are needed",
                    gain=name,
                )
        return np.stack(arrays)

    def _explained(
        self,
        error: InfeasibleDesign,
        setting: Setting,
        eta: float,
        gains: FloatArray | None,
    ) -> InfeasibleDesign:
        """Say which change of one number would help."""

        def margin(changed: Setting) -> bool:
            return largest_margin(state_problem(changed, gains), explain=False).feasible

        knobs = []
        if self.options.alpha > 0:
            knobs.append(
                Knob("alpha", self.options.alpha, 0.0, lambda a: margin(self.setting(eta, a)))
            )
        if not self.apart:
            ends = [0.4 * eta, *([self.largest_eta] if eta < 0.999 * self.largest_eta else [])]
            knobs += [Knob("eta", eta, end, lambda v: margin(self.setting(v))) for end in ends]
        knobs.append(
            Knob("size of the region", 1.0, 0.5, lambda v: margin(self._shrunk(v).setting(eta)))
        )
        what = "these gains" if gains is not None else "any gains"
        facts = {name: getattr(error, name, None) for name in ("margin", "binding", "bound")}
        return InfeasibleDesign(
            f"no P shows the required decay and performance over the polytopes for {what} "
            f"(eta = {eta:g}, kappa = {self.kappa:g}, alpha = {self.options.alpha:g})",
            [*getattr(error, "details", ()), *smallest_changes(knobs, rtol=0.1)],
            eta=eta,
            kappa=self.kappa,
            **facts,
        )

    def _shrunk(self, share: float) -> Workspace:
        """Return the same problem for a smaller region, its polytopes with it."""
        region = Ellipsoid(share**2 * self.region.Q, self.region.c)
        unit = self.unit.scaled(share)
        return replace(self, options=replace(self.options, region=region), unit=unit)
