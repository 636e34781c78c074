"""Plants in notebooks: equations in LaTeX, signals in a table."""

import html
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import sympy as sp

from obsynth.symbolic.signals import Signal

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


def aligned(rows: Iterable[str]) -> str:
    """Return rows with an & before their relation as one LaTeX environment."""
    return "\\begin{aligned}\n" + " \\\\\n".join(rows) + "\n\\end{aligned}"


def html_table(heads: Sequence[str], rows: Iterable[Iterable[str]], caption: str = "") -> str:
    """Return an HTML table of plain text, without heads or caption where there are none."""
    title = f"<caption>{html.escape(caption)}</caption>" if caption else ""
    head = "".join(f"<th>{html.escape(cell)}</th>" for cell in heads)
    lines = [head] if heads else []
    lines += ["".join(f"<td>{html.escape(cell)}</td>" for cell in row) for row in rows]
    lines = [f"<tr>{line}</tr>".replace("\n", "<br>") for line in lines]
    return f"<table>{title}{''.join(lines)}</table>"


def html_lines(shown: object) -> str:
    """Return what is printed of an object as a table: its first line above, the others in rows."""
    title, *lines = str(shown).splitlines()
    return html_table((), ([line.strip()] for line in lines), title)


def plant_latex(plant: "Plant") -> str:
    r"""Return the equations of a plant, faults inserted, as one LaTeX environment."""
    # A Runge-Kutta step written out fills pages; its derivatives say the same.
    original = plant.continuous
    if original is not None and plant.discretisation != "euler":
        step = sp.latex(plant.exact_Ts)
        note = rf"\text{{{plant.discretisation}, }} T_s &= {step}\,\mathrm{{s}}"
        inner = plant_latex(original).removeprefix("\\begin{aligned}\n")
        return f"\\begin{{aligned}}\n{note} \\\\\n{inner}"
    rows = []
    if plant.has_dynamics:
        for signal, row in zip(plant.x, plant.rhs, strict=True):
            name = sp.latex(signal.symbol)
            left = rf"\dot{{{_base(name)}}}{_index(name)}" if plant.Ts is None else rf"{name}^{{+}}"
            rows.append(f"{left} &= {sp.latex(row)}")
    if plant.has_outputs:
        for name, row in zip(plant.output_names, plant.output, strict=True):
            rows.append(f"{sp.latex(sp.Symbol(name))} &= {sp.latex(row)}")
    return aligned(rows)


def plant_html(plant: "Plant") -> str:
    """Return equations and a table of signals for a notebook."""
    time = "continuous time" if plant.Ts is None else f"sampled every {plant.Ts:g} s"
    method = f", {plant.discretisation}" if plant.discretisation else ""
    heads = ("signal", "role", "range", "nominal", "rate", "unit")
    rows = [_cells(signal) for signal in plant.signals]
    rest = {signal.name for signal in plant.remainder or ()}
    word = f"what a step of {plant.discretisation} leaves out"
    rows = [(row[0], word, *row[2:]) if row[0] in rest else row for row in rows]
    sensors = zip(plant.output_names, plant.output_ranges, plant.output_units, strict=True)
    rows += [(name, "output", _span(*ends), "", "", unit) for name, ends, unit in sensors]
    return (
        f"<p><b>{html.escape(plant.name)}</b>, {time}{method}</p>"
        f"<div>$${html.escape(plant_latex(plant), quote=False)}$$</div>{html_table(heads, rows)}"
    )


def _cells(signal: Signal) -> tuple[str, ...]:
    role = f"{signal.role} of {signal.of}" if signal.of else str(signal.role)
    role += "" if signal.measured else ", not measured"
    if signal.value is not None and signal.lower == signal.upper:
        span = sp.sstr(signal.value, full_prec=False)
    else:
        span = _span(signal.lower, signal.upper)
    nominal = "" if signal.nominal is None else f"{signal.nominal:g}"
    rate = "" if signal.rate is None else f"{signal.rate:g}"
    return signal.name, role, span, nominal, rate, signal.unit


def _span(lower: float, upper: float) -> str:
    return "unbounded" if lower == -upper == -math.inf else f"[{lower:g}, {upper:g}]"


def _base(name: str) -> str:
    return name.split("_{", 1)[0]


def _index(name: str) -> str:
    return name.removeprefix(_base(name))
