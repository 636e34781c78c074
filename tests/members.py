"""Whether a matrix is a member of an affine family, by a linear program that no design uses."""

import numpy as np
from scipy.optimize import linprog


def belongs(family, matrix):
    """Tell whether scalars in their ranges reproduce a matrix, up to the radius and rounding."""
    columns = family.directions.reshape(len(family.directions), -1).T
    rest, slack = (matrix - family.constant).ravel(), family.radius.ravel()
    slack = slack + 2.0**-50 * np.abs(matrix).ravel()
    found = linprog(
        np.zeros(len(family.ranges)),
        np.vstack([columns, -columns]),
        np.concatenate([rest + slack, slack - rest]),
        bounds=family.ranges,
    )
    return found.status == 0
