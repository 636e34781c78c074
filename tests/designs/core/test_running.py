"""Half widths that fade: what they are from some call on, also where they do not fall at once.

Mutants of `settle`, each of which fails here: it ends at the first call within 1 % of the limits;
it says what the half widths are after so many calls, not the largest from then on; a map that has
not been seen to fall taken for one that falls.
"""

import numpy as np
import pytest
import sympy as sp

import obsynth as ob
from obsynth.designs.core.half_widths import Running, settle
from obsynth.designs.general.method import GeneralUIO
from obsynth.designs.general.step import running, settling

R = sp.Rational
NONE, ONE = np.zeros(3), np.ones(1)
# the third feeds the second, which feeds the first
CASCADE = np.array([[0.1, 0.02, 0.0], [0.0, 0.1, 0.25], [0.0, 0.0, 0.1]])


def late() -> Running:
    """Half width 100 and the first entry of s."""
    return Running(CASCADE, NONE, np.eye(3)[:1], 100.0 * ONE, root=False)


def test_what_dips_below_the_limits_and_rises_again_has_not_settled():
    """From (10, 0, 1000): 10, 1, 5.1, ..., of which 1 has settled."""
    first, powers = (
        np.array([10.0, 0.0, 1000.0]),
        [np.linalg.matrix_power(CASCADE, k) for k in range(9)],
    )
    shown = [100.0 + float((power @ first)[0]) for power in powers]
    assert shown[1] <= 101.0 < shown[2]
    calls, widths = settle([late()], first, None)
    assert calls == 1 + max(k for k, width in enumerate(shown) if width > 101.0) > 2
    for k in range(8):
        assert settle([late()], first, k)[1] == pytest.approx([max(shown[k:])], rel=1e-8)
    assert 100.0 < widths[0] <= 101.0


def test_half_widths_that_grow_to_their_limit_are_said_to_be_the_limit():
    ellipsoid = Running(
        np.array([[0.9]]), np.array([0.1]), 4.0 * np.ones((1, 1)), 0.0 * ONE, root=True
    )
    calls, widths = settle([ellipsoid], np.array([0.25]), None)
    assert calls == 0 and widths == pytest.approx([2.0], rel=1e-6) and widths >= 2.0
    # a second bound that is smaller in the end, and larger at first
    calls, widths = settle([ellipsoid, late()], np.array([4.0, 0.0, 0.0, 0.0]), 3)
    assert calls == 3 and widths[0] == pytest.approx(2.0 * np.sqrt(1 + 3 * 0.9**3), rel=1e-6)


def test_nothing_is_said_of_what_is_not_shown_to_fall(monkeypatch):
    """Errors that go round in a circle."""
    monkeypatch.setattr("obsynth.designs.core.half_widths.MOST_CALLS", 99)
    circle = Running(0.9999 * np.roll(np.eye(3), 1, axis=0), NONE, np.eye(3)[:1], ONE, root=False)
    for calls in (5, None):
        _, widths = settle([circle], np.array([10.0, 0.0, 0.0]), calls)
        assert np.isinf(widths).all()


def pairs():
    """Two equal pairs that turn, one driven by the other from a large box."""
    plant = ob.Plant("pairs")
    a, b, c, d = plant.states("x1:5", range=[(-1, 1), (-1, 1), (-50, 50), (-50, 50)])
    w = plant.disturbances("w1:3", bound=[0.01, 0.02])
    slow, turn = R(8, 10), R(5, 10)
    plant.dynamics(
        [
            slow * a + turn * b + c + w[1],
            slow * b - turn * a + d,
            slow * c + turn * d,
            slow * d - turn * c + d**2 / 10000,
        ],
        Ts=1,
    )
    plant.outputs([a + w[0]])
    return plant


@pytest.fixture(scope="module")
def turning():
    return GeneralUIO().analyse(pairs(), {"L": np.zeros((4, 1))}).certificate.design


@pytest.mark.parametrize("calls", [0, 1, 5, 30, None])
def test_errors_of_equal_pairs_that_turn_stay_below_what_is_said_from_then_on(turning, calls):
    """Against errors of the plant itself, which grow for many calls before they fade."""
    box, limit = np.array([1.0, 1.0, 50.0, 50.0]), running(turning)[0].steady
    k, widths = settling(turning, box, calls)
    assert np.all(widths <= 1.01 * limit) if calls is None else k == calls
    shared, slow, rng = np.array([[0.8, 0.5], [-0.5, 0.8]]), np.eye(2), np.random.default_rng(0)
    A = np.block([[shared, slow], [0.0 * slow, shared]])
    e = box[:, None] * rng.choice([-1.0, 1.0], (4, 50))
    most = np.zeros(4)
    for j in range(1200):
        most = np.maximum(most, np.abs(e).max(axis=1)) if j >= k else most
        e = A @ e + np.array([0.02, 0, 0, 0])[:, None] * rng.choice([-1.0, 1.0], 50)
    assert np.all(most <= widths)
    # the first of them grows first
    assert calls != 0 or most[0] > 2.0 * (2.0 * box + limit).max()
