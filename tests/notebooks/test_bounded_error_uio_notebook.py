"""The notebook runs from top to bottom and arrives at the paper's numbers."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """{
    "equilibrium": list(parts.at.x),
    "m13": [bounds.min[0, 2], bounds.max[0, 2]],
    "vertices": [bounds.naive_vertex_count, len(bounds.vertices())],
    "largest_gamma": refusals[1].largest_gamma,
    "signs": [point.q1 >= 0, point.q2 >= 0],
    "sums": {label: float(observer.half_widths.sum()) for label, observer in designs.items()},
    "ellipsoid": list(ellipsoid.half_widths),
    "coverage": [min(run.coverage.values()) for several in runs.values() for run in several],
    "rms": list(fs1.rms(from_step=1000).values()),
    "assumptions": [run.domain.ok and not run.outside for r in runs.values() for run in r],
    "outside": len(real.outside),
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
}"""


@pytest.fixture(scope="module")
def executed(execute):
    return execute("bounded_error_uio", QUESTION)


@pytest.fixture(scope="module")
def found(executed):
    return executed.answers


def test_the_stored_outputs_are_current(executed):
    assert executed.stale == []


def test_plant_and_derived_forms(found, reference):
    assert found["equilibrium"] == pytest.approx(reference["model"]["xeq"], rel=1e-9)
    low, high = reference["model"]["Jmin"][0][2], reference["model"]["Jmax"][0][2]
    assert found["m13"] == pytest.approx([low, high], rel=1e-9)
    assert found["vertices"] == [64, 16]


def test_the_printed_form_is_refused_with_its_reason(found):
    assert found["largest_gamma"] == pytest.approx(0.00903, rel=2e-3)
    assert found["signs"] == [True, True]


def test_half_widths(found, reference):
    assert found["ellipsoid"] == pytest.approx(reference["base"]["z"], rel=0.005)
    assert found["sums"]["(51), repaired"] == pytest.approx(24.32, rel=0.005)
    assert found["sums"]["peak"] / found["sums"]["(51), repaired"] <= 0.14


def test_every_state_and_fault_is_inside_at_every_instant(found, reference):
    assert found["coverage"] == [1.0] * 12
    assert found["assumptions"] == [True] * 12
    assert found["rms"] == pytest.approx(reference["sim"]["FS1"]["rms"], rel=0.1)
    assert found["outside"] == 1


def test_the_design_is_proved_again_and_the_c_code_compared(found):
    assert found["valid"] is True
    assert found["vectors"] in (None, 3000)


def test_figures_and_tables_are_shown(executed):
    # the bars, six figures of FS1 and of FS2 with zooms, the grid of FS2, the errors
    assert executed.pictures == [1, 6, 6, 1, 1]
    for expected in ("too narrow", "m13 = -m33", "E W1 is no product", "typedef"):
        assert expected in executed.page, expected
