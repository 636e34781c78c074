"""The command ``obsynth``: run a study from equations to C, prove a saved design again."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from obsynth import __version__

if TYPE_CHECKING:
    from obsynth.evaluate import Table
    from obsynth.symbolic import Plant

STUDIES = ("quadruple-tank",)

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="From a plant's equations to a proven fault-estimating observer in C.",
)

PlantGiven = Annotated[
    str, typer.Argument(help="A name in obsynth.plants, a text file (TOML) or a JSON file.")
]
StudyFile = Annotated[
    Path, typer.Argument(help="A plant as text with [design], [scenario], [record]: a TOML file.")
]
RecordFile = Annotated[Path, typer.Argument(help="What was measured: a CSV or Parquet file.")]
MapOption = Annotated[
    list[str] | None,
    typer.Option("--map", help="SIGNAL=COLUMN[,SCALE[,OFFSET]], for each that needs it."),
]
TimeOption = Annotated[str | None, typer.Option("--time", help="Column of the time.")]
FromOption = Annotated[int, typer.Option("--from", help="First instant, from 0.", min=0)]
ToOption = Annotated[int | None, typer.Option("--to", help="Instant before which to end.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, not a table.")]


def main() -> None:
    """Run the command line; refusals are sentences on stderr and exit code 1."""
    # Threads of the linear algebra cost more than they give on matrices of twenty rows; this has
    # to stand in the environment before NumPy is loaded.
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    app()


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"obsynth {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """From a plant's equations to a proven fault-estimating observer in C."""


@app.command()
def run(
    study: Annotated[str, typer.Argument(help=f"One of: {', '.join(STUDIES)}.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the result; out/STUDY by default.")
    ] = None,
    steps: Annotated[int, typer.Option(help="Simulated samples, at most 5000.", min=1)] = 5000,
    seeds: Annotated[int, typer.Option(help="Noise seeds for each scenario.", min=1)] = 3,
) -> None:
    """Derive, design, prove, simulate, write C and report; leave a folder with all of it."""
    if study not in STUDIES:
        _refuse(f"there is no study {study!r}; there is {', '.join(STUDIES)}.")
    folder = Path("out", study) if out is None else out
    with _refusals():
        from obsynth.codegen.folder import check_target
        from obsynth.evaluate.progress import bar
        from obsynth.evaluate.studies import RUN, quadruple_tank

        check_target(folder, RUN)
        start = time.perf_counter()
        with bar() as advance:
            found = quadruple_tank(folder, steps=steps, seeds=seeds, progress=advance)
    console = _console()
    for table in found.tables():
        console.print(_rich(table))
        console.print()
    seconds = time.perf_counter() - start
    console.print(f"{folder}/ holds report.html, design.json, design_ellipsoid.json, c/")
    console.print(f"finished in {seconds:.0f} s")
    if found.coverage < 1.0:
        _refuse("a guaranteed interval was violated; see the coverage table.")


@app.command()
def check(
    design: Annotated[Path, typer.Argument(help="A design saved by obsynth, a JSON file.")],
) -> None:
    """Prove a saved design again, from the file alone and without a solver."""
    if not design.is_file():
        _refuse(f"there is no file {str(design)!r}.")
    with _refusals():
        from obsynth.designs import load
        from obsynth.evaluate import Table
        from obsynth.evaluate.progress import bar

        with bar() as advance:
            advance("reading the design and proving its LMIs", 0.0)
            observer = load(design)
            advance("deriving the bounds again and proving every claim", 0.3)
            certificate = observer.certificate.check()
            advance("done", 1.0)
    rows = [[claim.statement, claim.margin, claim.proof] for claim in certificate]
    title = f"{design.name}: {observer.method} for {observer.model.name}, every claim proved again"
    console = _console()
    console.print(_rich(Table(title, ["claim", "margin", "proof"], rows)))
    console.print(str(observer.guarantee), markup=False, highlight=False)


@app.command()
def new(
    file: Annotated[Path, typer.Argument(help="Text file to write, a TOML file.")],
    like: Annotated[
        str | None, typer.Option(help="Plant of obsynth.plants to begin from; else a small tank.")
    ] = None,
) -> None:
    """Write the text of a plant, with comments, to be edited into one's own."""
    if file.exists():
        _refuse(f"{str(file)!r} is there already.")
    with _refusals():
        from importlib.resources import files

        from obsynth.symbolic import plants

        name = "a new plant" if like is None else like
        folder = files("obsynth.symbolic")
        text = folder / ("new_plant.toml" if like is None else f"plants/{like}.toml")
        if not text.is_file():
            written = [
                name for name in plants.__all__ if (folder / f"plants/{name}.toml").is_file()
            ]
            _refuse(f"{name} is no plant with a text; there are {', '.join(written)}.")
        file.write_text(text.read_text(encoding="utf-8"), encoding="utf-8")
    print(f"{file} holds a plant; edit it, then: obsynth choose {file}")


