"""Proofs of a stored design, and that it speaks of the stored plant.

Every pair of vertices, every half-space, every corner.
"""

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np

from obsynth.derive.rigour import Enclosure, ExactMatrix, prove_positive_definite
from obsynth.designs.core.certificate import Claim, Guarantee
from obsynth.designs.core.guard import MOST_CALLS, Watch
from obsynth.designs.core.half_widths import above
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.signals import IEEE, about_centre, at_centre, noise_centre, within
from obsynth.designs.lmi.problem import Arithmetic, lift
from obsynth.designs.lmi.proof import RUMP, FamilyProof, prove_family, prove_inverse
from obsynth.designs.qpv import lmis
from obsynth.designs.qpv.equations import measured_schedule
from obsynth.designs.qpv.error_matrix import ErrorSets, psi_family
from obsynth.designs.qpv.lmis import PolyaTerm
from obsynth.designs.qpv.model import Derived
from obsynth.designs.qpv.record import ASSUMED, FASTEST, NoiseBound, QPVDesign, VertexData
from obsynth.designs.qpv.rounding import needed
from obsynth.designs.qpv.step import SETTLED, found_again
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.written import write_text

EXACT = "the worst ones also by exact rational LDL'"


def claims(design: QPVDesign) -> Iterator[Claim]:
    """Prove everything that the guarantee of a stored design rests on."""
    yield from prove_inequalities(design)
    if design.bounded and design.rounding != ASSUMED:
        yield prove_rounding(design)
    product = design.fastest_mode * design.Ts
    yield Claim(
        "sampling",
        f"Ts = {design.Ts:g} s resolves the fastest mode: |eigenvalue| Ts = {product:.3g} at the "
        "vertices",
        bool(product <= FASTEST * (1.0 + 1e-9)),
        FASTEST - product,
        "eigenvalues at the vertices of scheduling, state and error",
    )


def covers(design: QPVDesign, fresh: Derived) -> Iterator[Claim]:
    """Compare the stored form with the one derived from the stored equations."""
    form, stored = fresh.form, design.family
    found = form.vertices().family
    same = (
        found.directions.shape == stored.directions.shape
        and np.array_equal(found.constant, stored.constant)
        and np.array_equal(found.directions, stored.directions)
        and design.scheduling == tuple(write_text(v.expression) for v in form.scheduling)
        and form.form_of_N == design.form_of_N
        and np.array_equal(design.w_centre, noise_centre(design.plant))
        and form.names == (*design.plant.names("x"), *design.plant.names("f"))
    )
    room = -np.inf
    if same:
        outer = np.concatenate(
            [
                found.ranges[:, 0] - stored.ranges[:, 0],
                stored.ranges[:, 1] - found.ranges[:, 1],
                (stored.radius - found.radius).ravel(),
            ]
        )
        room = float(outer.min(initial=np.inf))
    linear = not any(any(matrix) for matrix in form.M)
    yield Claim(
        "model",
        "the stored vertices hold the quadratic form of the stored equations, all faults as states",
        bool(same and room >= 0 and linear and form.proof.holds),
        room,
        f"derived again; {form.proof}",
    )


def prove_inequalities(design: QPVDesign) -> Iterator[Claim]:
    """Prove everything but the sample time."""
    sets, P = design.sets, design.P
    yield _region(design)
    yield _error_set(P, sets)
    yield _start(P, sets)
    yield from _dynamics(design)
    yield _bounds(design)
    yield _reset(design)
    if design.noise is not None:
        yield _noise_box(design, design.noise)


def _claim(name: str, statement: str, proof: FamilyProof, how: str) -> Claim:
    exactly = f"; {EXACT}" if proof.exact else ""
    listed = "" if proof.all_proved else f"; not at {', '.join(map(str, proof.failed))}"
    return Claim(name, statement, proof.all_proved, proof.margin, f"{how}{exactly}{listed}")


def _region(design: QPVDesign) -> Claim:
    normals = design.state.normals
    Q = Enclosure.of(design.region.Q)
    values = np.ones((1, 1)) - normals @ Q @ normals.T
    proof = prove_family(len(normals.mid), lambda k: values.member(k), exact_count=1)
    return _claim(
        "region",
        f"the region X lies in the polytope of the state ({_both(len(normals.mid))} half-spaces)",
        proof,
        "enclosed quadratic forms a_k'Q a_k < 1",
    )


def _both(count: int) -> str:
    return f"{2 * count}, in pairs,"


