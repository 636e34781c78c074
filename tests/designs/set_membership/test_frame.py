"""Coordinates of the reduction: what their rounding adds is provable, or they are refused."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.set_membership.claims import claims
from obsynth.designs.set_membership.synthesis import frame
from obsynth.designs.set_membership.zonotope import Frame


@pytest.fixture(scope="module")
def design():
    plant = ob.Plant("store")
    (x,) = plant.states("x", range=(-5, 5))
    y = plant.states("y", range=(-5, 5))[0]
    w, v = plant.disturbances("w v", bound=sp.Rational(1, 100))
    plant.dynamics([x / 2 + y / 4 + w, y / 2], Ts=1)
    plant.outputs([x + v])
    method = ob.SetMembershipObserver(columns=8, zonotopes=0)
    return method.analyse(plant, {"L": [[0.5], [0]]}).certificate.design


@pytest.mark.parametrize(("apart", "holds"), [(2.0**-20, True), (2.0**-47, False)])
def test_nearly_dependent_coordinates_are_refused(design, apart, holds):
    """Mutant: the limit of what rounding adds left out; row sums of I - V W alone are below 1."""
    found = frame(np.array([[1.0, 1.0], [1.0, 1.0 + apart]]))
    given = replace(design, V=found.V, W=found.W, size=found.size, leak=found.leak)
    assert next(c for c in claims(given) if c.name == "frame").holds == holds


def test_what_covers_rounding_covers_itself():
    """``A >= I + M / 8 A`` in rationals, M with a zero that its square fills.

    Mutant: ``A = I + M``, without the powers.
    """
    one = np.eye(3)
    found = Frame(one, one, one + np.diag([1.0, 1.0], 1), one)
    A, M = (
        [[Fraction(entry) for entry in row] for row in matrix.tolist()]
        for matrix in (found.again, found.rounding)
    )
    for i in range(3):
        for j in range(3):
            least = (i == j) + sum(M[i][k] * A[k][j] for k in range(3)) / 8
            assert A[i][j] >= least
