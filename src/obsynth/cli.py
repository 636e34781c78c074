"""The command ``obsynth``: from equations or a record to a proven observer, its C and a report."""

import os
from typing import Annotated

import typer

from obsynth import __version__
from obsynth.commands import data, designs, papers, plants
from obsynth.commands.told import ENDS

ORDER = (
    *("new", "plants", "analyse", "bounds", "choose", "design", "simulate", "estimate"),
    *("campaign", "export", "check", "report", "papers", "run"),
)
"""Commands as the help lists them, in the order in which one needs them."""

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="From a plant's equations to a proven fault-estimating observer in C.",
    epilog=f"[dim]$[/] obsynth new tank.toml\n\n[dim]$[/] obsynth report tank.toml\n\n{ENDS}",
)
for group in (plants, designs, data, papers):
    app.registered_commands += group.app.registered_commands
app.registered_commands.sort(key=lambda command: ORDER.index(str(command.name)))


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
