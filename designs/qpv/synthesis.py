"""Gains and ellipsoids by linear matrix inequalities: solved here, proved elsewhere."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.lmi.expression import Affine, full, scalar, symmetric, trace
from obsynth.designs.lmi.margin import MarginSolution, largest_margin, solve_with_margin
from obsynth.designs.lmi.problem import Problem, cap_gain, symmetric_block
from obsynth.designs.lmi.proof import inverse_bounds
from obsynth.designs.lmi.reductions import split_common
from obsynth.designs.lmi.search import Knob, search_line, smallest_changes
from obsynth.designs.lmi.solve import solve_reliably
from obsynth.designs.qpv import lmis
from obsynth.designs.qpv.claims import prove_inequalities, region_factor
from obsynth.designs.qpv.error_matrix import ErrorSets
from obsynth.designs.qpv.lmis import Closed, PolyaTerm
from obsynth.designs.qpv.model import QPVModel
from obsynth.designs.qpv.record import FASTEST, Norm, QPVDesign, VertexData
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.written import write_text

# Part of the largest margin that phase 2 keeps; the objective loses about as much, relatively.
FRACTION = 1e-5
# What a search tolerates: the smallest eigenvalue, where the sets have size one, and the gap.
ROUGH = -1e-5
ROUGH_GAP = 1e-3
# Shares of the largest eta that are tried before the golden sections.
SHARES = (0.2, 0.4, 0.6, 0.8)
REFINE = 3


@dataclass(frozen=True, eq=False)
class Setting:
    """Everything that the inequalities depend on besides the unknowns, see `QPVObserver`.

    printed: whether (19) and (20) are taken as printed
    room: share of E that the polytope of the error has to hold beyond E, for rounding
    """

    model: QPVModel
    eta: float
    norm: Norm
    alpha: float
    polya: int | None
    gain_cap: float | None
    printed: bool
    room: float = 0.0

    @property
    def data(self) -> VertexData:
        """Matrices at the vertices."""
        return self.model.data

    @cached_property
    def sets(self) -> ErrorSets:
        """The polytopes."""
        return self.model.sets(self.eta)

    @cached_property
    def half(self) -> FloatArray:
        """Units of the error, shape (n,)."""
        half = np.abs(self.sets.start).max(axis=0)
        return np.where(half > 0, half, self.model.region.half_widths)

    @property
    def terms(self) -> tuple[PolyaTerm, ...]:
        """Terms of the double polytopic sums."""
        return self.data.terms(self.polya)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """P, the Gamma_l = P L_l and mu or gamma, in units of `Setting.half`."""

    P: FloatArray
    gains: FloatArray
    level: float

    @classmethod
    def read(cls, values: Mapping[str, FloatArray], setting: Setting, gains: Any) -> Unknowns:
        """Take values by name to the coordinates of the plant, gains as L_l."""
        half = setting.half
        P = values["P"] / np.outer(half, half)
        if gains is None:
            found = [
                half[:, None] * np.linalg.solve(values["P"], values[f"Gamma{k}"])
                for k in range(len(setting.data.A))
            ]
            gains = np.stack(found)
        level = float(np.trace(values["Z"])) if "Z" in values else float(values["gamma"].item())
        return cls(0.5 * (P + P.T), gains, level)


def state_problem(setting: Setting, gains: FloatArray | None = None) -> Problem:
    """State the design problem, or with gains L_l (V, n, m) given the analysis problem."""
    half, n = setting.half, setting.data.sizes[0]
    data = setting.data.scaled(half)
    psi = setting.data.psi(setting.sets) * half / half[:, None]
    problem = Problem("QPV observer")
    P = symmetric("P", n)
    if gains is None:
        m = data.sizes[1]
        gammas = [full(f"Gamma{k}", n, m) for k in range(len(data.A))]
    else:
        gammas = [P @ (gain / half[:, None]) for gain in gains]
    level = scalar("gamma") if setting.norm == "hinf" else None
    for number, term in enumerate(setting.terms):
        closed = lmis.close(
            P, gammas, term, *(list(b) for b in (data.A, psi, data.C, data.G, data.H, data.Cz))
        )
        _state_term(problem, setting, P, closed, level, number)
    _state_sets(problem, setting, P)
    if setting.gain_cap is not None and gains is None:
        inverse = np.diag(1.0 / half)
        for k, gamma in enumerate(gammas):
            cap_gain(problem, inverse @ P @ inverse, inverse @ gamma, setting.gain_cap, f"L{k}")
    if level is None:
        Z = symmetric("Z", data.Cz.shape[1])
        for number, Cz in enumerate(np.unique(data.Cz, axis=0)):
            problem.add_lmi(f"trace {number}", symmetric_block([[P], [Cz, Z]]), ">>")
        problem.minimise(trace(Z))
    else:
        problem.minimise(level)
    return problem


def _state_term(
    problem: Problem,
    setting: Setting,
    P: Affine,
    closed: Closed,
    level: Affine | None,
    number: int,
) -> None:
    noise = setting.model.noise
    if noise is None or setting.alpha > noise.rate:
        problem.add_lmi(f"decay {number}", lmis.decay_block(P, closed, setting.alpha), ">>")
    blocks: dict[str, Any] = {}
    if closed.side is not None:
        if noise is not None:
            blocks["noise"] = lmis.noise_block(P, closed, noise.rate, np.diag(noise.weights))
        elif setting.norm == "h2":
            blocks["h2"] = lmis.h2_block(closed)
        if setting.norm == "hinf":
            blocks["hinf"] = lmis.hinf_block(closed, level)
    for name, block in blocks.items():
        parts = split_common(block, f"{name}.slack{number}")
        if parts.common is not None:
            problem.add_lmi(f"{name} {number}, common", parts.common, ">>")
        problem.add_lmi(f"{name} {number}", parts.members, ">>")


def _state_sets(problem: Problem, setting: Setting, P: Affine) -> None:
    half = setting.half
    normals, corners = setting.sets.normals.mid, setting.sets.start[:, None, :]
    if setting.printed:
        problem.add_lmi("start", lmis.inside_block(P, corners * half), ">>")
        problem.add_lmi("error set", lmis.start_block(P, normals / half), ">>")
        return
    problem.add_lmi("start", lmis.start_block(P, corners / half), ">>")
    problem.add_lmi("error set", lmis.inside_block(P, normals * half * (1.0 + setting.room)), ">>")


def rough_objective(setting: Setting, gains: FloatArray | None = None) -> float:
    """Return the optimum without margin and proof, for searches."""
    problem = state_problem(setting, gains)
    return solve_reliably(problem, floor=ROUGH, gap=ROUGH_GAP).objective


def search_eta(setting: Setting, gains: FloatArray | None = None) -> Setting:
    """Choose the eta with the smallest optimum."""
    largest = setting.model.largest_eta
    found = search_line(
        lambda eta: rough_objective(replace(setting, eta=eta), gains),
        float,
        [share * largest for share in SHARES],
        refine=REFINE,
        name="eta",
    )
    return replace(setting, eta=found.value)


@dataclass(frozen=True)
class Accepted:
    """What the LMI layer asks of a proof: whether it went through."""

    all_proved: bool


def solve_with_proof(
    setting: Setting, prove: Callable[[Unknowns], bool], gains: FloatArray | None = None
) -> tuple[Unknowns, MarginSolution]:
    """Solve with a margin and back off until `prove` accepts the numbers as stored."""
    found = solve_with_margin(
        state_problem(setting, gains),
        prove=lambda values: Accepted(prove(Unknowns.read(values, setting, gains))),
        fraction=FRACTION,
    )
    return Unknowns.read(found.values, setting, gains), found


def synthesise(
    setting: Setting, options: Mapping[str, Any], gains: FloatArray | None, Ts: float | None
) -> QPVDesign:
    """Find P and, where they are not given, gains (V, n, m); explain it where there are none."""

    def prove(unknowns: Unknowns) -> bool:
        if np.linalg.eigvalsh(unknowns.P)[0] <= 0 or not np.isfinite(unknowns.gains).all():
            return False
        design = complete(setting, unknowns, options)
        return all(claim.holds for claim in prove_inequalities(design))

    try:
        unknowns, _ = solve_with_proof(setting, prove, gains)
    except InfeasibleDesign as error:
        raise explain(error, setting, gains) from error
    design = complete(setting, unknowns, options)
    return replace(design, Ts=choose_sample_time(design.fastest_mode, Ts))


def complete(setting: Setting, unknowns: Unknowns, options: Mapping[str, Any]) -> QPVDesign:
    """Put everything that is stored together, the sample time apart."""
    model, sets, P, n = setting.model, setting.sets, unknowns.P, len(unknowns.P)
    form, Cz = model.form, model.Cz
    return QPVDesign(
        plant=form.model,
        form_of_N=form.form_of_N,
        family=form.vertices().family,
        scheduling=tuple(write_text(v.expression) for v in form.scheduling),
        **{name: getattr(model, name) for name in ("region", "kappa", "noise", "Cz")},
        **{name: getattr(sets, name) for name in ("state", "error", "start")},
        **{name: getattr(setting, name) for name in ("eta", "norm", "alpha", "polya")},
        w_centre=noise_centre(form.model),
        P=P,
        L=unknowns.gains,
        gamma=unknowns.level if setting.norm == "hinf" else None,
        rows=inverse_bounds(P, Cz.reshape(-1, n)).reshape(Cz.shape[:2]),
        inverse_diagonal=inverse_bounds(P, np.eye(n)),
        reset=region_factor(P, model.region.Q),
        Ts=1.0,
        rounding=0.0,
        options=options,
    )


def choose_sample_time(fastest: float, given: float | None) -> float:
    """Check a sample time against the fastest mode, or choose one (1, 2 or 5 times 10^k)."""
    longest = FASTEST / max(fastest, 1e-6)
    if given is None:
        power = 10.0 ** math.floor(math.log10(longest))
        factor = max(f for f in (1.0, 2.0, 5.0) if f * power <= longest * (1.0 + 1e-12))
        return float(f"{factor * power:.0e}")
    if given > longest:
        raise ObsynthError(
            f"Ts = {given:g} s is too long for the observer's fastest mode of {fastest:.4g}/s: a "
            f"Runge-Kutta step follows it up to Ts = {longest:.3g} s. Take a shorter step, or "
            "keep the gains smaller with gain_cap=",
            Ts=given,
            largest=longest,
            fastest_mode=fastest,
        )
    return given


def explain(
    error: InfeasibleDesign, setting: Setting, gains: FloatArray | None
) -> InfeasibleDesign:
    """Say which change of one number would help."""
    model, eta, alpha = setting.model, setting.eta, setting.alpha

    def feasible(**changes: Any) -> bool:
        problem = state_problem(replace(setting, **changes), gains)
        return largest_margin(problem, explain=False).feasible

    knobs = []
    if alpha > 0:
        knobs.append(Knob("alpha", alpha, 0.0, lambda a: feasible(alpha=a)))
    if not model.apart:
        ends = [0.4 * eta, *([model.largest_eta] if eta < 0.999 * model.largest_eta else [])]
        knobs += [Knob("eta", eta, end, lambda v: feasible(eta=v)) for end in ends]
    knobs.append(
        Knob("size of the region", 1.0, 0.5, lambda share: feasible(model=model.shrunk(share)))
    )
    what = "these gains" if gains is not None else "any gains"
    facts = {name: getattr(error, name, None) for name in ("margin", "binding", "bound")}
    return InfeasibleDesign(
        f"no P shows the required decay and performance over the polytopes for {what} "
        f"(eta = {eta:g}, kappa = {model.kappa:g}, alpha = {alpha:g})",
        [*getattr(error, "details", ()), *smallest_changes(knobs, rtol=0.1)],
        eta=eta,
        kappa=model.kappa,
        **facts,
    )