@app.command()
def analyse(plant: PlantGiven, as_json: JsonOption = False) -> None:
    """Report what can be seen and told apart; exit 1 if a condition fails."""
    with _refusals():
        import json

        import obsynth

        found = obsynth.analyse(_plant(plant))
    if as_json:
        lines = [{"title": n.title, "holds": n.passed, "text": n.text} for n in found.checks]
        print(json.dumps(lines, indent=1))
    else:
        print(found)
    if not found.passed:
        raise typer.Exit(code=1)


@app.command()
def design(
    study: StudyFile,
    out: Annotated[Path | None, typer.Option(help="File to write, JSON.")] = None,
) -> None:
    """Design and prove the observer of a study; print its certificate and guarantee."""
    with _refusals():
        import obsynth

        observer = obsynth.read_study(study).observer
        if out is not None:
            observer.save(out)
    print(observer, observer.guarantee, sep="\n")


@app.command()
def simulate(
    study: StudyFile,
    seeds: Annotated[int, typer.Option(help="Runs, with seeds from that of the file.", min=1)] = 1,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
) -> None:
    """Run the observer of a study through its scenario; exit 1 if a guaranteed interval fails."""
    with _refusals():
        import obsynth

        told = obsynth.read_study(study)
        observer, first = told.observer, told.seed
        runs = [
            obsynth.simulate(observer.model, observer, told.scenario, seed=seed)
            for seed in range(first, first + seeds)
        ]
        if report is not None:
            obsynth.report(report, observer, runs)
    _console().print(_rich(obsynth.coverage_table({observer.method: runs})))
    if any(run.coverage[name] < 1.0 for run in runs for name in run.bounded):
        _refuse("a guaranteed interval was violated; see the table.")


@app.command()
def export(
    design: Annotated[Path, typer.Argument(help="A design saved by obsynth, a JSON file.")],
    target: Annotated[Path, typer.Argument(help="A file NAME.fmu, or a folder for C.")],
    name: Annotated[str | None, typer.Option(help="Prefix of C names, model identifier.")] = None,
    backend: Annotated[str, typer.Option(help="Who writes the step: tape or casadi.")] = "tape",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an older one.")] = False,
) -> None:
    """Write a saved observer as a unit for co-simulation (FMI 2.0) or as a C project."""
    with _refusals():
        import obsynth

        write: Any = obsynth.generate_fmu if target.suffix == ".fmu" else obsynth.generate_c
        observer = obsynth.load(design)
        print(write(observer, target, name, backend=backend, overwrite=overwrite))


@app.command()
def choose(
    plant: PlantGiven,
    ts: Annotated[
        float | None, typer.Option(help="Sample time in s, for continuous plants.", min=0)
    ] = None,
    budget: Annotated[int | None, typer.Option(help="Operations a step may take.", min=1)] = None,
    criterion: Annotated[str, typer.Option(help="faults, states, all, or a name.")] = "faults",
    limit: Annotated[float, typer.Option(help="Seconds for each method.", min=0)] = 60.0,
) -> None:
    """Try every method on a plant, compare and recommend one; exit 1 if there is none."""
    with _refusals():
        import obsynth

        given = _plant(plant)
        choice = obsynth.choose(given, budget=budget, criterion=criterion, Ts=ts, limit=limit)
    console = _console()
    for table in (choice.table, choice.widths):
        console.print(_rich(table))
        console.print()
    if choice.recommended is None:
        _refuse(choice.reason)


