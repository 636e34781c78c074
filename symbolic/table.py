"""A small table that the report, the command line and notebooks print alike."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from obsynth.symbolic.errors import ObsynthError
from obsynth.symbolic.shown import Shown


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


@dataclass(frozen=True, repr=False)
class Table(Shown):
    """Rows under column heads, with a title and a sentence that says what to see.

    Parameters
    ----------
    title : str
        Left out where it is empty.
    columns : sequence of str
        All empty where the rows say themselves what they are.
    rows : sequence of sequences
        Cells are strings, numbers, booleans or None.
    note : str
        What the table shows or why; printed below it.
    marked : sequence of int
        Rows set in bold: the ones to look at first.

    Raises
    ------
    ObsynthError
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
                raise ObsynthError(
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
        heads = [list(self.columns)] if any(self.columns) else []
        rows = [*heads, *self.cells()]
        widths = [max(len(row[j]) for row in rows) for j in range(len(self.columns) if rows else 0)]
        right = self.numeric()
        lines = [
            "  ".join(
                cell.rjust(width) if flush else cell.ljust(width)
                for cell, width, flush in zip(row, widths, right, strict=True)
            ).rstrip()
            for row in rows
        ]
        return "\n".join([*filter(None, [self.title]), *lines, *filter(None, [self.note])])

    def _repr_html_(self) -> str:
        # Notebooks set every cell flush right unless the cell itself says otherwise.
        right = [
            ' class="number" style="text-align:right"' if flush else ' style="text-align:left"'
            for flush in self.numeric()
        ]
        head = "".join(
            f'<th scope="col"{kind}>{escape(column)}</th>'
            for column, kind in zip(self.columns, right, strict=True)
        )
        head = f"<thead><tr>{head}</tr></thead>" if any(self.columns) else ""
        body = []
        for i, row in enumerate(self.cells()):
            # narrow pages set the cells of a row below each other, each with its column's head
            names = [f' data-head="{escape(column)}"' if head else "" for column in self.columns]
            cells = "".join(
                f"<td{kind}{name}{' data-none' if cell in ('–', '') else ''}>"
                f"{escape(cell).replace(chr(10), '<br>')}</td>"
                for cell, kind, name in zip(row, right, names, strict=True)
            )
            mark = ' class="marked"' if i in self.marked else ""
            body.append(f"<tr{mark}>{cells}</tr>")
        note = f'<p class="note">{escape(self.note)}</p>' if self.note else ""
        title = escape(self.title)
        title = title and f'<caption style="text-align:left">{title}</caption>'
        return (
            f'<div class="table{" wide" * (len(self.columns) > 8)}"><table>{title}'
            f"{head}<tbody>{''.join(body)}</tbody></table>{note}</div>"
        )


class Tabled(Shown):
    """What shows itself as one table."""

    def table(self) -> Table:
        """Return the table."""
        raise NotImplementedError

    def __str__(self) -> str:
        return str(self.table())

    def _repr_html_(self) -> str:
        return self.table()._repr_html_()


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
