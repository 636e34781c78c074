"""The notebook of the QPV observer: printed and corrected optimum, and what the figures claim."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """
{
    "printed": [printed.mu, printed.error_set],
    "mu": [made.performance["mu"] for made in observers.values()],
    "largest": largest,
    "rms": rms,
    "first": sorted(set(runs["FS0"].status.astype(int).tolist())),
    "fault": float(for_f3.performance["core_half_widths"][5]),
    "faults": list(map(float, bounded.performance["core_half_widths"][3:])),
    "coverage": min(run.coverage.values()),
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
}
"""


@pytest.fixture(scope="module")
def executed(execute):
    return execute("qpv", QUESTION)


def test_the_stored_outputs_are_current(executed):
    assert executed.stale == []


def test_the_printed_and_the_corrected_optimum(executed):
    mu, error_set = executed.answers["printed"]
    assert mu == pytest.approx(2.40004, rel=1e-3) and error_set > 10
    assert executed.answers["mu"] == pytest.approx([0.0212636, 0.0240057], rel=1e-3)


def test_the_claim_of_figure_6_does_not_hold(executed):
    known = {"FS0": 0.48497, "FS1": 45.420, "FS2": 2.8151, "Fig. 7": 525.79}
    assert executed.answers["largest"] == pytest.approx(known, rel=1e-3)
    assert executed.answers["first"] == [20]


def test_noise(executed):
    rms = executed.answers["rms"]
    assert rms["SC2"] / rms["SC1"] == pytest.approx(0.406, abs=0.03)
    assert executed.answers["fault"] == pytest.approx(0.469, abs=1e-3)
    assert executed.answers["faults"] == pytest.approx([0.367, 0.255, 0.527], abs=2e-3)
    assert executed.answers["coverage"] == 1.0


def test_the_rest_of_the_way(executed):
    assert executed.answers["valid"] is True
    assert executed.answers["vectors"] in (None, 2000)
    assert executed.pictures == [1, 3, 1, 1, 1, 2]
    for words in ("is not seen everywhere", "as printed", "Runge-Kutta", "512 pairs"):
        assert words in executed.page, words
