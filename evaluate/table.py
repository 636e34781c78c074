"""A small table that the report, the command line and notebooks print alike."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from obsynth.evaluate.errors import ReportError


def text(value: Any, digits: int = 4) -> str:
    """Write a value for people: numbers to `digits` significant digits, yes/no, a dash for None."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    if isinstance(value, int):
        return str(value).replace("-", "−")
    try:
        number = float(value)
    except (TypeError, ValueError):
        return str(value)
    if math.isnan(number):
        return "no number"
    if math.isinf(number):
        return "∞" if number > 0 else "−∞"
    return f"{number + 0.0:.{digits}g}".replace("-", "−")


@dataclass(frozen=True)
class Table:
    """Rows under column heads, with a title and a sentence that says what to see.

    Parameters
    ----------
    title : str
    columns : sequence of str
    rows : sequence of sequences
        Cells are strings, numbers, booleans or None.
    note : str
        What the table shows or why; printed below it.
    marked : sequence of int
        Rows set in bold: the ones to look at first.

    Raises
    ------
    ReportError
        If a row does not have one cell for each column.

    Examples
    --------
    >>> table = Table("Vertices", ["set", "count"], [["entrywise", 64], ["exact", 16]])
    >>> print(table)
    Vertices
    set        count
    entrywise     64
    exact         16
    """

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    note: str = ""
    marked: Sequence[int] = ()

    def __post_init__(self) -> None:
        for i, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ReportError(
                    f"row {i} of table {self.title!r} has {len(row)} cells for "
                    f"{len(self.columns)} columns.",
                    row=i,
                )

    def cells(self) -> list[list[str]]:
        """Return all cells as text."""
        return [[text(cell) for cell in row] for row in self.rows]

    def numeric(self) -> list[bool]:
        """Return which columns hold numbers, percentages or "n/a" only, and are set flush right."""
        return [
            bool(self.rows) and all(_is_number(row[j]) for row in self.rows)
            for j in range(len(self.columns))
        ]

    def __str__(self) -> str:
        rows = [list(self.columns), *self.cells()]
        widths = [max(len(row[j]) for row in rows) for j in range(len(self.columns))]
        right = self.numeric()
        lines = [
            "  ".join(
                cell.rjust(width) if flush else cell.ljust(width)
                for cell, width, flush in zip(row, widths, right, strict=True)
            ).rstrip()
            for row in rows
        ]
        return "\n".join([self.title, *lines, *([self.note] if self.note else [])])

    def _repr_html_(self) -> str:
        # Notebooks set every cell flush right unless the cell itself says otherwise.
        right = [
            ' class="number" style="text-align:right"' if flush else ' style="text-align:left"'
            for flush in self.numeric()
        ]
        head = "".join(
            f'<th scope="col"{kind}>{html.escape(column)}</th>'
            for column, kind in zip(self.columns, right, strict=True)
        )
        body = []
        for i, row in enumerate(self.cells()):
            # narrow pages set the cells of a row below each other, each with its column's head
            cells = "".join(
                f'<td{kind} data-head="{html.escape(head)}"{" data-none" if cell == "–" else ""}>'
                f"{html.escape(cell)}</td>"
                for cell, kind, head in zip(row, right, self.columns, strict=True)
            )
            body.append(
                f'<tr class="marked">{cells}</tr>' if i in self.marked else f"<tr>{cells}</tr>"
            )
        note = f'<p class="note">{html.escape(self.note)}</p>' if self.note else ""
        title = f'<caption style="text-align:left">{html.escape(self.title)}</caption>'
        return (
            f'<div class="table{" wide" * (len(self.columns) > 8)}"><table>{title}'
            f"<thead><tr>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>{note}</div>"
        )


def _is_number(cell: Any) -> bool:
    if cell is None or cell == "n/a":
        return True
    if isinstance(cell, bool):
        return False
    if isinstance(cell, str):
        cell = cell.removesuffix(" %").replace("−", "-")
    try:
        float(cell)
    except (TypeError, ValueError):
        return False
    return True
