"""Tables as text and HTML."""

import pytest

from obsynth.symbolic import ObsynthError, Table


def test_rows_have_to_fit_the_columns():
    with pytest.raises(ObsynthError, match="row 1 of table 'T' has 1 cells for 2 columns"):
        Table("T", ["a", "b"], [[1, 2], [3]])


def test_html_is_escaped_numbers_are_flush_right_and_marked_rows_marked():
    page = Table("x < y", ["name", "value"], [["a&b", 1.5], ["c", 2]], "n > 1", marked=[1])
    text = page._repr_html_()
    assert "x &lt; y" in text
    assert "a&amp;b" in text
    assert "n &gt; 1" in text
    assert '<td class="number" style="text-align:right" data-head="value">1.5</td>' in text
    assert '<tr class="marked"><td style="text-align:left" data-head="name">c</td>' in text
