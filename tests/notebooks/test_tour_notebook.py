"""The tour runs from top to bottom, and what it says of its plant holds."""

import pytest

QUESTION = """{
    "coverage": min(run.coverage.values()),
    "assumptions": run.domain.ok and not run.outside,
    "widths": {label: list(map(float, o.half_widths)) for label, o in observers.items()},
    "m21": [bounds.min[1, 0], bounds.max[1, 0]],
    "promised": float(detector.smallest_detectable[0]),
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
    "compiled": equal == len(rows) == 1001 if project.build else None,
}"""


@pytest.fixture(scope="module")
def tour(execute):
    return execute("tour", QUESTION)


def test_the_stored_outputs_are_current(tour):
    assert tour.stale == []


def test_bounds_are_those_of_the_cosine(tour):
    """The entry is -6 Ts cos(phi), over |phi| <= 2.5."""
    assert tour.answers["m21"] == pytest.approx([-0.06, 0.06 * 0.8011436155469337], rel=1e-9)


def test_the_truth_is_inside_and_the_alarm_comes(tour):
    assert tour.answers["coverage"] == 1.0
    assert tour.answers["assumptions"] is True
    widths = tour.answers["widths"]
    assert widths["peak"][2] < widths["ellipsoid"][2] < widths["interval"][2]
    assert tour.answers["promised"] == pytest.approx(2 * widths["peak"][2], rel=1e-6)
    assert "after its onset" in tour.page and "no false alarm" in tour.page


def test_the_refusal_names_what_is_missing(tour):
    assert "Measure omega" in tour.page


def test_the_file_is_proved_and_the_code_compared(tour):
    assert tour.answers["valid"] is True
    assert tour.answers["vectors"] in (None, 3000)
    assert tour.answers["compiled"] in (None, True)
    assert tour.pictures == [1, 1]
