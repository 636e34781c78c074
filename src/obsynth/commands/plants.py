"""Commands about plants: new, plants, analyse, choose."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from obsynth.commands.given import PlantGiven, plant_of
from obsynth.commands.told import Told, command, refuse

if TYPE_CHECKING:
    from obsynth.symbolic import Plant

app = typer.Typer()


@command(app, "new", "tank.toml", "pendulum.toml --like cart_pole")
def new(
    file: Annotated[Path, typer.Argument(help="Text file to write, a TOML file.")],
    like: Annotated[
        str | None, typer.Option(help="Plant of obsynth.plants to begin from; else a small tank.")
    ] = None,
) -> Told:
    """Write the text of a plant, with comments, to be edited into one's own."""
    from importlib.resources import files

    from obsynth.symbolic import plants

    if file.exists():
        refuse(f"{str(file)!r} is there already.")
    folder = files("obsynth.symbolic")
    text = folder / ("new_plant.toml" if like is None else f"plants/{like}.toml")
    if not text.is_file():
        written = [name for name in plants.__all__ if (folder / f"plants/{name}.toml").is_file()]
        refuse(f"{like} is no plant with a text; there are {', '.join(written)}.")
    file.write_text(text.read_text(encoding="utf-8"), encoding="utf-8")
    said = f"{file} holds a plant; edit it, then: obsynth analyse {file}"
    return Told({"file": file}, (said,))


@command(app, "plants", "")
def plants() -> Told:
    """List the plants of the gallery, their signals and the methods whose class they are of."""
    from obsynth import plants as gallery
    from obsynth.evaluate.choosing.tries import CLASSES
    from obsynth.evaluate.progress import bar
    from obsynth.symbolic import Table

    found, rows = [], []
    with bar() as say:
        for i, name in enumerate(gallery.__all__):
            say(name, i / len(gallery.__all__))
            try:
                plant = getattr(gallery, name)()
            except TypeError:
                continue  # one that takes arguments
            taken = [method for method, kind in CLASSES.items() if _takes(kind, plant)]
            counts = [len(plant.x), len(plant.output), len(plant.f), len(plant.d)]
            time = "continuous" if plant.Ts is None else f"{plant.Ts:g} s"
            rows.append([name, time, *counts, ", ".join(taken)])
            found.append(
                {
                    "name": name,
                    "Ts": plant.Ts,
                    **{word: plant.names(kind) for word, kind in _KINDS.items()},
                    "outputs": plant.output_names,
                    "methods": taken,
                }
            )
    head = ["plant", "time", "states", "outputs", "faults", "unknown inputs", "of the class of"]
    note = (
        "Continuous plants as sampled by Euler's rule where a method needs that; ranks and "
        "inequalities are not tried: obsynth analyse PLANT, obsynth choose PLANT."
    )
    return Told(found, (Table("Plants", head, rows, note=note),))


_KINDS = {"states": "x", "inputs": "u", "faults": "f", "unknown_inputs": "d", "disturbances": "w"}


def _takes(kind: Any, plant: Plant) -> bool:
    """Whether a plant is of a class, sampled where the class is in discrete time."""
    from obsynth.symbolic import ObsynthError

    try:
        given = plant
        if kind.time == "discrete" and plant.Ts is None:
            given = plant.discretise("euler", Ts=1)
        kind.check(given)
    except ObsynthError:
        return False
    return True


@command(app, "analyse", "quadruple_tank", "tank.toml --json")
def analyse(plant: PlantGiven) -> Told:
    """Report what can be seen and told apart; exit 1 if a condition fails."""
    import obsynth

    found = obsynth.analyse(plant_of(plant))
    checks = [{"title": c.title, "holds": c.passed, "text": c.text} for c in found.checks]
    failed = [c.title for c in found.checks if c.passed is False]
    said = "" if found.passed else f"not met: {', '.join(failed)}."
    return Told({"holds": found.passed, "checks": checks}, (str(found),), failed=said)


@command(app, "choose", "cruise_control --ts 0.1 --limit 20")
def choose(
    plant: PlantGiven,
    ts: Annotated[
        float | None, typer.Option(help="Sample time in s, for continuous plants.", min=0)
    ] = None,
    budget: Annotated[int | None, typer.Option(help="Operations a step may take.", min=1)] = None,
    criterion: Annotated[str, typer.Option(help="faults, states, all, or a name.")] = "faults",
    limit: Annotated[float, typer.Option(help="Seconds for all methods.", min=0)] = 60.0,
) -> Told:
    """Try every method on a plant, compare and recommend one; exit 1 if there is none."""
    import obsynth

    given = plant_of(plant)
    choice = obsynth.choose(given, budget=budget, criterion=criterion, Ts=ts, limit=limit)
    facts = {"observers": choice.table, "half_widths": choice.shares, "reason": choice.reason}
    failed = choice.reason if choice.recommended is None else ""
    return Told(facts, (choice.table, choice.widths), failed=failed)