def _error_set(P: FloatArray, sets: ErrorSets) -> Claim:
    normals, shape = sets.normals, Enclosure.of(P)
    count = len(normals.mid)
    proof = prove_family(
        count,
        lambda k: lmis.inside_block(shape, normals.member(k)),
        lambda k: lmis.inside_block(ExactMatrix.of(P), ExactMatrix.of(normals.mid[k])),
    )
    return _claim(
        "error_set",
        f"E = {{e'P e <= 1}} lies in the polytope of the error, (20) ({_both(count)} half-spaces)"
        if sets.error.kind != "hull"
        else f"E = {{e'P e <= 1}} lies in the polytope of the error, (20) ({count} half-spaces)",
        proof,
        RUMP,
    )


def prove_rounding(design: QPVDesign) -> Claim:
    """Prove that the inequalities hold in E made larger by what rounding adds: P made smaller."""
    added = design.rounding
    larger = _error_set(design.P / (1.0 + 1.5 * added) ** 2, design.sets)
    room = added - needed(design)
    return replace(
        larger,
        name="rounding",
        statement=f"rounding of the steps adds at most {added:.1e} to the root of V, and E made "
        "larger by that lies in the polytope of the error",
        holds=larger.holds and room >= 0.0,
        margin=min(larger.margin, room),
        proof=f"interval analysis of the rounding of every instruction; {larger.proof}",
    )


def _start(P: FloatArray, sets: ErrorSets) -> Claim:
    corners, shape = Enclosure.of(sets.start[:, None, :]), Enclosure.of(P)
    proof = prove_family(
        len(sets.start),
        lambda k: lmis.start_block(shape, corners.member(k)),
        lambda k: lmis.start_block(ExactMatrix.of(P), ExactMatrix.of(sets.start[[k]])),
    )
    return _claim(
        "start",
        f"the polytope of e(0) lies in E, (19) ({_both(len(sets.start))} corners)",
        proof,
        RUMP,
    )


def _dynamics(design: QPVDesign) -> Iterator[Claim]:
    """Prove the inequalities of the error dynamics for all terms and all pairs of vertices."""
    data, terms = design.data, design.data.terms(design.polya)
    about, quiet = about_centre(design.plant, design.w_centre), undisturbed(design)
    blocks: dict[str, tuple[str, Any]] = {
        "decay": (
            f"V' + {design.alpha:g} V < 0 in E{quiet and ' where '}{quiet}, (22)",
            lambda P, closed: lmis.decay_block(P, closed, design.alpha),
        )
    }
    noise, gamma = design.noise, design.gamma
    if noise is not None:
        weights = np.diag(noise.weights)
        blocks["quadratic_boundedness"] = (
            f"V' < {noise.rate:g} (1 - V) in E for bounded disturbances",
            lambda P, closed: lmis.noise_block(P, closed, noise.rate, type(P).of(weights)),
        )
    elif design.norm == "h2" and data.sizes[2]:
        blocks["h2"] = (f"V' < |{about}|^2 in E, (41)", lambda _, closed: lmis.h2_block(closed))
    if gamma is not None:
        blocks["l2_gain"] = (
            f"V' + z'z < {gamma:.6g} |{about}|^2 in E, (23)",
            lambda P, closed: lmis.hinf_block(closed, type(P).of(gamma)),
        )
    distinct = data.N[:1] if (data.N[0] == data.N).all() else data.N
    families = [psi_family(block, design.sets, data.N_radius) for block in distinct]
    if len(families) == 1:
        families *= len(data.N)
    for name, (statement, formula) in blocks.items():
        proofs = [_prove_term(design, term, families, formula) for term in terms]
        worst = min(proofs, key=lambda p: (p.all_proved, p.margin))
        pairs = len(families[0].mid) if families[0].mid.ndim == 3 else 1
        kind = "vertices of the scheduling" if terms[0].total == 1 else "Polya terms"
        where = f"{pairs} pairs of vertices, {len(terms)} {kind}"
        yield _claim(name, f"{statement}: {where}", worst, RUMP)


def undisturbed(design: QPVDesign) -> str:
    """Say where V decays: disturbances at their centre, faults with a rate standing still."""
    plant, moving = design.plant, () if design.noise is None else design.noise.faults
    still = [f"d{plant.f[k - len(plant.x)].name}/dt = 0" for k in moving]
    return ", ".join([*([at_centre(plant, design.w_centre)] if plant.w else []), *still])


