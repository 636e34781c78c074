"""The notebook of the interval observer shows the divergence and arrives at the right numbers."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """
{
    "radius": refusal.radius,
    "alpha": [refusal.alpha, refusal.largest_alpha],
    "explosion": float(widths[20, 1]),
    "table": [list(map(float, row)) for row in table.values()],
    "shares": shares,
    "coverage": min(run.coverage.values()),
    "delay": run.fault_delay,
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
}
"""
WIDTHS = {
    0: (0.440641, 0.786133, 0.936861),
    1: (0.0575, 0.106199, 0.294156),
    2: (0.0575, 0.105984, 0.292142),
    3: (0.0575, 0.019998, 0.283544),
    4: (0.0575, 0.019998, 0.2350),
}


@pytest.fixture(scope="module")
def executed(execute):
    return execute("interval_observer", QUESTION)


def test_the_stored_outputs_are_current(executed):
    assert executed.stale == []


def test_the_printed_example_diverges(executed):
    found = executed.answers
    assert found["radius"] == pytest.approx(8.272158, rel=1e-6)
    assert found["alpha"] == pytest.approx([21.85076, 0.4], rel=1e-6)
    assert found["explosion"] == pytest.approx(3.87e19, rel=0.01)


@pytest.mark.parametrize("row", WIDTHS)
def test_widths(executed, row):
    x2, x3, f, inside = executed.answers["table"][row]
    assert (x2, x3, f) == pytest.approx(WIDTHS[row], rel=0.01)
    assert inside == 1.0


def test_equation_32(executed):
    shares = executed.answers["shares"]
    assert shares["corrected"] == shares["wrong theta alone"] == 1.0
    assert shares["printed"] == pytest.approx(0.199, abs=0.03)
    assert shares["wrong y alone"] == pytest.approx(0.215, abs=0.03)


def test_the_rest_of_the_way(executed):
    found = executed.answers
    assert found["coverage"] == 1.0
    assert found["delay"] == 1
    assert found["valid"] is True
    assert found["vectors"] in (None, 3000)
    assert executed.pictures == [1, 3, 1, 1]
    for words in ("is not met", "IEEE double", "exact rational arithmetic"):
        assert words in executed.page, words
