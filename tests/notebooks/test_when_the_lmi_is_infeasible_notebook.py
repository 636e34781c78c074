"""The notebook of a refusal: its number, its certificate, and that every way out leads out."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """{
    "largest": refusal.largest_gamma,
    "limit": limit,
    "certificate": str(sp.simplify(form - (1 - gamma - slow**2) * P[1, 1])),
    "solved": [problem.solve().objective, float(again)],
    "widths": {label: list(map(float, made.half_widths)) for label, made in observers.items()},
    "valid": all(made.certificate.valid for made in observers.values()),
    "coverage": min(run.coverage.values()),
    "made": len(chosen.made),
    "vectors": project.comparison.vectors if project.comparison else None,
}"""


@pytest.fixture(scope="module")
def notebook(execute):
    return execute("when_the_lmi_is_infeasible", QUESTION)


def test_the_stored_outputs_are_current(notebook):
    assert notebook.stale == []


def test_the_refusal_tells_the_level_that_the_unmeasured_tank_allows(notebook):
    found = notebook.answers
    assert found["limit"] == pytest.approx(1 - (1 - 0.1 / 6) ** 2, rel=1e-12)
    assert 0.99 * found["limit"] < found["largest"] <= found["limit"]
    assert found["certificate"] == "0"


def test_every_way_out_leads_out(notebook):
    found = notebook.answers
    assert found["solved"][1] == pytest.approx(found["solved"][0], rel=0.02)
    assert found["valid"] is True and found["coverage"] == 1.0
    assert len(found["widths"]) == 4 and found["made"] >= 3
    assert found["vectors"] in (None, 1000)


def test_the_run_is_shown(notebook):
    assert notebook.pictures == [1]
