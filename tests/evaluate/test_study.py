"""The whole way on the quadruple tank: what it tabulates, what it leaves, what it refuses."""

import json
import sys
from functools import partial

import pytest

from obsynth.codegen import FolderError
from obsynth.codegen.folder import check_target, complete_folder
from obsynth.evaluate import SimulationError
from obsynth.evaluate.papers.buciakowski import PRINTED_GAMMA
from obsynth.evaluate.studies.quadruple_tank import ELLIPSOID, PEAK, RUN, quadruple_tank, shortened


@pytest.fixture(scope="module")
def quick(base, given_peak):
    """The study with designs at hand and few vectors; everything else is as it ships."""
    module = sys.modules["obsynth.evaluate.studies.quadruple_tank"]
    genuine = module.BoundedErrorUIO

    def method(**options):
        class Known:
            def design(self, parts, bounds):
                return given_peak if options.get("bounds") == "peak" else base

        return genuine(**options) if options.get("gamma") == PRINTED_GAMMA else Known()

    few = partial(module.generate_c, vectors=100)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "BoundedErrorUIO", method)
        patch.setattr(module, "generate_c", few)
        yield quadruple_tank


@pytest.fixture(scope="module")
def study(quick, tmp_path_factory):
    said = []
    found = quick(
        tmp_path_factory.mktemp("study") / "out",
        steps=300,
        seeds=1,
        progress=lambda stage, done: said.append(done),
    )
    assert said == sorted(said)
    assert (said[0], said[-1]) == (0.0, 1.0)
    return found


@pytest.mark.long
def test_the_study_leaves_a_complete_folder(study):
    folder = study.folder
    present = {path.name for path in folder.iterdir()}
    assert present == {"report.html", "design.json", "design_ellipsoid.json", "c", "manifest.json"}
    assert list(folder.parent.iterdir()) == [folder]
    assert study.project.folder == folder / "c"
    assert (study.project.folder / "manifest.json").is_file()
    manifest = json.loads((folder / "manifest.json").read_text())
    assert {"report.html", "c/manifest.json"} <= set(manifest["files"])
    import obsynth as ob

    for name in ("design.json", "design_ellipsoid.json"):
        assert ob.load(folder / name).certificate.valid


@pytest.mark.long
def test_tables_and_page_say_what_the_paper_prints_and_what_holds(study):
    text = "\n".join(str(table) for table in study.tables())
    page = (study.folder / "report.html").read_text(encoding="utf-8")
    for expected in (
        "[−0.014459, 0.005041]",
        "too narrow",
        "infeasible for every γ and gain",
        "100 %",
        "-std=c99",
    ):
        assert expected in text, expected
        assert expected in page, expected
    assert "largest feasible value of the direct LMI, 0.00903" in text
    assert "both depend on h3 only" in text
    assert "e-17" not in text
    assert "http:" not in page
    assert "https:" not in page
    for expected in (
        "What the paper prints, and what holds",
        "E W1 is no product",
        "e_0 = (5.0, 5.0, −25.0, 5.0)",
    ):
        assert expected in page, expected


@pytest.mark.long
def test_highlights_come_from_the_results(study):
    shown = study.highlights()
    assert shown["vertices in place of 64"] == "16"
    claims = len(study.designs[ELLIPSOID].certificate.claims)
    claims += len(study.designs[PEAK].certificate.claims)
    assert shown["claims proved"] == f"{claims} of {claims}"
    assert shown["sum of guaranteed half widths"] == "21.80 → 3.70"
    assert shown["of all instants inside"] == "100 %"
    assert shown["C steps equal to the last bit"] == "100"


@pytest.mark.long
def test_a_run_that_fails_or_is_interrupted_leaves_the_folder_as_it_was(quick, tmp_path):
    target = tmp_path / "out"
    with complete_folder(target, RUN) as place:
        (place / "report.html").write_text("an earlier run")

    def interrupt(stage, done):
        if stage == "writing the report":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        quick(target, steps=20, seeds=1, progress=interrupt)
    assert (target / "report.html").read_text() == "an earlier run"
    assert list(tmp_path.iterdir()) == [target]


def test_a_folder_with_anything_else_is_refused_before_the_work(quick, tmp_path):
    target = tmp_path / "thesis"
    target.mkdir()
    (target / "chapter.tex").write_text("")
    with pytest.raises(FolderError, match=r"did not write \(chapter\.tex\)") as error:
        quick(target)
    assert error.value.files == ("chapter.tex",)
    (tmp_path / "file").write_text("")
    with pytest.raises(FolderError, match="is a file"):
        check_target(tmp_path / "file", RUN)


def test_a_later_run_replaces_what_an_earlier_one_wrote_and_nothing_else(tmp_path):
    target = tmp_path / "out"
    for text in ("first", "second"):
        with complete_folder(target, RUN) as place:
            (place / "c").mkdir()
            (place / "c" / "a.c").write_text(text)
    assert (target / "c" / "a.c").read_text() == "second"
    (target / "notes.txt").write_text("mine")
    with pytest.raises(FolderError, match="notes"), complete_folder(target, RUN):
        pass
    assert (target / "notes.txt").read_text() == "mine"
    (target / "notes.txt").unlink()
    with pytest.raises(FolderError, match="late"), complete_folder(target, RUN):
        (target / "late.txt").write_text("came while the run was on")
    assert (target / "late.txt").exists()
    assert list(tmp_path.iterdir()) == [target]


def test_steps_and_seeds_are_checked_before_the_work(tmp_path):
    for options in ({"steps": 0}, {"steps": 6000}):
        with pytest.raises(SimulationError, match="the paper's scenarios have 1 to 5000 steps"):
            quadruple_tank(tmp_path / "out", **options)
    with pytest.raises(SimulationError, match="at least one noise seed"):
        quadruple_tank(tmp_path / "out", seeds=0)
    assert list(tmp_path.iterdir()) == []


def test_a_shortened_scenario_is_the_beginning_of_the_whole_one():
    from obsynth.symbolic import scenarios

    whole, short = scenarios.quadruple_tank("FS2"), shortened("FS2", 1500)
    assert short.steps == 1500
    assert (short.faults == whole.faults[:1501]).all()
    assert (short.inputs == whole.inputs[:1501]).all()
