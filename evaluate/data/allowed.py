"""What sets and noise bounds allow of a reading: intervals of outputs over sets, with proof."""

import casadi as ca
import numpy as np

from obsynth.derive.intervals.program import Program, evaluate
from obsynth.symbolic import Plant
from obsynth.symbolic.arrays import FloatArray

BLOCK = 8192
KINDS = ("x", "u", "d", "f", "w", "p", "rho")


def allowed(plant: Plant, **known: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Enclose the outputs at every instant, lower and upper ends of shape (N, m).

    known: lower and upper ends, (N, n), by kinds of signals; the others run over their ranges
    """
    symbols = [ca.SX.sym(kind, len(plant.names(kind))) for kind in KINDS]
    shown = ca.densify(plant.function()(*symbols)[1])
    program = Program.from_casadi(ca.Function("outputs", symbols, [shown]))
    count = len(known["x"][0])
    found = np.empty((2, shown.numel(), count))
    for k in range(0, count, BLOCK):
        size = min(BLOCK, count - k)
        low, high = (
            np.vstack(
                [
                    known[kind][side][k : k + size].T
                    if kind in known
                    else np.repeat(plant.box(kind).reshape(-1, 2)[:, [side]], size, axis=1)
                    for kind in KINDS
                ]
            )
            for side in (0, 1)
        )
        with np.errstate(all="ignore"):
            found[:, :, k : k + size] = evaluate(program, low, high)
    return found[0].T, found[1].T