def _prove_term(
    design: QPVDesign, term: PolyaTerm, families: list[Enclosure], formula: Any
) -> FamilyProof:
    parts: dict[str, Any] = {}
    kinds: tuple[Arithmetic, ...] = ("enclosure", "exact")
    for kind in kinds:
        P = lift(design.P, kind)
        parts[kind] = P, [P @ lift(gain, kind) for gain in design.L], _lifted(design.data, kind)

    def block(kind: str, psi: list[Any]) -> Any:
        P, gains, lifted = parts[kind]
        return formula(P, lmis.close(P, gains, term, psi=psi, **lifted))

    return prove_family(
        len(families[0].mid),
        lambda k: block("enclosure", [family.member(k) for family in families]),
        lambda k: block("exact", [ExactMatrix.of(family.mid[k]) for family in families]),
        exact_count=2,
    )


def _lifted(data: VertexData, kind: Arithmetic) -> dict[str, list[Any]]:
    return {
        name: [lift(block, kind, getattr(data, f"{name}_radius", 0.0)) for block in blocks]
        for name, blocks in vars(data).items()
        if name in ("A", "C", "G", "H", "Cz")
    }


def _bounds(design: QPVDesign) -> Claim:
    P, n = design.P, len(design.P)
    rows = np.concatenate([np.eye(n), design.Cz.reshape(-1, n)])
    upper = np.concatenate([design.inverse_diagonal, design.rows.ravel()])
    return Claim(
        "bounds",
        "(P^-1)_ii and the diagonal of Cz P^-1 Cz' stay below the stored values, (40)",
        *prove_inverse(P, rows, upper),
        RUMP,
    )


def region_factor(P: FloatArray, Q: FloatArray) -> float:
    """Return t with Q^-1 t^2 > P, so that x'P x <= t^2 where x'Q^-1 x <= 1; infinite unproved."""
    root = np.linalg.cholesky(Q)
    near = float(np.sqrt(np.linalg.eigvalsh(root.T @ P @ root)[-1]))
    for slack in (1e-12, 1e-10, 1e-8, 1e-6):
        if _factor_proof(P, Q, near * (1.0 + slack)).all_proved:
            return near * (1.0 + slack)
    return 1e300


def _factor_proof(P: FloatArray, Q: FloatArray, factor: float) -> Any:
    shape, region = Enclosure.of(P), Enclosure.of(Q)
    return prove_positive_definite(
        region * Enclosure.of(factor) * Enclosure.of(factor) - region @ shape @ region
    )


def _reset(design: QPVDesign) -> Claim:
    if design.reset >= 1e300:
        return Claim("reset", "nothing is claimed of the size of X", True, np.inf, "none needed")
    result = _factor_proof(design.P, design.region.Q, design.reset)
    return Claim(
        "reset",
        f"x'P x <= {design.reset:.6g}^2 for every x in X - c",
        bool(result.all_proved and design.reset >= 0.0),
        float(result.relative.min()),
        RUMP,
    )


def _noise_box(design: QPVDesign, noise: NoiseBound) -> Claim:
    plant, n, n_w = design.plant, len(design.plant.x), len(design.plant.w)
    total = sum(
        (Fraction(w) * Fraction(r) ** 2 for w, r in zip(noise.weights, noise.radius, strict=True)),
        Fraction(0),
    )
    box, centre, radius = plant.box("w"), design.w_centre, noise.radius[:n_w]
    rates = [plant.f[k - n].rate or 0.0 for k in noise.faults]
    room = float(
        np.concatenate(
            [
                radius - (box[:, 1] - centre),
                radius - (centre - box[:, 0]),
                noise.radius[n_w:] - rates,
            ]
        ).min(initial=np.inf)
    )
    if any(s.rate for k, s in enumerate(plant.f, n) if k not in noise.faults):
        room = -np.inf
    return Claim(
        "noise",
        "the declared disturbances about their middle, and rates, satisfy v'W v <= 1, W > 0",
        bool(total <= 1 and room >= 0 and min(noise.rate, *noise.weights.tolist()) > 0),
        float(1 - total),
        "exact sum of the weights over the box",
    )


def numbers(design: QPVDesign) -> Numbers:
    """Return the gains L1, L2, ... at the vertices of the scheduling, (52), and what they reach."""
    widths = None
    horizon = Watch.of(design.options).horizon
    if design.bounded and (horizon == MOST_CALLS or found_again(design)):
        # without disturbances the bound shrinks for as long as a copy is kept at least
        up = above(design.precision, 4 * len(design.P))
        decay = 0.5 * (design.alpha * design.Ts - np.log(up)) * Watch.of(design.options).calls
        shrunk = 0.0 if design.noise is not None else min(max(decay, 0.0), 0.5 * SETTLED)
        left = float(np.exp(-shrunk)) * (1.0 + 2.0**-40)
        widths = np.sqrt(design.inverse_diagonal) * ((left + design.rounding) * up**3)
    gains = {f"L{k}": gain for k, gain in enumerate(design.L, 1)} | {"P": design.P}
    return Numbers(gains, _performance(design), widths, ("eta",))


