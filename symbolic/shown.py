"""How objects show themselves: a line as repr, in notebooks a card, whose text is escaped here."""

import math
from collections.abc import Iterable, Mapping
from html import escape
from typing import Any


class Html(str):
    """What is HTML already."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return str(self)


def card(title: str, *parts: Any) -> Html:
    """Return a title with text, lists of lines and what has a form of its own below it.

    Empty parts are left out.
    """
    head = f"<p><b>{escape(title)}</b></p>" if title else ""
    return Html(head + "".join(map(_part, parts)))


def folded(title: str, *parts: Any) -> Html:
    """Return a card of which only the title is seen until someone asks for more."""
    return Html(f"<details><summary>{escape(title)}</summary>{card('', *parts)}</details>")


def formulas(latex: str) -> Html:
    """Return LaTeX in its dollars as a part of a card."""
    return Html(f"<div>{escape(latex, quote=False)}</div>")


def aligned(rows: Iterable[str]) -> str:
    """Return rows of LaTeX, each with an & before its relation, as one displayed environment."""
    return "$$\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}$$"


def _part(part: Any) -> str:
    if hasattr(part, "_repr_html_"):
        return str(part._repr_html_())
    if isinstance(part, str):
        return f"<p>{escape(part)}</p>" if part else ""
    items = "".join(f"<li>{escape(str(line))}</li>" for line in part)
    return f"<ul>{items}</ul>" if items else ""


def plain(value: Any) -> Any:
    """Return what JSON has; numbers that are none, or not finite, become null."""
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "columns") and hasattr(value, "rows"):
        rows = [dict(zip(value.columns, row, strict=True)) for row in value.rows]
        return {"title": value.title, "rows": plain(rows)}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    return str(value)


class Shown:
    """What prints as lines: the first of them is its repr, and a card holds them all."""

    def __repr__(self) -> str:
        first, *_ = str(self).splitlines()
        kind = type(self).__name__
        told = first.replace(" ", "").lower().startswith(kind.lower())
        return f"<{first}>" if told else f"<{kind}: {first}>"

    def _repr_html_(self) -> str:
        first, *lines = str(self).splitlines()
        return card(first, [line.strip() for line in lines])
