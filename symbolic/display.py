"""Plants in notebooks: equations in LaTeX, signals in a table."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import sympy as sp

from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.shown import aligned, card, formulas
from obsynth.symbolic.signals import Signal
from obsynth.symbolic.table import Table

if TYPE_CHECKING:
    from obsynth.symbolic.plant import Plant


_DIGITS = 6
_LONG = 10**6


def short(expression: sp.Expr) -> sp.Expr:
    """Write the numbers of an expression with six digits, small integers and fractions as is."""
    if expression.is_number:
        plain = expression.is_Rational and abs(expression.p) < _LONG and expression.q < 1000
        return expression if plain else sp.Float(expression.evalf(_DIGITS), _DIGITS)
    if expression.is_Pow:
        exponent = expression.exp if expression.exp.is_Rational else short(expression.exp)
        return sp.Pow(short(expression.base), exponent, evaluate=expression.base.is_Symbol)
    if not expression.args:
        return expression
    if expression.is_Mul or expression.is_Add:
        numbers = [a for a in expression.args if a.is_number]
        rest = [short(a) for a in expression.args if not a.is_number]
        joined = [short(expression.func(*numbers))] if numbers else []
        return expression.func(*joined, *rest)
    return expression.func(*[short(a) if isinstance(a, sp.Expr) else a for a in expression.args])


def matrix_latex(matrix: FloatArray) -> str:
    """Return a matrix of numbers as LaTeX, with six digits."""
    rows = (" & ".join(f"{value:.6g}" for value in row) for row in matrix.tolist())
    return "\\begin{bmatrix}" + r" \\ ".join(rows) + "\\end{bmatrix}"


def plant_latex(plant: "Plant") -> str:
    r"""Return the equations of a plant, faults inserted, as one LaTeX display."""
    # A Runge-Kutta step written out fills pages; its derivatives say the same.
    original = plant.continuous
    if original is not None and plant.discretisation != "euler":
        step = sp.latex(plant.exact_Ts)
        note = rf"\text{{{plant.discretisation}, }} T_s &= {step}\,\mathrm{{s}}"
        return aligned([note, *_aligned(original)])
    return aligned(_aligned(plant))


def _aligned(plant: "Plant") -> list[str]:
    return [f"{left} &= {sp.latex(right)}" for _, left, right in equations(plant)]


def equations(plant: "Plant") -> list[tuple[str, str, sp.Expr]]:
    """Return the left sides of all equations, in text and in LaTeX, and the right ones."""
    rows = []
    if plant.has_dynamics:
        for signal, row in zip(plant.x, plant.rhs, strict=True):
            # the dot stands above the letter, not above letter and index
            base, mark, index = sp.latex(signal.symbol).partition("_")
            name = f"{base}{mark}{index}"
            left = rf"\dot{{{base}}}{mark}{index}" if plant.Ts is None else rf"{name}^{{+}}"
            rows.append((f"{signal.name}{chr(39) if plant.Ts is None else '+'}", left, short(row)))
    if plant.has_outputs:
        for name, row in zip(plant.output_names, plant.output, strict=True):
            rows.append((name, sp.latex(sp.Symbol(name)), short(row)))
    return rows


def plant_html(plant: "Plant") -> str:
    """Return equations and a table of signals for a notebook."""
    time = "continuous time" if plant.Ts is None else f"sampled every {plant.Ts:g} s"
    method = f", {plant.discretisation}" if plant.discretisation else ""
    title = f"{plant.name}, {time}{method}"
    return card(title, formulas(plant_latex(plant)), signals_table(plant))


def signals_table(plant: "Plant", title: str = "", without: Sequence[Signal] = ()) -> Table:
    """List every signal with its role, range, nominal value, rate and unit."""
    heads = ("signal", "role", "range", "nominal", "rate", "unit")
    rows = [_cells(signal) for signal in plant.signals if signal not in without]
    rest = {signal.name for signal in plant.remainder or ()}
    word = f"what a step of {plant.discretisation} leaves out"
    rows = [(row[0], word, *row[2:]) if row[0] in rest else row for row in rows]
    sensors = zip(plant.output_names, plant.output_ranges, plant.output_units, strict=True)
    rows += [(name, "output", _span(*ends), "", "", unit) for name, ends, unit in sensors]
    return Table(title, heads, rows)


def _cells(signal: Signal) -> tuple[str, ...]:
    role = f"{signal.role} of {signal.of}" if signal.of else str(signal.role)
    role += "" if signal.measured else ", not measured"
    if signal.value is not None and signal.lower == signal.upper:
        span = sp.sstr(short(signal.value), full_prec=False)
    else:
        span = _span(signal.lower, signal.upper)
    nominal = "" if signal.nominal is None else f"{signal.nominal:g}"
    rate = "" if signal.rate is None else f"{signal.rate:g}"
    return signal.name, role, span, nominal, rate, signal.unit


def _span(lower: float, upper: float) -> str:
    return "unbounded" if lower == -upper == -math.inf else f"[{lower:g}, {upper:g}]"