@app.command()
def estimate(
    design: Annotated[Path, typer.Argument(help="A design saved by obsynth, a JSON file.")],
    record: RecordFile,
    mapping: MapOption = None,
    time_column: TimeOption = None,
    first: FromOption = 0,
    until: ToOption = None,
    guess: Annotated[str | None, typer.Option(help="First state, numbers with commas.")] = None,
    window: Annotated[
        list[int] | None, typer.Option(help="Instants for means of the faults.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File to write, .csv or .parquet.")] = None,
    report: Annotated[Path | None, typer.Option(help="HTML page to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a saved observer over a record; exit 3 if the record refutes its assumptions."""
    with _refusals():
        import json

        import obsynth

        observer = obsynth.load(design)
        columns = dict(map(_column, mapping or ()))
        given = obsynth.read_record(record, observer.model, columns, time_column)
        state = None if guess is None else _numbers("--guess", guess.split(","))
        told = obsynth.estimate(observer, given[first:until], guess=state, windows=window or ())
        if out is not None:
            told.write(out)
        if report is not None:
            told.report(report)
    if as_json:
        print(json.dumps(told.to_dict(), indent=1))
    else:
        _console().print(_rich(told.summary()))
    if told.refuted is not None:
        print(f"obsynth: {told.refuted}", file=sys.stderr)
        raise typer.Exit(code=3)


@app.command()
def bounds(
    plant: PlantGiven,
    record: RecordFile,
    mapping: MapOption = None,
    time_column: TimeOption = None,
    first: FromOption = 0,
    until: ToOption = None,
    free: Annotated[
        list[str] | None,
        typer.Option(
            help="SIGNAL or PARAMETER=LOWER:UPPER; the others are held. Default: signals."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Find the least bounds that explain a record; exit 3 if it refutes the declared ones."""
    with _refusals():
        import json

        import obsynth
        from obsynth.evaluate.progress import bar

        model = _plant(plant)
        given = obsynth.read_record(record, model, dict(map(_column, mapping or ())), time_column)
        ranges = None if free is None else dict(map(_free, free))
        with bar() as advance:
            found = obsynth.least_bounds(model, given[first:until], ranges, progress=advance)
            refuted = found.refuted
    if as_json:
        print(json.dumps(found.to_dict(), indent=1))
    else:
        _console().print(_rich(found.table()))
    if refuted:
        print("obsynth: the record refutes the declared bounds.", file=sys.stderr)
        raise typer.Exit(code=3)


def _free(text: str) -> tuple[str, Any]:
    """Read SIGNAL, or PARAMETER=LOWER:UPPER."""
    name, mark, told = text.partition("=")
    ends = tuple(_numbers("--free", told.split(":"))) if mark else None
    if ends is not None and len(ends) != 2:
        _refuse(f"--free {text!r} is not PARAMETER=LOWER:UPPER.")
    return name, ends


def _column(text: str) -> tuple[str, Any]:
    """Read SIGNAL=COLUMN[,SCALE[,OFFSET]]; without a column an output was not measured."""
    signal, mark, told = text.partition("=")
    if not mark:
        _refuse(f"--map {text!r} is not SIGNAL=COLUMN.")
    name, *numbers = told.split(",")
    return signal, (name, *_numbers("--map", numbers)) if numbers else name or None


def _numbers(option: str, given: list[str]) -> list[float]:
    try:
        return [float(number) for number in given]
    except ValueError as error:
        _refuse(f"{option}: {error}.")


def _plant(given: str) -> Plant:
    """Return a plant by its name, or from the file of a plant or of a design."""
    import json

    from obsynth import Plant, plants, read_plant

    if given in plants.__all__:
        try:
            found: Plant = getattr(plants, given)()
            return found
        except TypeError as error:
            _refuse(f"{given} is made in Python ({error}); give a file of what to_dict returns.")
    if not Path(given).is_file():
        _refuse(f"there is no plant and no file {given!r}; plants are {', '.join(plants.__all__)}.")
    if given.endswith(".toml"):
        return read_plant(given)
    try:
        data = json.loads(Path(given).read_text())
    except ValueError as error:
        _refuse(f"{given!r} is no JSON file: {error}.")
    return Plant.from_dict(data.get("plant", data) if isinstance(data, dict) else data)


def _console(stderr: bool = False) -> Any:
    from rich.console import Console

    console = Console(stderr=stderr, highlight=False)
    # Redirected output has no width of its own; tables should not be folded to 80 columns there.
    return console if console.is_terminal else Console(stderr=stderr, highlight=False, width=140)


def _rich(table: Table) -> Any:
    """Turn a table into one of Rich's; the note stands below."""
    from rich import box
    from rich.table import Table as RichTable
    from rich.text import Text

    shown = RichTable(
        title=Text(table.title, style="bold"),
        title_justify="left",
        caption=Text(table.note) if table.note else None,
        caption_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        show_header=any(table.columns),
    )
    for head, flush in zip(table.columns, table.numeric(), strict=True):
        shown.add_column(Text(head), justify="right" if flush else "left", overflow="fold")
    for i, row in enumerate(table.cells()):
        style = "bold" if i in table.marked else ""
        shown.add_row(*(Text(cell) for cell in row), style=style)
    return shown


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn refusals into one sentence and an exit code; anything else keeps its traceback."""
    from obsynth.symbolic.errors import ObsynthError

    try:
        yield
    except ObsynthError as error:
        _refuse(str(error))
    except OSError as error:
        _refuse(f"{error.strerror}: {error.filename}")


def _refuse(message: str) -> NoReturn:
    print(f"obsynth: {message}", file=sys.stderr)
    raise typer.Exit(code=1)
