"""The page stands alone, parses, shows the tables, and replaces a file only when complete."""

import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import CHROMIUM, opened

from obsynth.evaluate import ReportError, coverage_table, report
from obsynth.evaluate import report as report_function
from obsynth.evaluate.svg import equations_html
from obsynth.symbolic import Plant, Table

VOID = {"meta", "link", "br", "hr", "img", "input", "path", "use", "rect"}
NUMBERS = Table("Bounds < printed", ["entry", "derived"], [["m13", 0.00504]], "why & how")


WIDE = Table("Wide", [f"column {i}" for i in range(12)], [[f"{i}.123456" for i in range(12)]])


class Strict(HTMLParser):
    """Checks that elements nest and that ids are unique; keeps the text."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.text, self.tags = [], [], [], [], set()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        for key, value in attrs:
            if key == "id":
                self.ids.append(value)
            if key == "href":
                self.references.append(value)
            if key in ("src", "srcset", "action", "data"):
                raise AssertionError(f"{tag} loads {value}")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag in VOID:
            return
        assert self.open, tag
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def parse(page):
    parser = Strict()
    parser.feed(page)
    parser.close()
    assert parser.open == []
    return parser


@pytest.fixture(scope="module")
def page(tmp_path_factory, toy, toy_run):
    path = tmp_path_factory.mktemp("report") / "report.html"
    said = []
    written = report(
        path,
        {"wide": toy.observer(toy.plant), "narrow": toy.observer(toy.plant)},
        runs={"wide": [toy_run], "narrow": [toy_run]},
        tables={"Derived bounds": NUMBERS, "C code": [NUMBERS, WIDE], "Errata": NUMBERS},
        lead="A toy.",
        progress=said.append,
    )
    assert written == path
    assert len(said) == 4
    return path.read_text(encoding="utf-8")


def test_the_page_needs_nothing_but_itself(page):
    assert "http:" not in page
    assert "https:" not in page
    assert "@import" not in page
    assert re.findall(r"url\((?!#)", page) == []
    parsed = parse(page)
    assert not parsed.tags & {"script", "link", "img", "iframe", "object"}
    assert all(reference.startswith("#") for reference in parsed.references)


def test_ids_are_unique_and_references_meet_them(page):
    parsed = parse(page)
    assert len(parsed.ids) == len(set(parsed.ids))
    assert {reference[1:] for reference in parsed.references} <= set(parsed.ids)
    used = set(re.findall(r"url\(#([^)]+)\)", page))
    assert used
    assert used <= set(parsed.ids)


def test_the_page_holds_tables_claims_guarantee_coverage_and_signals(page):
    text = " ".join(" ".join(parse(page).text).split())
    for expected in (
        "Bounds < printed",
        "why & how",
        "a <= y + 0.1 & a >= y - 0.1",
        "by construction",
        "1 of 1 claims proved",
        "|d| <= 0.1",
        "Coverage",
        "actuator fault of v",
        "2 of 2",
        "Errata",
        "Half widths in steady state",
        "x and xhat are inside the box at all 201 instants",
    ):
        assert expected in text, expected
    headings = re.findall(r"<h2>([^<]+)</h2>", page)
    assert headings == [
        "Plant",
        "Derived bounds",
        "Design and certificate",
        "Half widths",
        "Simulation",
        "C code",
        "Errata",
    ]


def test_ink_follows_the_page(page):
    assert "prefers-color-scheme: dark" in page
    assert "@media print" in page
    assert "var(--ink)" in page
    assert "#1b1d21" not in page.split("</style>", 1)[1]


def test_a_claim_that_does_not_hold_is_shown_as_such(toy, tmp_path):
    from obsynth.designs.core.certificate import Certificate, Claim

    class Doubtful(toy.observer):
        @property
        def certificate(self):
            claims = (Claim("a", "two is two", True, 1, "-"), Claim("b", "no", False, -1, "-"))
            return Certificate(claims, {}, None)

    text = report(tmp_path / "r.html", Doubtful(toy.plant)).read_text(encoding="utf-8")
    assert "1 of 2 claims proved" in text
    assert text.count(">✗</td>") == 1


def test_the_same_report_is_the_same_bytes(toy, toy_run, tmp_path):
    observer = toy.observer(toy.plant)
    pages = [report(tmp_path / name, observer, toy_run).read_bytes() for name in ("a", "b")]
    assert pages[0] == pages[1]


def test_a_report_that_fails_leaves_the_old_file(toy, toy_run, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("old")

    def stop(word):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        report(path, toy.observer(toy.plant), toy_run, progress=stop)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_write_that_fails_leaves_no_piece(toy, tmp_path, monkeypatch):
    def refuse(*args):
        raise OSError("disk")

    monkeypatch.setattr("os.replace", refuse)
    with pytest.raises(OSError, match="disk"):
        report(tmp_path / "report.html", toy.observer(toy.plant))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium")
@pytest.mark.parametrize("width", [1280, 400])
def test_a_browser_shows_all_of_it(page, tmp_path, width):
    """Mutants: no rules of their own for narrow pages; panels two in a row there."""
    found = opened(page, tmp_path, width)
    assert found["width"] == width and found["page"] <= width
    assert (found["trouble"], found["wide"], found["cut"]) == ([], [], [])
    count, least = found["letters"]
    assert count > 50 and least >= 9.0
    assert max(found["figures"]) < 300_000


def test_void_instants_and_kept_assumptions_do_not_contradict_each_other(toy_run):
    status = toy_run.status.copy()
    status[7] |= 8
    void = replace(toy_run, status=status)
    for run, kept in ((toy_run, True), (void, False)):
        assert coverage_table({"toy": [run]}).rows[0][-1] is kept


def test_refusals(toy, tmp_path):
    with pytest.raises(ReportError, match="does not exist"):
        report_function(tmp_path / "no" / "report.html", toy.observer(toy.plant))
    with pytest.raises(ReportError, match="at least one observer"):
        report_function(tmp_path / "report.html", {})


def test_formulas_that_mathtext_cannot_set_are_text(toy):
    import sympy as sp

    plant = Plant("bent")
    (x,) = plant.states("x1", range=(-1, 1))
    plant.dynamics([sp.Piecewise((x, x > 0), (2 * x, True))])
    plant.outputs([x])
    shown = equations_html(plant, "k")
    assert "<code>x1&#x27; = Piecewise" in shown
    assert shown.count("<svg") == 1
    assert r"\dot{a}" not in equations_html(toy.plant, "k")
    assert np.isfinite(len(shown))
