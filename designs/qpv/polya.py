"""Double polytopic sums as finitely many terms: Polya's relaxation, and its exact collapse.

sum_l sum_m mu_l mu_m F_lm < 0 on the simplex follows from the coefficients of (sum mu)^(s-2) times
it, one for every multi-index of s vertices. With k_l the multiplicity of vertex l the coefficient
is, up to a positive factor, sum_lm k_l (k_m - [l = m]) / (s (s - 1)) F_lm. This is (47)-(49) of
Rotondo, Buciakowski and Witczak with the sum over the distinct permutations, the range 1..N of the
indices and alpha P inside the sum.
"""

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class PolyaTerm:
    """Integer weights of one term.

    total: s (s - 1), the sum of either kind of weights; 1 for collapsed terms
    single: weights of what depends on one index
    double: weights of products, [r_1, r_2]
    """

    total: int
    single: NDArray[np.int64]
    double: NDArray[np.int64]


def collapsed_terms(vertices: int) -> tuple[PolyaTerm, ...]:
    """One term per vertex: exact when the second factor of the products does not vary."""
    units = np.eye(vertices, dtype=np.int64)
    return tuple(PolyaTerm(1, unit, np.diag(unit)) for unit in units)


def polya_terms(vertices: int, order: int) -> tuple[PolyaTerm, ...]:
    """All terms of order s, C(N + s - 1, s) of them."""
    if isinstance(order, bool) or not isinstance(order, int) or order < 2:
        raise ObsynthError(
            f"polya is {order!r}; the order s of the relaxation is an integer from 2 on",
            option="polya",
        )
    terms = []
    for chosen in itertools.combinations_with_replacement(range(vertices), order):
        k = np.bincount(chosen, minlength=vertices).astype(np.int64)
        double = np.outer(k, k) - np.diag(k)
        terms.append(PolyaTerm(order * (order - 1), k * (order - 1), double))
    return tuple(terms)
