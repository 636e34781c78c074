"""Commands about what was measured: estimate, bounds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from obsynth.commands.given import (
    DesignFile,
    FromOption,
    MapOption,
    PlantGiven,
    RecordFile,
    ReportOption,
    TimeOption,
    ToOption,
    columns_of,
    design_of,
    free_of,
    numbers_of,
    plant_of,
)
from obsynth.commands.told import Told, command

app = typer.Typer()


@command(app, "estimate", "design.json log.csv --map y=level,0.1")
def estimate(
    design: DesignFile,
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
    report: ReportOption = None,
) -> Told:
    """Run a saved observer over a record; exit 3 if the record refutes its assumptions."""
    import obsynth
    from obsynth.evaluate.progress import bar

    observer = design_of(design)
    given = obsynth.read_record(record, observer.model, columns_of(mapping), time_column)
    state = None if guess is None else numbers_of("--guess", guess.split(","))
    with bar() as say:
        say("estimating")
        told = obsynth.estimate(observer, given[first:until], guess=state, windows=window or ())
        if out is not None:
            told.write(out)
        if report is not None:
            told.report(report)
    refuted = "" if told.refuted is None else str(told.refuted)
    return Told(told.to_dict(), (told.summary(),), refuted=refuted)


@command(app, "bounds", "tank.toml log.csv --map y=level,0.1")
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
) -> Told:
    """Find the least bounds that explain a record; exit 3 if it refutes the declared ones."""
    import obsynth
    from obsynth.evaluate.progress import bar

    model = plant_of(plant)
    given = obsynth.read_record(record, model, columns_of(mapping), time_column)
    ranges = None if free is None else dict(map(free_of, free))
    with bar() as advance:
        found = obsynth.least_bounds(model, given[first:until], ranges, progress=advance)
        refuted = found.refuted
    said = "the record refutes the declared bounds." if refuted else ""
    return Told(found.to_dict(), (found.table(),), refuted=said)
