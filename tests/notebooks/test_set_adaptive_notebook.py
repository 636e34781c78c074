"""The notebook runs from top to bottom and arrives at the note's numbers."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """
{
    "broken": broken / len(x),
    "alpha": exact.performance["alpha"],
    "early": [int(((r.f_lower[r.t < 200] > 0) | (r.f_upper[r.t < 200] < 0)).sum())
              for r in (run, noisy)],
    "late": [[float(r.t[(r.t >= s) & (r.f_lower[:, i] > 0)][:1].sum() - s)
              for i, s in enumerate((200, 300))] for r in (run, noisy)],
    "left": float(run.t[run.status & 8 > 0][0]),
    "ends": {law: [float(v) for v in pair] for law, pair in ends.items()},
    "coverage": min(noisy.coverage[name] for name in ("x1", "x2", "x3")),
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
}
"""


@pytest.fixture(scope="module")
def executed(execute):
    return execute("set_adaptive", QUESTION)


@pytest.fixture(scope="module")
def found(executed):
    return executed.answers


def test_the_stored_outputs_are_current(executed):
    assert executed.stale == []


def test_bounds_and_gain(found):
    assert found["broken"] == pytest.approx(0.115, abs=0.03)
    assert found["alpha"] == pytest.approx(0.0298909, abs=1e-7)


def test_delays_without_false_alarms(found):
    assert found["early"] == [0, 0]
    exact, noisy = found["late"]
    assert 0.6 < exact[0] < 1.2
    assert exact[1] < 0.0
    assert noisy == pytest.approx([1.37, 1.89], abs=0.02)
    assert found["left"] == pytest.approx(221.54, abs=0.02)
    assert found["coverage"] == 1.0


def test_the_two_laws(found):
    upper, lower = found["ends"]["printed"]
    assert upper < 0.3 < lower
    assert found["ends"]["cooperative"] == pytest.approx([0.521228, -0.469024], abs=1e-3)


def test_the_design_is_proved_again_and_the_c_code_compared(found):
    assert found["valid"] is True
    assert found["vectors"] in (None, 1000)


def test_figures_are_shown(executed):
    assert sum(executed.pictures) == 6
    for expected in ("not Metzler", "exp(-0.1 age)", "D = 1"):
        assert expected in executed.page, expected
