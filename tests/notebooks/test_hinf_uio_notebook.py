"""The notebook runs from top to bottom and arrives at the paper's numbers and at its errors."""

import json
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

QUESTION = """{
    "levels": {
        f"{form}, {name}": design.performance["least_mu"]
        for (form, name), design in designs.items()
    },
    "proved": all(design.certificate.valid for design in designs.values()),
    "printed": printed.performance["mu"],
    "scalar": scalar.performance["least_mu"],
    "paper_K": [by_45.performance["mu"], by_vertices.performance["mu"], worst.gain],
    "balance": float(balance.max()),
    "e": [float(v) for v in np.linalg.norm(nominal.x - nominal.xhat, axis=1)[:21]],
    "fault": [float(v) for v in nominal.fhat[[200, 201, 301, 302], 0]],
    "noise": max(ratios),
    "refused": [refusal.entries["dg_x1/dx1"], refusal.spectral_radius],
    "rest": [float(radius), size[0], size[-1], float(proved[-1])],
    "ranges": [float(abs(u_rest[0])), float(abs(f_rest[0]))],
    "vectors": project.comparison.vectors if project.comparison else None,
}"""


@pytest.fixture(scope="module")
def notebook(execute):
    return execute("hinf_uio", QUESTION)


def test_the_stored_outputs_are_current(notebook):
    assert notebook.stale == []


def test_the_printed_g_is_not_the_one_of_51(notebook):
    assert "cos(12 x1): (51) is its Jacobian: False" in notebook.page
    assert "cos(12 x2): (51) is its Jacobian: True" in notebook.page


def test_levels(notebook):
    found = notebook.answers
    assert found["printed"] == pytest.approx(0.498881, abs=2e-5)
    assert found["scalar"] == pytest.approx(2.104234, abs=1e-3)
    assert found["proved"] is True
    levels = found["levels"]
    assert levels["general filter, consistent"] == pytest.approx(0.458611, abs=3e-5)
    assert levels["general filter, as_printed"] == pytest.approx(0.458611, abs=3e-5)
    assert levels["vertices, as_printed"] == pytest.approx(0.462214, abs=3e-5)
    assert levels["(45), as printed, as_printed"] == pytest.approx(1.141733, abs=1e-3)


def test_what_the_printed_gain_is_worth(notebook):
    by_45, by_vertices, reached = notebook.answers["paper_K"]
    assert by_45 == pytest.approx(0.49889, abs=2e-5)
    assert by_vertices == pytest.approx(0.460795, abs=3e-6)
    assert 0.46079 < reached <= by_vertices
    assert notebook.answers["noise"] < 0.28


def test_figures_of_the_paper(notebook, hinf_sim):
    assert notebook.answers["balance"] < 0.0
    assert notebook.answers["e"] == pytest.approx(hinf_sim["norm_e"], abs=1e-12)
    assert notebook.answers["fault"] == pytest.approx([0, 1, 1, 0], abs=1e-6)
    assert notebook.pictures == [1, 1]


def test_the_printed_gain_is_unstable_for_the_printed_g(notebook):
    slope, radius = notebook.answers["refused"]
    assert slope == pytest.approx(-0.72, rel=1e-6) and radius > 1.04
    at_rest, first, last, proved = notebook.answers["rest"]
    assert at_rest > 1.04
    assert first == pytest.approx(1e-4) and last > 0.01 and proved < 1e-12
    assert max(notebook.answers["ranges"]) <= 1.0


def test_code_is_compared(notebook):
    assert notebook.answers["vectors"] in (None, 2000)


@pytest.fixture(scope="module")
def hinf_sim():

    path = Path(__file__).parents[1] / "reference" / "hinf_uio.json"
    return json.loads(path.read_text())["sim"]["g51_KP"]
