"""What a command has to tell, printed one way for all: tables and sentences, or JSON."""

from __future__ import annotations

import functools
import inspect
import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, get_type_hints

import typer

if TYPE_CHECKING:
    from obsynth.symbolic import Table

EXAMPLES: dict[str, str] = {}
"""By command, an example that runs."""

ENDS = "Exit codes: 0 done, 1 refused or bad input, 2 usage, 3 the data refute the assumptions."


@dataclass(frozen=True)
class Told:
    """What a command found.

    facts: for machines, whatever `shown.plain` takes
    shown: for people, tables and sentences
    failed, refuted: why the command ends with 1 or with 3, if it does
    """

    facts: Any
    shown: tuple[Any, ...] = ()
    failed: str = ""
    refuted: str = ""


def command(
    app: typer.Typer, name: str, *examples: str
) -> Callable[[Callable[..., Told]], Callable[..., Told]]:
    """Register a function that returns what it has to tell, with examples and ``--json``."""

    def register(function: Callable[..., Told]) -> Callable[..., Told]:
        @functools.wraps(function)
        def run(as_json: bool, **given: Any) -> None:
            with refusals():
                _end(function(**given), as_json)

        hints = get_type_hints(function, include_extras=True)
        hints["as_json"] = Annotated[bool, typer.Option("--json", help="Print JSON, not tables.")]
        signature = inspect.signature(function)
        own = [p.replace(annotation=hints[p.name]) for p in signature.parameters.values()]
        kind = inspect.Parameter.KEYWORD_ONLY
        last = inspect.Parameter("as_json", kind, default=False, annotation=hints["as_json"])
        run.__signature__ = inspect.Signature([*own, last])  # type: ignore[attr-defined]
        run.__annotations__ = hints
        EXAMPLES[name] = examples[0]
        lines = "\n\n".join(f"[dim]$[/] obsynth {name} {example}" for example in examples)
        app.command(name, epilog=f"{lines}\n\n{ENDS}")(run)
        return function

    return register


def _end(told: Told, as_json: bool) -> None:
    if as_json:
        from obsynth.symbolic.shown import plain

        print(json.dumps(plain(told.facts), indent=1, allow_nan=False))
    else:
        console = _console()
        for i, part in enumerate(told.shown):
            if isinstance(part, str):
                console.print(part, markup=False, highlight=False, soft_wrap=True)
            else:
                console.print(*([""] if i else []), _rich(part), sep="\n")
    sys.stdout.flush()
    if told.refuted:
        _say(told.refuted)
        raise typer.Exit(code=3)
    if told.failed:
        refuse(told.failed)


@contextmanager
def refusals() -> Iterator[None]:
    """Turn refusals into one sentence and an exit code; anything else keeps its traceback."""
    from obsynth.symbolic.errors import ObsynthError

    try:
        yield
    except ObsynthError as error:
        refuse(str(error))
    except BrokenPipeError:
        # whoever reads has seen enough; nothing may be written at exit either
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit from None
    except OSError as error:
        refuse(f"{error.strerror}: {error.filename}")
    except KeyboardInterrupt:
        _say("interrupted.")
        raise typer.Exit(code=1) from None


def refuse(message: str) -> NoReturn:
    """End with a sentence and exit code 1."""
    _say(message)
    raise typer.Exit(code=1)


def _say(message: str) -> None:
    print(f"obsynth: {message}", file=sys.stderr)


def _console() -> Any:
    from rich.console import Console

    console = Console(highlight=False)
    # Redirected output has no width of its own; tables should not be folded to 80 columns there.
    return console if console.is_terminal else Console(highlight=False, width=140)


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
