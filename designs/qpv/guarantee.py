"""What an observer of the method promises, and what it shows of itself."""

from collections.abc import Iterator

import numpy as np

from obsynth.designs.core.certificate import Guarantee
from obsynth.designs.core.guard import MOST_CALLS, Watch
from obsynth.designs.core.method import Numbers
from obsynth.designs.core.running import above
from obsynth.designs.core.signals import IEEE, about_centre, within
from obsynth.designs.qpv.claims import undisturbed
from obsynth.designs.qpv.equations import measured_schedule
from obsynth.designs.qpv.record import ASSUMED, QPVDesign
from obsynth.designs.qpv.step import SETTLED, found_again


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
