"""From a stored design to an observer: proofs first, then the step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from obsynth.derive import QPV
from obsynth.designs.core.certificate import Certificate, Claim, Guarantee, Level
from obsynth.designs.core.observer import Observer
from obsynth.designs.core.record import with_header
from obsynth.designs.qpv.claims import prove_design
from obsynth.designs.qpv.model import derive_form
from obsynth.designs.qpv.record import METHOD, QPVDesign
from obsynth.designs.qpv.schedule import FASTEST, fastest_mode, measured_schedule
from obsynth.designs.qpv.step import build_ode, build_step, make_start, memory_layout
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.text import write_text


def to_record(design: QPVDesign) -> dict[str, Any]:
    """Return the JSON-able record of a design, with the header that `load` reads."""
    return with_header(METHOD, design.to_record())


def prove(record: Mapping[str, Any], level: Level = "full") -> tuple[Claim, ...]:
    """Prove everything that the guarantee of a stored design rests on."""
    return _prove(QPVDesign.from_record(record), level, None)


def read_start(record: Mapping[str, Any]) -> Callable[..., FloatArray]:
    """Return what `Observer.memory0` calls, from the stored design alone."""
    return make_start(QPVDesign.from_record(record))


def _prove(design: QPVDesign, level: Level, form: QPV | None) -> tuple[Claim, ...]:
    claims = (*prove_design(design), _sampling(design))
    if form is None and level == "full":
        form = derive_form(design.plant, design.form_of_N)
    return claims if form is None else (*claims, _derivation(design, form))


def _derivation(design: QPVDesign, form: QPV) -> Claim:
    fresh, stored = form.vertices().family, design.family
    same = (
        fresh.directions.shape == stored.directions.shape
        and np.array_equal(fresh.constant, stored.constant)
        and np.array_equal(fresh.directions, stored.directions)
        and design.scheduling == tuple(write_text(v.expression) for v in form.scheduling)
        and form.form_of_N == design.form_of_N
        and form.names == (*design.plant.names("x"), *design.plant.names("f"))
    )
    room = -np.inf
    if same:
        outer = np.concatenate(
            [
                fresh.ranges[:, 0] - stored.ranges[:, 0],
                stored.ranges[:, 1] - fresh.ranges[:, 1],
                (stored.radius - fresh.radius).ravel(),
            ]
        )
        room = float(outer.min(initial=np.inf))
    linear = not any(any(matrix) for matrix in form.M)
    return Claim(
        "model",
        "the stored vertices hold the quadratic form of the stored equations, all faults as states",
        bool(same and room >= 0 and linear and form.proof.holds),
        room,
        f"derived again; {form.proof}",
    )


def _sampling(design: QPVDesign) -> Claim:
    product = fastest_mode(design) * design.Ts
    return Claim(
        "sampling",
        f"Ts = {design.Ts:g} s resolves the fastest mode: |eigenvalue| Ts = {product:.3g} at the "
        "vertices",
        bool(product <= FASTEST * (1.0 + 1e-9)),
        FASTEST - product,
        "eigenvalues at the vertices of scheduling, state and error",
    )


def assemble(
    record_or_design: Mapping[str, Any] | QPVDesign,
    level: Level = "lmi",
    form: QPV | None = None,
) -> Observer:
    """Prove a design and make its observer."""
    if isinstance(record_or_design, QPVDesign):
        design = record_or_design
    else:
        design = QPVDesign.from_record(record_or_design)
    certificate = Certificate(_prove(design, level, form), to_record(design)).require()
    plant = design.plant
    widths = None
    if design.noise is not None:
        widths = np.sqrt(design.inverse_diagonal) * (1.0 + 2.0**-40)
    elif not plant.w:
        widths = np.zeros(len(design.P))
    return Observer(
        method=METHOD,
        model=plant.discretise("rk4", design.Ts),
        step=build_step(design),
        memory_layout=memory_layout(len(plant.x), len(plant.f)),
        gains=_gains(design),
        performance=_performance(design),
        half_widths=widths,
        certificate=certificate,
        guarantee=_guarantee(design),
        start=make_start(design),
        ode=build_ode(design),
    )


def _gains(design: QPVDesign) -> dict[str, FloatArray]:
    """Gains by the paper's letters, (52): L1, L2, ... at the vertices of the scheduling."""
    return {f"L{k}": gain for k, gain in enumerate(design.L, 1)} | {"P": design.P}


