"""The run-time function of the filter: equations (18)-(19) in the order in which data arrive."""

import casadi as ca
from numpy.typing import ArrayLike

from obsynth.designs.core.boxes import LIMITS, Ends, select
from obsynth.designs.core.core import Core, Known, Parts, Seen
from obsynth.designs.core.given import Start
from obsynth.designs.core.signals import noise_centre
from obsynth.designs.core.stepping import all_finite, clip, inside
from obsynth.designs.hinf.record import HinfDesign
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray


def memory_sizes(design: HinfDesign) -> dict[str, int]:
    """Return the parts: p of the state now, the innovation before, 1 after the first sample."""
    m, n = design.C.shape
    return {"prediction": n, "innovation": m, "running": 1}


def first_memory(design: HinfDesign, start: Start) -> dict[str, ArrayLike]:
    """Start at the guess; the boxes and y0 are not needed, as no set is carried along."""
    return {"prediction": start.guess}


def predict(model: Plant, A: FloatArray, xhat: ca.SX, u: ca.SX) -> ca.SX:
    """Return A xhat + B u + g(c, u), c the nearest point of the box, by the plant's own rows."""
    nearest = clip(xhat, model.box("x"))
    found = model.function()(x=nearest, u=u, w=ca.DM(noise_centre(model)))
    return found["rhs"] + ca.DM(A) @ (xhat - nearest)


def build_core(design: HinfDesign) -> Core:
    """Build the filter (18)-(19) (the method's page, Filter), which gives estimates and no sets.

    One missing entry of y leaves no innovation in any: the gains mix them.
    """
    model, C, gains = design.plant, ca.DM(design.C), design.gains

    def run(seen: Seen) -> Known:
        p, r0 = seen.memory["prediction"], seen.memory["innovation"]
        running = seen.memory["running"] > 0.5
        r = select(seen.all_used, seen.y - C @ p, 0.0 * r0)
        xhat = select(running, p + ca.DM(gains.F) @ r + ca.DM(gains.K) @ r0, p)
        estimate = ca.DM(gains.H) @ r + ca.DM(gains.D) @ r0
        valid = ca.logic_and(running, seen.all_used)
        moved = {
            "prediction": predict(model, design.A, xhat, seen.u),
            "innovation": select(seen.all_used, seen.y - C @ xhat, 0.0 * r0),
            "running": ca.SX(1),
        }
        away = ca.logic_not(inside(xhat, xhat, model.box("x")))
        fhat = select(valid, estimate, 0.0 * estimate)
        return Known(xhat, fhat, None, None, moved, outside=away, valid=valid)

    def place(x: Ends, f: Ends, kept: Parts) -> Parts:
        near = all_finite(kept["prediction"], LIMITS[design.precision].finite)
        return {
            "prediction": select(near, kept["prediction"], x.middle(design.precision)),
            "innovation": select(near, kept["innovation"], 0.0 * kept["innovation"]),
            "running": ca.logic_and(near, kept["running"] > 0.5),
        }

    return Core(run, lambda x, f, kept: {}, place, bridges=True)
