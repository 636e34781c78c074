"""The notebook of the measured leak, and the picture that README shows of it."""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
QUESTION = """{
    "upper": fit.upper,
    "lower": fit.lower,
    "refuted": fit.refuted,
    "widths": [ob.estimate(o, record).widths()["leak"]["median"] for o in observers],
    "mean": float(np.median(half[told.mean_status == 0])),
    "inside": float(inside.mean()),
    "known": float(record.time[known][low > 0][0]),
    "early": float(record.time[known][(low > 0) | (high < 0)][0]),
    "compiled": equal == len(rows) == 181 if project.build else None,
}"""


@pytest.fixture(scope="module")
def notebook(execute):
    return execute("measured_leak", QUESTION)


def test_the_stored_outputs_are_current(notebook):
    assert notebook.stale == []


def test_every_number_of_the_record(notebook):
    found = notebook.answers
    assert abs(found["upper"] - 0.008563) < 1e-5
    assert 0.008526 < found["lower"] < found["upper"]
    assert found["refuted"]
    assert all(width <= 0.0199 for width in found["widths"])
    assert found["mean"] <= 0.00645
    assert found["inside"] == 1.0
    assert found["known"] == found["early"] == 62.0
    assert found["compiled"] in (None, True)


def test_the_texts_around_are_true(notebook):
    assert "The declared bounds are refuted." in notebook.page
    assert "from t = 62 s on" in notebook.page
    assert notebook.page.count("100 % inside") == 3
    assert sum(notebook.pictures) == 2


def test_the_picture_is_drawn(tmp_path):
    target = tmp_path / "leak.png"
    command = [sys.executable, str(ROOT / "tools" / "measured_leak.py"), str(target)]
    told = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "100% of the meter inside, certain at 62 s" in told.stdout
    assert target.stat().st_size > 10_000