def _performance(design: QPVDesign) -> dict[str, float]:
    trace = float(design.rows.sum(axis=1).max(initial=0.0))
    values = {"decay": design.alpha, "error_decay": 0.5 * design.alpha}
    if design.norm == "hinf":
        values |= {"l2_gain": float(np.sqrt(design.gamma)), "gamma": design.gamma}
    elif design.noise is None:
        values |= {"h2_trace": trace, "mu": trace}
    if design.noise is not None:
        values |= {"alpha_q": design.noise.rate, "bound_trace": trace}
    values |= {
        "trace_P_inv": float(design.inverse_diagonal.sum()),
        "largest_gain": float(np.abs(design.L).max()),
        "fastest_mode": fastest_mode(design),
    }
    eta = design.options.get("eta_used")
    if eta is not None:
        values["eta"] = float(eta)
    return values


def _guarantee(design: QPVDesign) -> Guarantee:
    plant = design.plant
    names = ", ".join((*plant.names("x"), *plant.names("f")))
    claims = [
        f"without disturbances V = e'P e decays with exp(-{design.alpha:g} t) from every e(0) in "
        "{e'P e <= 1}, and the error stays in this ellipsoid"
    ]
    noise = design.noise
    if noise is not None:
        widths = np.sqrt(design.inverse_diagonal)
        listed = ", ".join(
            f"{name} +-{width:.4g}"
            for name, width in zip((*plant.names("x"), *plant.names("f")), widths, strict=True)
        )
        claims.append(
            f"with bounded disturbances the error never leaves it, so that {names} lie inside the "
            f"returned intervals ({listed} in the limit)"
        )
    elif design.norm == "h2" and plant.w:
        trace = float(design.rows.sum(axis=1).max(initial=0.0))
        claims.append(
            f"V' < w'w and trace(Cz P^-1 Cz') <= {trace:.6g}, as long as the error stays in it"
        )
    if design.norm == "hinf":
        claims.append(
            f"the L2 gain from w to z = Cz e is at most {np.sqrt(design.gamma):.6g}, as long as "
            "the error stays in it"
        )
    return Guarantee(tuple(claims), tuple(_assumptions(design)))


def _assumptions(design: QPVDesign) -> list[str]:
    plant, noise = design.plant, design.noise
    faults = ", ".join(plant.names("f"))
    texts = [
        f"the plant is {plant.name} in continuous time, and the observer is its ode; the step "
        f"follows it with Runge-Kutta steps of {design.Ts:g} s, short against the fastest mode, "
        "but what they and holding u, y and theta over a sample add is not bounded",
        "state and faults stay in the ellipsoid of the region [monitored: status bit 4]",
        "e(0) lies in {e'P e <= 1}, as memory0 finds from the ranges it is given "
        "[monitored: status bit 4]",
    ]
    scheduling = measured_schedule(plant)
    if scheduling:
        listed = ", ".join(f"{s.name} in [{s.lower:g}, {s.upper:g}]" for s in scheduling)
        texts.append(f"{listed}, measured without error [monitored: status bit 4]")
    if noise is not None and plant.w:
        listed = ", ".join(
            f"{name} in [{low:g}, {high:g}]"
            for name, (low, high) in zip(plant.names("w"), plant.box("w"), strict=True)
        )
        texts.append(f"{listed} [monitored in part: status bit 8]")
    elif plant.w:
        texts.append(
            "disturbances are small enough that the error stays in {e'P e <= 1}; that is proved "
            "only with alpha_q= [monitored in part: status bit 8]"
        )
    n = len(plant.x)
    moving = () if noise is None else tuple(plant.f[k - n] for k in noise.faults)
    if moving:
        texts.append(", ".join(f"|d{s.name}/dt| <= {s.rate:g}/s" for s in moving))
    still = [s.name for s in plant.f if s not in moving]
    if still:
        listed = faults if len(still) == len(plant.f) else ", ".join(still)
        texts.append(f"{listed} do not change; every jump is a new e(0)")
    return texts
