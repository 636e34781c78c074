"""Boxes of code: middles, cuts, emptiness and nearest points, called with numbers."""

import casadi as ca
import numpy as np
import pytest

from obsynth.designs.core.boxes import FAR, Ends

NAN, INF = np.nan, np.inf


def numbers(result, given):
    """What an expression of two ends (a, b) and a value v is for numbers, ends as rows."""
    a, b = (Ends(ca.SX.sym("l", 3), ca.SX.sym("h", 3)) for _ in range(2))
    v = ca.SX.sym("v", 3)
    found = result(a, b, v)
    parts = [found.lower, found.upper] if isinstance(found, Ends) else [found]
    function = ca.Function("f", [a.lower, a.upper, b.lower, b.upper, v], parts)
    return [np.array(part).ravel().tolist() for part in function.call([ca.DM(g) for g in given])]


LOW, HIGH, NONE = [-3.0, 1.0, 5.0], [-1.0, 4.0, 5.0], [0.0, 0.0, 0.0]


def test_the_middle_is_between_the_ends_and_zero_without_a_bound():
    """Mutants: one half only; the width of the ends' sum; no test of the width."""
    far = [-FAR, 1.0, -FAR], [FAR, FAR, 7.0]
    assert numbers(lambda a, b, v: a.middle(), [LOW, HIGH, NONE, NONE, NONE]) == [[-2.0, 2.5, 5.0]]
    assert numbers(lambda a, b, v: a.middle(), [*far, NONE, NONE, NONE]) == [[0.0, 0.0, 0.0]]
    # a wide box far from zero, whose ends add up to more than it is wide
    ends = [[0.7 * FAR, -0.9 * FAR, 0.0], [0.9 * FAR, -0.7 * FAR, 1.0]]
    found = numbers(lambda a, b, v: a.middle(), [*ends, NONE, NONE, NONE])[0]
    assert found == pytest.approx([0.8 * FAR, -0.8 * FAR, 0.5])


def test_a_cut_keeps_what_both_hold_and_ends_without_a_number_cut_nothing():
    other = [-2.0, NAN, 0.0], [NAN, 3.0, 4.5]
    given = [LOW, HIGH, *other, NONE]
    assert numbers(lambda a, b, v: a.meet(b), given) == [[-2.0, 1.0, 5.0], [-1.0, 3.0, 4.5]]
    assert numbers(lambda a, b, v: a.meet(b).empty(), given) == [[1.0]]


@pytest.mark.parametrize(("condition", "wanted"), [(1.0, [LOW, HIGH]), (0.0, [NONE, LOW])])
def test_one_of_two_boxes_whole(condition, wanted):
    """Infinities of the other one do not enter."""
    given = [LOW, HIGH, NONE, LOW, [condition, 0.0, 0.0]]
    assert numbers(lambda a, b, v: a.where(v[0] > 0.5, b), given) == wanted
    far = [[INF] * 3, [INF] * 3] if condition == 0.0 else [LOW, HIGH]
    near = [[INF] * 3, [INF] * 3] if condition == 1.0 else [NONE, LOW]
    given = [*far, *near, [condition, 0.0, 0.0]]
    assert numbers(lambda a, b, v: a.where(v[0] > 0.5, b), given) == wanted


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize(("low", "high", "empty"), [(1, 1, 0), (2, 1, 1), (NAN, 1, 1), (1, NAN, 1)])
def test_one_coordinate_with_nothing_left_empties_a_box(place, low, high, empty):
    """What is not a number has nothing left either."""
    lower, upper = list(LOW), list(HIGH)
    lower[place], upper[place] = low, high
    assert numbers(lambda a, b, v: a.empty(), [lower, upper, NONE, NONE, NONE]) == [[empty]]


@pytest.mark.parametrize(
    ("value", "wanted"),
    [
        ([-2.5, 2.0, 5.0], [-2.5, 2.0, 5.0]),
        ([-9.0, 9.0, 9.0], [-3.0, 4.0, 5.0]),
        ([9.0, -9.0, -9.0], [-1.0, 1.0, 5.0]),
        # of zero, for what is not a number
        ([NAN, INF, -INF], [-1.0, 1.0, 5.0]),
    ],
)
def test_the_nearest_point_of_a_box(value, wanted):
    """Mutants: ends exchanged; a value that is no number taken as it is, which may give nan."""
    found = numbers(lambda a, b, v: a.nearest(v), [LOW, HIGH, NONE, NONE, value])
    assert found == [wanted]


def test_what_is_not_a_number_has_a_nearest_point_in_a_box_around_zero():
    box = [-1.0, -1.0, -1.0], [2.0, 2.0, 2.0]
    given = [*box, NONE, NONE, [INF, -INF, NAN]]
    assert numbers(lambda a, b, v: a.nearest(v), given) == [[0.0, 0.0, 0.0]]


def test_numbers_without_a_bound_and_empty_boxes():
    box = Ends.of(np.array([[-INF, 2.0], [3.0, INF]]))
    assert np.array(ca.DM(box.lower)).ravel().tolist() == [-FAR, 3.0]
    assert np.array(ca.DM(box.upper)).ravel().tolist() == [2.0, FAR]
    everything = Ends.unbounded(1)
    assert [float(ca.DM(everything.lower)), float(ca.DM(everything.upper))] == [-FAR, FAR]
    none = Ends.unbounded(0)
    assert none.middle().shape == none.nearest(ca.SX(0, 1)).shape == (0, 1)
