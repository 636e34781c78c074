"""What commands are given: plants, designs, columns of records, numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from obsynth.commands.told import refuse

if TYPE_CHECKING:
    from obsynth.designs import Observer
    from obsynth.symbolic import Plant

PlantGiven = Annotated[
    str, typer.Argument(help="A name in obsynth.plants, a text file (TOML) or a JSON file.")
]
StudyFile = Annotated[
    Path, typer.Argument(help="A plant as text with [design], [scenario], [record]: a TOML file.")
]
DesignFile = Annotated[Path, typer.Argument(help="A design saved by obsynth, a JSON file.")]
RecordFile = Annotated[Path, typer.Argument(help="What was measured: a CSV or Parquet file.")]
MapOption = Annotated[
    list[str] | None,
    typer.Option("--map", help="SIGNAL=COLUMN[,SCALE[,OFFSET]], for each that needs it."),
]
TimeOption = Annotated[str | None, typer.Option("--time", help="Column of the time.")]
FromOption = Annotated[int, typer.Option("--from", help="First instant, from 0.", min=0)]
ToOption = Annotated[int | None, typer.Option("--to", help="Instant before which to end.")]
ReportOption = Annotated[Path | None, typer.Option("--report", help="HTML page to write.")]


def plant_of(given: str) -> Plant:
    """Return a plant by its name, or from the file of a plant or of a design."""
    from obsynth import Plant, plants, read_plant

    if given in plants.__all__:
        try:
            found: Plant = getattr(plants, given)()
            return found
        except TypeError as error:
            refuse(f"{given} is made in Python ({error}); give a file of what to_dict returns.")
    if not Path(given).is_file():
        refuse(f"there is no plant and no file {given!r}; plants are {', '.join(plants.__all__)}.")
    if given.endswith(".toml"):
        return read_plant(given)
    try:
        data = json.loads(Path(given).read_text())
    except ValueError as error:
        refuse(f"{given!r} is no JSON file: {error}.")
    return Plant.from_dict(data.get("plant", data) if isinstance(data, dict) else data)


def design_of(file: Path) -> Observer:
    """Load a saved design, which proves its inequalities again."""
    import obsynth
    from obsynth.evaluate.progress import bar

    if not file.is_file():
        refuse(f"there is no file {str(file)!r}.")
    if file.suffix == ".toml":
        refuse(f"{file} is the text of a plant: obsynth design {file} --out design.json")
    with bar() as say:
        say("reading the design and proving it")
        observer: Observer = obsynth.load(file)
    return observer


def columns_of(mapping: list[str] | None) -> dict[str, Any]:
    """Read SIGNAL=COLUMN[,SCALE[,OFFSET]]; without a column an output was not measured."""
    return dict(map(_column, mapping or ()))


def _column(text: str) -> tuple[str, Any]:
    signal, mark, told = text.partition("=")
    if not mark:
        refuse(f"--map {text!r} is not SIGNAL=COLUMN.")
    name, *numbers = told.split(",")
    return signal, (name, *numbers_of("--map", numbers)) if numbers else name or None


def free_of(text: str) -> tuple[str, Any]:
    """Read SIGNAL, or PARAMETER=LOWER:UPPER."""
    name, mark, told = text.partition("=")
    ends = tuple(numbers_of("--free", told.split(":"))) if mark else None
    if ends is not None and len(ends) != 2:
        refuse(f"--free {text!r} is not PARAMETER=LOWER:UPPER.")
    return name, ends


def numbers_of(option: str, given: list[str]) -> list[float]:
    """Read numbers, or refuse by the name of the option."""
    try:
        return [float(number) for number in given]
    except ValueError as error:
        refuse(f"{option}: {error}.")
