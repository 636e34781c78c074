"""The matrix inequalities of the method, each written once for expressions and enclosures.

All are returned as a matrix that has to be positive definite. v is scaled by its boxes, so
Q_v of the paper is a diagonal of weights that sum to 1.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from obsynth.derive.rigour import Enclosure
from obsynth.designs.bounded_error.error_system import (
    Arithmetic,
    ErrorSystem,
    ModelData,
    lift,
    plain_error,
)
from obsynth.designs.lmi import he, symmetric_block


def direct_block(system: ErrorSystem, P: Any, H: Any, keep: Any, noise: Any) -> Any:
    """Quadratic boundedness at every vertex, without relaxation.

        [ keep P            *       *
          0                 noise   *
          P Abar - H Cbar   P Wbar - H Vbar   P ]  > 0

    With ``keep = 1 - gamma`` and ``noise = gamma Q_v`` it says
    ``V+ <= (1 - gamma) V + gamma v'Q_v v``, so V <= 1 is invariant.

    Shapes: P, H (p, p), (p, m), keep (1, 1), noise (n_v, n_v).
    """
    X = P @ system.Abar - H @ system.Cbar
    Z = P @ system.Wbar - H @ system.Vbar
    return symmetric_block([[P * keep], [0, noise], [X, Z, P]])


def fixed_gain_block(X: Any, Z: Any, P: Any, keep: Any, noise: Any) -> Any:
    """Quadratic boundedness for a gain that is given: X, Z as in eq. (16) with M inserted."""
    return symmetric_block([[P * keep], [0, noise], [P @ X, P @ Z, P]])


def multiplier_block(
    data: ModelData,
    P: Any,
    H: Any,
    keep: Any,
    noise: Any,
    a: Any,
    b: Any,
    U: Any = None,
    arithmetic: Arithmetic = "float",
) -> Any:
    """Inequality (51), as printed or repaired, times -1.

    Shapes: P, H (n + n_f, n + n_f), (n + n_f, m), a, b (n, n), U (n, n).
    """
    base = plain_error(data.without_nonlinearity(), arithmetic)
    n, n_f, _, _ = data.sizes
    V = lift(np.eye(n, n + n_f), arithmetic)
    if arithmetic == "float":
        M: Any = data.vertices
        T: Any = data.T
    else:
        M = Enclosure.of(data.vertices, data.vertex_radius)
        T = Enclosure.of(np.eye(n)) + Enclosure.of(data.E) @ Enclosure.of(data.C)
    Y = lift(np.eye(n + n_f, n), arithmetic) @ T
    X = P @ base.Abar - H @ base.Cbar
    Z = P @ base.Wbar - H @ base.Vbar
    S1 = P * keep - lift(np.eye(n + n_f, n), arithmetic) @ he(a @ M) @ V
    rows = [[S1], [a @ V, b], [0, 0, noise], [-X, -(P @ Y), -Z, P]]
    if U is None:
        rows.append([-(b @ M @ V), 0, 0, 0, b])
    else:
        rows.append([-(U @ M @ V), 0, 0, 0, he(U) - b])
    return symmetric_block(rows)
