"""The notebook of the set-membership observer: inside at every instant, at the promised widths."""

import pytest

pytestmark = pytest.mark.long

QUESTION = """
{
    "sums": [summed(before), summed(run)],
    "coverage": [min(one.coverage.values()) for one in (run, warm)],
    "clean": [not one.outside for one in (run, warm)],
    "banks": [list(map(float, bank)) for bank in banks],
    "probe": float(warm.widths["bias"][200:].mean()),
    "leak": float(np.median(high - low) / 2),
    "meter": float(np.mean((low <= meter) & (meter <= high))),
    "first": int(certain[0]),
    "void": [void.tolist(), second[(status_2 & 8) > 0].tolist()],
    "valid": certificate.valid,
    "vectors": project.comparison.vectors if project.comparison else None,
    "compiled": equal == len(rows) == 181 if project.build else None,
}
"""


@pytest.fixture(scope="module")
def executed(execute):
    return execute("set_membership", QUESTION)


@pytest.fixture(scope="module")
def found(executed):
    return executed.answers


def test_the_stored_outputs_are_current(executed):
    assert executed.stale == []


def test_four_tanks_are_inside_and_narrower_than_peak_bounds(found):
    assert found["coverage"] == [1.0, 1.0]
    assert found["clean"] == [True, True]
    before, after = found["sums"]
    assert after < 1.87 < 2.7 < before


def test_more_columns_are_narrower_and_larger(found):
    sizes, widths = zip(*found["banks"], strict=True)
    assert list(sizes) == sorted(sizes)
    assert widths[-1] < widths[0]


def test_the_probe_that_no_other_method_follows(found, executed):
    assert found["probe"] < 0.7
    for expected in ("no more than is declared of bias", "constant coefficient"):
        assert expected in executed.page, expected


def test_the_leak_and_what_contradicts_the_bounds(found):
    assert found["leak"] == pytest.approx(0.01501, rel=2e-3)
    assert found["meter"] == 1.0
    assert found["first"] == 61
    assert found["void"] == [[84, 99, 183], []]


def test_the_design_is_proved_again_and_the_c_code_compared(found, executed):
    assert found["valid"] is True
    assert found["vectors"] in (None, 500)
    assert found["compiled"] in (None, True)
    assert sum(executed.pictures) == 6
