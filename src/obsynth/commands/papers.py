"""The command papers: which printed claims hold."""

from __future__ import annotations

from typing import Annotated

import typer

from obsynth.commands.told import Told, command, refuse

app = typer.Typer()


@command(app, "papers", "hinf")
def papers(
    paper: Annotated[
        str | None,
        typer.Argument(help="bounded-error, hinf, qpv, interval, set-adaptive; all by default."),
    ] = None,
) -> Told:
    """Compute which printed claims of the five papers hold, with the numbers; about a minute."""
    from obsynth.evaluate.papers.claim import claims_table
    from obsynth.evaluate.papers.papers import PAPERS
    from obsynth.evaluate.progress import bar

    if paper is not None and paper not in PAPERS:
        refuse(f"there is no paper {paper!r}; there are {', '.join(PAPERS)}.")
    names = list(PAPERS) if paper is None else [paper]
    facts, tables = [], []
    with bar() as say:
        for i, name in enumerate(names):
            title, claims = PAPERS[name]
            say(name, i / len(names))
            found = list(claims())
            tables.append(claims_table(title, found))
            facts.append(
                {"paper": name, "title": title, "claims": [dict(vars(claim)) for claim in found]}
            )
    return Told(facts, tuple(tables))
