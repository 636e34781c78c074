"""Rigorous numbers: what is proved here is true of real numbers, every rounding counted.

The rounding mode is never changed, and no result of LAPACK is trusted; tests/derive/rigour holds
each kind of number to its law, against exact rationals or balls of 300 bits.

``Interval``, ``obsynth.derive.rigour.interval``
    Pairs of arrays ``(lo, hi)``. An operation on intervals contains the exact result for any
    members of its operands; what is a double stays a double, and nan stands for "nothing known".
``Enclosure``
    Matrices ``mid`` +- ``rad``. Every operator contains the exact result for any members of its
    operands; ``Enclosure.of`` contains what it is given, doubles or exact matrices.
``down``, ``up``, ``raised``, ``lowered``, ``add_up``, ``product_up``, ``smallest_above``
    One step of rounding to the named side; sums and products of nonnegative doubles are never
    below (``lowered``: above) the exact value, underflow included. ``middle_and_radius`` and
    ``outward`` hold the interval or box they are given; ``allowance`` is above the rounding of
    one step of an observer in either precision.
``exact``, ``ExactMatrix``
    Rational arrays and matrices: no rounding at all. ``nearest`` and ``above`` turn them into the
    nearest and the smallest not lower doubles; ``image`` is the smallest box that holds M a for
    every a in a box.
``rational``, ``substitute``, ``round_number``, ``enclose_number``
    Between SymPy's real numbers and doubles, with a bound of the error or two doubles around.
``prove_positive_definite``, ``is_positive_definite``
    The first never accepts a family with a member that is not positive definite, but may give up;
    its margin is a lower bound of all smallest eigenvalues. The second decides one exact matrix.
``largest_eigenvalue``, ``perron_bound``, ``rotate``
    Bounds of largest eigenvalues of symmetric matrices, from both sides or from above.
"""

from obsynth.derive.rigour.eigenvalues import finite, largest_eigenvalue, perron_bound, rotate
from obsynth.derive.rigour.enclosure import Enclosure, ProofResult, prove_positive_definite
from obsynth.derive.rigour.interval import (
    TINY,
    UNIT,
    UNIT_ROUNDOFF,
    Interval,
    add_up,
    allowance,
    down,
    enclose_number,
    gamma_bound,
    lowered,
    middle_and_radius,
    outward,
    product_up,
    raised,
    rational,
    round_number,
    smallest_above,
    substitute,
    up,
)
from obsynth.derive.rigour.rationals import (
    Exact,
    ExactMatrix,
    above,
    exact,
    from_text,
    image,
    inverse,
    is_positive_definite,
    magnitude,
    nearest,
    negative,
    positive,
    to_text,
)

__all__ = [
    "TINY",
    "UNIT",
    "UNIT_ROUNDOFF",
    "Enclosure",
    "Exact",
    "ExactMatrix",
    "Interval",
    "ProofResult",
    "above",
    "add_up",
    "allowance",
    "down",
    "enclose_number",
    "exact",
    "finite",
    "from_text",
    "gamma_bound",
    "image",
    "inverse",
    "is_positive_definite",
    "largest_eigenvalue",
    "lowered",
    "magnitude",
    "middle_and_radius",
    "nearest",
    "negative",
    "outward",
    "perron_bound",
    "positive",
    "product_up",
    "prove_positive_definite",
    "raised",
    "rational",
    "rotate",
    "round_number",
    "smallest_above",
    "substitute",
    "to_text",
    "up",
]
