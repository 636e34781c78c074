"""The exact feasible sets of Alamo, Bravo, Camacho (2005), example 7.1, lie in ours.

The hull at the last index is the one that CORA's tests hold; the hulls at the other indices come
from linear programmes over x_0, s_j and v_j, with y_j used at index j.
"""

import numpy as np
import pytest
import sympy as sp
from scipy.optimize import linprog

import obsynth as ob

MEASUREMENTS = np.array(
    [
        0.0234670727523143,
        -4.3282364718962034,
        -4.1973096745991345,
        -1.9546081148402012,
        0.0983604258227819,
        1.1666132024783362,
        1.1073176387179109,
        0.4263920687095986,
        -0.0092682185713610,
        -0.3069527304071071,
        -0.1292621672249405,
        -0.0195793311301101,
        -0.0751745657276915,
        0.0774426557519688,
        0.2618198630568284,
        -0.0222441951122745,
        0.0464232298590576,
        -0.1385809053684645,
        0.0876767710448164,
        -0.1094667337318030,
    ]
)
LAST = np.array(
    [[-0.1062309346120359, 0.1411256696418789], [-0.2540037859300612, 0.2127846055519550]]
)
ZONOTOPIC_KALMAN = np.array(
    [[-0.2942866270722150, 0.2767909177420897], [-0.4084412460702273, 0.4113280380282030]]
)
A = np.array([[0.0, -0.5], [1.0, 1.0]])
C = np.array([[-2.0, 1.0]])
W = np.array([-0.12, 0.02])


def plant():
    R = sp.Rational
    p = ob.Plant("example 7.1")
    x = p.states("x1:3", range=(-3, 3))
    (s,) = p.disturbances("s", bound=1)
    (v,) = p.disturbances("v", bound=R(1, 5))
    p.dynamics([-x[1] / 2 - R(12, 100) * s, x[0] + x[1] + R(2, 100) * s], Ts=1)
    p.outputs([-2 * x[0] + x[1] + v])
    return p


def exact_hull(k, late=0):
    """Hull of all x_k that y_0 .. y_k (shifted by `late`) allow, by four linear programmes."""
    maps = [np.hstack([np.eye(2), np.zeros((2, k))])]
    for j in range(k):
        moved = A @ maps[-1]
        moved[:, 2 + j] += W
        maps.append(moved)
    rows = np.vstack([C @ m for m in maps])
    y = MEASUREMENTS[late : late + k + 1]
    bounds = [(-3, 3)] * 2 + [(-1, 1)] * k
    hull = []
    for row in maps[-1]:
        ends = []
        for sign in (1.0, -1.0):
            found = linprog(
                sign * row,
                A_ub=np.vstack([rows, -rows]),
                b_ub=np.concatenate([y + 0.2, 0.2 - y]),
                bounds=bounds,
                method="highs",
            )
            assert found.status == 0
            ends.append(sign * found.fun)
        hull.append(ends)
    return np.array(hull)


def sets(observer, y):
    memory, found = observer.memory0([0, 0], x_range=[[-3, 3]] * 2), []
    for value in y:
        out = [np.array(o).ravel() for o in observer.step(memory, [], value)]
        memory = out[0]
        found.append(np.column_stack([out[3], out[4]]))
        assert out[7] == 0
    return np.array(found)


@pytest.fixture(scope="module")
def hulls():
    return np.array([exact_hull(k) for k in range(20)])


@pytest.fixture(scope="module")
def observers():
    options = {
        "default": {},
        "vertex": {"contraction": False},
        "sylvester": {"gains": "sylvester"},
        "paper": {"bound": "paper", "contraction": False},
        "single": {"precision": "single"},
    }
    return {name: ob.IntervalObserver(**given).design(plant()) for name, given in options.items()}


def test_the_programmes_give_the_published_hull(hulls):
    assert hulls[-1] == pytest.approx(LAST, abs=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", ["default", "vertex", "sylvester", "paper", "single"])
def test_every_feasible_set_is_contained(name, observers, hulls):
    found = sets(observers[name], MEASUREMENTS)
    # the programmes are solved to 1e-9
    assert np.all(found[:, :, 0] <= hulls[:, :, 0] + 1e-9)
    assert np.all(hulls[:, :, 1] <= found[:, :, 1] + 1e-9)


@pytest.mark.long
def test_narrower_than_the_zonotopic_kalman_filter(observers):
    found = sets(observers["default"], MEASUREMENTS)[-1]
    assert np.all(found[:, 0] >= ZONOTOPIC_KALMAN[:, 0])
    assert np.all(found[:, 1] <= ZONOTOPIC_KALMAN[:, 1])
    assert (found[:, 1] - found[:, 0]) == pytest.approx([0.4771, 0.5513], rel=0.02)


def test_a_shift_by_one_leaves_the_exact_set(observers, hulls):
    found = sets(observers["default"], MEASUREMENTS)
    late = (found[:-1, :, 0] <= hulls[1:, :, 0] + 1e-9) & (
        hulls[1:, :, 1] <= found[:-1, :, 1] + 1e-9
    )
    assert not late.all()
    early = sets(observers["default"], MEASUREMENTS[:-1])
    assert np.any(early[:, :, 0] > hulls[1:, :, 0]) or np.any(early[:, :, 1] < hulls[1:, :, 1])