def _performance(design: QPVDesign) -> dict[str, float]:
    values = {"decay": design.alpha, "error_decay": 0.5 * design.alpha}
    if design.gamma is not None:
        values |= {"l2_gain": float(np.sqrt(design.gamma)), "gamma": design.gamma}
    elif design.noise is None:
        values |= {"h2_trace": design.trace, "mu": design.trace}
    if design.noise is not None:
        values |= {"alpha_q": design.noise.rate, "bound_trace": design.trace}
    values |= {
        "trace_P_inv": float(design.inverse_diagonal.sum()),
        "largest_gain": float(np.abs(design.L).max()),
        "fastest_mode": design.fastest_mode,
        "eta": design.eta,
    }
    return values


def guarantee(design: QPVDesign) -> Guarantee:
    """Return what is promised of the error, and what has to hold for it."""
    return Guarantee(tuple(_claims(design)), tuple(_assumptions(design)))


def _claims(design: QPVDesign) -> Iterator[str]:
    names = (*design.plant.names("x"), *design.plant.names("f"))
    about, quiet = about_centre(design.plant, design.w_centre), undisturbed(design)
    yield (
        f"{quiet and f'where {quiet} '}V = e'P e decays with exp(-{design.alpha:g} t) from every "
        "e(0) in {e'P e <= 1}, and the error stays in this ellipsoid"
    )
    if design.noise is not None:
        widths = np.sqrt(design.inverse_diagonal)
        pairs = zip(names, widths, strict=True)
        listed = ", ".join(f"{name} +-{width:.4g}" for name, width in pairs)
        yield (
            f"with bounded disturbances the error never leaves it, so that {', '.join(names)} lie "
            f"inside the returned intervals ({listed} in the limit)"
        )
    elif design.norm == "h2" and design.plant.w:
        yield (
            f"V' < |{about}|^2 and trace(Cz P^-1 Cz') <= {design.trace:.6g}, as long as the "
            "error stays in it"
        )
    if design.gamma is not None:
        yield (
            f"the L2 gain from {about} to z = Cz e is at most {np.sqrt(design.gamma):.6g}, as long "
            "as the error stays in it"
        )


def _assumptions(design: QPVDesign) -> Iterator[str]:
    plant, noise = design.plant, design.noise
    held = ", ".join(s.name for s in (*plant.u, *measured_schedule(plant)))
    yield (
        f"the plant is {plant.name} in continuous time, and the observer is its ode. The step "
        f"holds readings for {design.Ts:g} s: it keeps the guarantee for motions on which "
        f"{f'{held} do not move within a sample and ' if held else ''}disturbances within their "
        "ranges explain at every instant both the motion and the reading that is held, so that "
        "what an output moves within a sample counts as a disturbance of it. What the Runge-Kutta "
        "formula leaves out of the flow of the ode is not bounded"
    )
    if design.bounded:
        yield (
            f"{IEEE[design.precision]}, rounded to nearest, and inputs within their ranges (1e+06 "
            f"where there is none): rounding then adds {design.rounding:.1e} of the error set to "
            f"the intervals{', which is not proved' if design.rounding == ASSUMED else ''}"
        )
    yield "state and faults stay in the ellipsoid of the region [monitored: status bit 4]"
    yield (
        "e(0) lies in {e'P e <= 1}, as memory0 finds from the ranges it is given, and the step "
        "from the declared ones where it begins anew [monitored: status bit 4]"
    )
    scheduling = measured_schedule(plant)
    if scheduling:
        yield f"{within(scheduling)}, measured without error [monitored: status bit 4]"
    if noise is not None and plant.w:
        yield f"{within(plant.w)} [monitored in part: status bit 8]"
    elif plant.w:
        yield (
            "disturbances are small enough that the error stays in {e'P e <= 1}; that is proved "
            "only with alpha_q= [monitored in part: status bit 8]"
        )
    n = len(plant.x)
    moving = () if noise is None else tuple(plant.f[k - n] for k in noise.faults)
    if moving:
        yield ", ".join(f"|d{s.name}/dt| <= {s.rate:g}/s" for s in moving)
    still = [s.name for s in plant.f if s not in moving]
    if still:
        yield f"{', '.join(still)} do not change; every jump is a new e(0)"
