"""The discrete-time example of the H-infinity unknown input observer, in both its forms."""

from typing import Literal

import sympy as sp

from obsynth.symbolic.errors import PlantError
from obsynth.symbolic.plant import Plant

_VARIANTS = ("consistent", "as_printed")


def hinf_example(variant: Literal["consistent", "as_printed"] = "consistent") -> Plant:
    """Return the third-order example of Witczak, Korbicz and Jozefowicz, (48)-(50).

    The cosine of the first row is printed with the argument 12 x1, while the Jacobian (51),
    its bound (52) and the results belong to 12 x2.

    Parameters
    ----------
    variant : {"consistent", "as_printed"}
        Argument of the cosine: 12 x2, as all that follows (50) has it, or 12 x1.

    Returns
    -------
    Plant
        Discrete (Ts = 1), without units. The fault f enters x2 (L of the paper), the
        disturbances w1..w3 have finite energy and no bound. The states reach 39 in the
        paper's scenario, hence the range (-50, 50).

    Raises
    ------
    PlantError
        Another variant.

    References
    ----------
    Witczak, Korbicz, Jozefowicz: A H-infinity approach to robust fault estimation of non-linear
    discrete-time systems, Section IV.

    Examples
    --------
    >>> hinf_example().rhs[1]
    f + 3*u/5 + 2*w2/5 + 59*x1/5000 + 299*x2/1000 + 47*x3/100
    >>> hinf_example("as_printed").rhs[0].has(sp.cos(12 * sp.Symbol("x1", real=True)))
    True
    """
    if variant not in _VARIANTS:
        raise PlantError(
            f"the H-infinity example has the variants {', '.join(_VARIANTS)}, not {variant!r}",
            variant=variant,
        )
    R = sp.Rational
    plant = Plant("H-infinity example")
    x = plant.states("x1:4", range=(-50, 50), nominal=0)
    (u,) = plant.inputs("u", range=(-1, 1), nominal=0)
    (f,) = plant.faults("f", range=(-1, 1))
    w = plant.disturbances("w1:4")
    angle = 12 * x[1] if variant == "consistent" else 12 * x[0]
    A = sp.Matrix(
        [
            [R(137, 1000), R(199, 1000), R(284, 1000)],
            [R(118, 10000), R(299, 1000), R(47, 100)],
            [R(894, 1000), R(661, 1000), R(65, 1000)],
        ]
    )
    B = sp.Matrix([R(1, 4), R(3, 5), R(1, 10)])
    g = sp.Matrix([R(3, 5) * sp.cos(angle) / (x[1] ** 2 + 10), 0, -R(33, 100) * sp.sin(x[2])])
    W = sp.diag(R(1, 2), R(2, 5), R(3, 10))
    plant.dynamics(A * sp.Matrix(x) + B * u + g + sp.Matrix([0, 1, 0]) * f + W * sp.Matrix(w), Ts=1)
    plant.outputs([x[0], x[1]])
    return plant
