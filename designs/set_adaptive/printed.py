"""The gain condition as the paper prints it, kept to show that it does not do what it is for."""

import numpy as np

from obsynth.designs.core.errors import InfeasibleDesign
from obsynth.designs.set_adaptive.gain import Gain, analyse_gain, off_diagonal
from obsynth.symbolic.arrays import FloatArray


def solve_printed(
    A_lower: FloatArray, A_upper: FloatArray, C: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Solve p'A_o - w'C < 0, p'A_o - w'C + r' >= 0 for p > 0, w and r >= 0, and set L = p w'.

    A large r meets the second condition, and p'(p w') = (p'p) w' is not w'.
    """
    from scipy.optimize import linprog

    n, m = len(A_lower), len(C)
    rows = [np.column_stack([A.T, -C.T, np.ones(n)]) for A in (A_lower, A_upper)]
    objective = np.zeros(n + m + 1)
    objective[-1] = -1.0
    total = np.zeros((1, n + m + 1))
    total[0, :n] = 1.0
    # of all solutions one whose p is not close to a unit vector, if there is one
    for smallest in (0.5 / n, 1e-6):
        bounds = [(smallest, None)] * n + [(-1.0, 1.0)] * m + [(None, None)]
        found = linprog(objective, np.vstack(rows), np.zeros(2 * n), total, [1.0], bounds)
        if found.x is not None and found.x[-1] > 0.0:
            p, w = found.x[:n], found.x[n : n + m]
            return p, w, np.outer(p, w)
    raise InfeasibleDesign("the printed gain condition has no solution")


def printed_gain(A_lower: FloatArray, A_upper: FloatArray, C: FloatArray) -> Gain:
    """Return the printed gain where it happens to work."""
    p, w, L = solve_printed(A_lower, A_upper, C)
    lacking = off_diagonal(A_lower - L @ C)
    decay = -float(np.linalg.eigvals(A_upper - L @ C).real.max())
    if lacking.min() < 0.0 or decay <= 0.0:
        i, j = np.unravel_index(np.argmin(lacking), lacking.shape)
        raise InfeasibleDesign(
            "the printed gain condition gives no gain",
            [
                f"p'L = (p'p) w' with p'p = {p @ p:.6g}, where w' is needed",
                f"entry ({i + 1}, {j + 1}) of A_m - L C is {lacking[i, j]:.6g} < 0: not Metzler",
                f"the decay of A_M - L C is {decay:.6g}",
                'use form="corrected", or give the gain: analyse(model, gains={"L": ...})',
            ],
            L=L,
            p=p,
            w=w,
            decay=decay,
        )
    return analyse_gain(A_lower, A_upper, C, L)
