"""A plant's equations for a page: each row as a formula, signals and constants as tables."""

import html

import numpy as np
import sympy as sp

from obsynth.evaluate.svg import math_svg
from obsynth.evaluate.table import Table
from obsynth.symbolic import Plant

_GROUPS = ("x", "u", "d", "f", "w", "rho", "p")


def equations_html(plant: "Plant", key: str) -> str:
    """Return dynamics and outputs as inline SVG formulas, plain text where that fails."""
    rows = []
    for signal, row in zip(plant.x, plant.rhs, strict=True):
        name = sp.latex(signal.symbol)
        left = _derivative(name) if plant.Ts is None else f"{name}^+"
        rows.append((left, f"{signal.name}{chr(39) if plant.Ts is None else '+'}", row))
    for name, row in zip(plant.output_names, plant.output, strict=True):
        rows.append((sp.latex(sp.Symbol(name)), name, row))
    lines = []
    for i, (left, plain, row) in enumerate(rows):
        formula = math_svg(f"{left} = {sp.latex(row)}".replace(r"\frac", r"\dfrac"), f"{key}{i}")
        shown = formula or f"<code>{html.escape(f'{plain} = {row}')}</code>"
        lines.append(f'<div class="formula">{shown}</div>')
    return "\n".join(lines)


def signals_table(plant: "Plant") -> Table:
    """List every signal with its role, range, rate and unit."""
    rows = []
    for group in _GROUPS:
        for signal in getattr(plant, group):
            low, high = signal.lower, signal.upper
            known = np.isfinite(low) or np.isfinite(high)
            within = f"[{low:g}, {high:g}]".replace("-", "−").replace("inf", "∞")
            rows.append(
                [
                    signal.name,
                    str(signal.role) + (f" on {signal.of}" if signal.of else ""),
                    within if known else "–",
                    signal.nominal,
                    signal.rate,
                    signal.unit or "–",
                ]
            )
    return Table("Signals", ["name", "role", "range", "nominal", "rate", "unit"], rows)


def constants_html(plant: "Plant") -> str:
    """List the constants in one paragraph, with exact value and unit."""
    items = []
    for signal in plant.constants:
        value = plant.constant_values[signal.symbol]
        decimal = f"{float(value):.12g}"
        unit = f" {signal.unit}".replace("^2", "²").replace("^3", "³") if signal.unit else ""
        items.append(f"<span>{html.escape(f'{signal.name} = {decimal}{unit}')}</span>")
    return f'<p class="constants">with {" ".join(items)}</p>' if items else ""


def _derivative(name: str) -> str:
    """Set the dot above the letter, not above letter and index."""
    base, mark, index = name.partition("_")
    return rf"\dot{{{base}}}{mark}{index}"
