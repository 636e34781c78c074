"""Commands about observers: design, check, export, simulate, campaign, report, run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from obsynth.commands.given import DesignFile, ReportOption, StudyFile, design_of
from obsynth.commands.told import Told, command, refuse

if TYPE_CHECKING:
    from obsynth.designs import Observer
    from obsynth.evaluate import Run, Study
    from obsynth.symbolic import Scenario

STUDIES = ("quadruple-tank",)

app = typer.Typer()


@command(app, "design", "tank.toml --out design.json")
def design(
    study: StudyFile,
    out: Annotated[Path | None, typer.Option(help="File to write, JSON.")] = None,
) -> Told:
    """Design and prove the observer of a study; print its certificate and guarantee."""
    observer = _designed(_study(study))
    if out is not None:
        observer.save(out)
    return _observer(observer, observer.certificate, str(observer), out)


@command(app, "check", "design.json")
def check(design: DesignFile) -> Told:
    """Prove a saved design again, from the file alone and without a solver."""
    from obsynth.evaluate.progress import bar
    from obsynth.symbolic import Table

    observer = design_of(design)
    with bar() as say:
        say("deriving the bounds again and proving every claim")
        certificate = observer.certificate.check()
    rows = [[claim.statement, claim.margin, claim.proof] for claim in certificate]
    title = f"{design.name}: {observer.method} for {observer.model.name}, every claim proved again"
    return _observer(
        observer, certificate, Table(title, ["claim", "margin", "proof"], rows), design
    )


@command(app, "export", "design.json tank_c", "design.json tank.fmu")
def export(
    design: DesignFile,
    target: Annotated[Path, typer.Argument(help="A file NAME.fmu, or a folder for C.")],
    name: Annotated[str | None, typer.Option(help="Prefix of C names, model identifier.")] = None,
    backend: Annotated[str, typer.Option(help="Who writes the step: tape or casadi.")] = "tape",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an older one.")] = False,
) -> Told:
    """Write a saved observer as a unit for co-simulation (FMI 2.0) or as a C project."""
    import obsynth
    from obsynth.evaluate.progress import bar

    write: Any = obsynth.generate_fmu if target.suffix == ".fmu" else obsynth.generate_c
    observer = design_of(design)
    with bar() as say:
        say("writing, building and comparing")
        written = write(observer, target, name, backend=backend, overwrite=overwrite)
    return Told({"written": target, "said": str(written)}, (str(written),))


Seeds = Annotated[int, typer.Option(help="Runs, with seeds from that of the file.", min=1)]


@command(app, "simulate", "tank.toml --seeds 3")
def simulate(study: StudyFile, seeds: Seeds = 1, report: ReportOption = None) -> Told:
    """Run the observer of a study through its scenario; exit 1 if a guaranteed interval fails."""
    import obsynth

    told = _study(study)
    runs = _runs(_designed(told), told.scenario, told.seed, seeds)
    if report is not None:
        obsynth.report(report, told.observer, runs)
    return _simulated(told.observer, runs)


@command(app, "campaign", "tank.toml --seeds 20", "tank.toml --seeds 500 --folder runs")
def campaign(
    study: StudyFile,
    seeds: Seeds = 20,
    folder: Annotated[
        Path | None, typer.Option(help="Where rows are kept, to go on after an interruption.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes, -1: as many as cores.")] = -1,
) -> Told:
    """Run the observer of a study over many seeds; exit 1 if a guaranteed interval fails."""
    import obsynth

    told = _study(study)
    observer = _designed(told)
    found = obsynth.campaign(
        observer,
        told.scenario,
        range(told.seed, told.seed + seeds),
        folder=folder,
        workers=workers,
    )
    bounded = [k for k in found.rows[0] if k.endswith(": missed")]
    missed = sum(row[key] or 0 for row in found.rows for key in bounded if row["kept"])
    failed = f"intervals missed the truth at {missed:g} instants; see the table." if missed else ""
    return Told({"table": found.table(), "runs": found.rows}, (found.table(),), failed=failed)


@command(app, "report", "tank.toml", "design.json --out page.html")
def report(
    source: Annotated[Path, typer.Argument(help="A study (TOML) or a saved design (JSON).")],
    out: Annotated[Path, typer.Option(help="HTML page to write.")] = Path("report.html"),
    seeds: Seeds = 1,
) -> Told:
    """Write the page of a study, with its runs and its record, or of a saved design, with a run."""
    import obsynth
    from obsynth.evaluate.progress import bar

    if source.suffix == ".toml":
        told = _study(source)
        observer = _designed(told)
        runs: list[Any] = _runs(observer, told.scenario, told.seed, seeds)
        if told.record is not None:
            runs.append(obsynth.estimate(observer, told.record))
    else:
        observer = design_of(source)
        runs = _runs(observer, obsynth.scenarios.gentle(observer.model), 0, seeds)
    with bar() as say:
        obsynth.report(out, observer, runs, progress=lambda stage: say(stage[:34]))
    return Told({"file": out}, (f"{out} holds the report.",))


@command(app, "run", "quadruple-tank")
def run(
    study: Annotated[str, typer.Argument(help=f"One of: {', '.join(STUDIES)}.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the result; out/STUDY by default.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Simulated samples, at most 5000.", min=1)] = 5000,
    seeds: Annotated[int, typer.Option(help="Noise seeds for each scenario.", min=1)] = 3,
) -> Told:
    """Derive, design, prove, simulate, write C and report; leave a folder with all of it."""
    import time

    if study not in STUDIES:
        refuse(f"there is no study {study!r}; there is {', '.join(STUDIES)}.")
    folder = Path("out", study) if out is None else out
    from obsynth.codegen.folder import check_target
    from obsynth.evaluate.progress import bar
    from obsynth.evaluate.studies import RUN, quadruple_tank

    check_target(folder, RUN)
    start = time.perf_counter()
    with bar() as advance:
        found = quadruple_tank(folder, steps=steps, seeds=seeds, progress=advance)
    seconds = time.perf_counter() - start
    said = (
        f"{folder}/ holds report.html, design.json, design_ellipsoid.json, c/",
        f"finished in {seconds:.0f} s",
    )
    failed = "a guaranteed interval was violated; see the coverage table."
    return Told(
        {"folder": folder, "coverage": found.coverage, "tables": found.tables()},
        (*found.tables(), *said),
        failed=failed if found.coverage < 1.0 else "",
    )


def _study(file: Path) -> Study:
    import obsynth

    if file.suffix == ".json":
        refuse(f"{file} is no study; a study is a text file, see obsynth new.")
    return obsynth.read_study(file)


def _designed(study: Study) -> Observer:
    """Design with a bar that pulses."""
    from obsynth.evaluate.progress import bar

    with bar() as say:
        say(f"designing by {type(study.method).__name__}")
        return study.observer


def _runs(observer: Observer, scenario: Scenario, first: int, seeds: int) -> list[Run]:
    import obsynth
    from obsynth.evaluate.progress import bar

    runs = []
    with bar() as say:
        for k in range(seeds):
            say(f"run {k + 1} of {seeds}", k / seeds)
            runs.append(obsynth.simulate(observer.model, observer, scenario, seed=first + k))
    return runs


def _observer(observer: Observer, certificate: Any, head: Any, file: Path | None) -> Told:
    """Tell an observer's certificate and guarantee."""
    guarantee = observer.guarantee
    facts = {
        "method": observer.method,
        "plant": observer.model.name,
        "file": file,
        "half_widths": observer.half_widths,
        "figures": observer.figures,
        "certificate": [
            {"name": c.name, "statement": c.statement, "holds": c.holds, "margin": float(c.margin)}
            for c in certificate
        ],
        "guaranteed": guarantee.claims,
        "assumed": guarantee.assumptions,
    }
    return Told(facts, (head, str(guarantee)))


def _simulated(observer: Observer, runs: list[Run]) -> Told:
    """Tell runs by their coverage."""
    import obsynth

    facts = [
        {
            "scenario": run.scenario,
            "seed": run.seed,
            "coverage": {name: run.coverage[name] for name in run.bounded},
            "rms": run.rms(),
            "half_widths": {name: width[-1] for name, width in run.widths.items()},
            "assumptions_kept": run.kept,
            "status": {str(count.bit): count.count for count in run.domain.status},
        }
        for run in runs
    ]
    failed = ""
    for run in runs:
        missed = [name for name in run.bounded if run.coverage[name] < 1.0]
        if missed and run.kept:
            failed = "a guaranteed interval was violated; see the table."
            break
        if missed:
            left = (*run.outside, *run.domain.left, "the observer was void")[0]
            failed = (
                f"{', '.join(missed)}: not inside their intervals, but the run left what the "
                f"guarantee assumes: {left}; change the scenario or the ranges of the plant."
            )
    return Told(facts, (obsynth.coverage_table({observer.method: runs}),), failed=failed)
