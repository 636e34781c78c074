"""`Ellipsoid`: the set in which a design assumes the augmented state to stay."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.errors import ObsynthError


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The points x with (x - c)' Q^-1 (x - c) <= 1, equation (18) of Rotondo et al.

    Parameters
    ----------
    Q : array_like of shape (N, N) or (N,)
        Symmetric and positive definite; a vector is the diagonal.
    c : array_like of shape (N,)
        The centre.

    Raises
    ------
    ObsynthError
        If the shapes do not fit, or Q is not symmetric and positive definite.

    References
    ----------
    Rotondo, Buciakowski, Witczak: Simultaneous state and process fault estimation in LPV systems
    using robust QPV observers.

    Examples
    --------
    >>> region = Ellipsoid([4.0, 1.0], [10.0, 0.0])
    >>> region.value([11.0, 0.5]), region.half_widths.tolist()
    (0.5, [2.0, 1.0])
    """

    Q: Annotated[FloatArray, "N N"]
    c: Annotated[FloatArray, "N"]

    def __init__(self, Q: ArrayLike, c: ArrayLike) -> None:
        centre = _numbers("c", c)
        shape = _numbers("Q", Q)
        if shape.ndim == 1:
            shape = np.diag(shape)
        if centre.ndim != 1 or shape.shape != (centre.size, centre.size):
            raise ObsynthError(
                f"an ellipsoid has Q of shape (N, N) or (N,) and c of shape (N,); given were "
                f"{np.shape(Q)} and {np.shape(c)}",
                Q=np.shape(Q),
                c=np.shape(c),
            )
        if np.any(shape != shape.T):
            raise ObsynthError("Q of an ellipsoid has to be symmetric", Q=shape.tolist())
        lowest = float(np.linalg.eigvalsh(shape)[0])
        if lowest <= 0:
            raise ObsynthError(
                f"Q of an ellipsoid has to be positive definite; its smallest eigenvalue is "
                f"{lowest:.3g}",
                eigenvalue=lowest,
            )
        for array in (shape, centre):
            array.flags.writeable = False
        object.__setattr__(self, "Q", shape)
        object.__setattr__(self, "c", centre)

    @property
    def dimension(self) -> int:
        """Number of coordinates N."""
        return self.c.size

    @property
    def half_widths(self) -> FloatArray:
        """Half widths of the bounding box, sqrt(Q_ii), shape (N,)."""
        return np.sqrt(np.diag(self.Q))

    def value(self, x: ArrayLike) -> float | FloatArray:
        """Return (x - c)' Q^-1 (x - c), at most 1 inside.

        Parameters
        ----------
        x : array_like of shape (N,) or (K, N)

        Returns
        -------
        float or ndarray of shape (K,)
        """
        offset = np.asarray(x, dtype=float) - self.c
        values = np.einsum("...i,...i->...", offset, np.linalg.solve(self.Q, offset.T).T)
        return float(values) if values.ndim == 0 else np.asarray(values)

    def __repr__(self) -> str:
        diagonal = np.diag(np.diag(self.Q))
        Q = np.diag(self.Q).tolist() if np.array_equal(self.Q, diagonal) else self.Q.tolist()
        return f"Ellipsoid(Q={Q}, c={self.c.tolist()})"


def _numbers(name: str, value: ArrayLike) -> FloatArray:
    try:
        array = np.array(value, dtype=float)
    except (TypeError, ValueError) as error:
        raise ObsynthError(f"{name} of an ellipsoid is no array of numbers: {value!r}") from error
    if not np.isfinite(array).all():
        raise ObsynthError(f"{name} of an ellipsoid has entries that are not finite: {value!r}")
    return array
