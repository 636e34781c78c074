"""Figures, formulas and equations for a page, as SVG that follows its colours."""

from __future__ import annotations

import html
import io
import re
from typing import Any

import numpy as np
import sympy as sp

from obsynth.evaluate.plotting.layout import INK, SOFT
from obsynth.symbolic import Plant
from obsynth.symbolic.display import equations

# Drawn in these colours, shown in the page's own, so that dark pages have light ink.
_VARIABLES = {INK: "var(--ink)", SOFT: "var(--soft)"}

# Less than a tenth of a point is invisible and half of the page.
_LONG = re.compile(r"(\d+\.\d)\d+")

_SETTINGS = {"svg.hashsalt": "obsynth", "path.simplify": True}


def figure_svg(figure: Any, key: str, label: str) -> str:
    """Return a matplotlib figure as an inline ``<svg>`` element."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({**_SETTINGS, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    text = _inline(buffer.getvalue(), key, label)
    return re.sub(r' d="M[^"]*"', lambda match: _LONG.sub(r"\1", match[0]), text)


def colour_of(drawn: Any) -> str:
    """Return the colour of a line, a bar or an area, as a page has it."""
    from matplotlib.colors import to_hex

    part = drawn[0] if isinstance(drawn, tuple) else drawn
    given = part.get_color() if hasattr(part, "get_color") else part.get_facecolor()
    found = to_hex(given[0] if np.ndim(given) > 1 else given)
    return _VARIABLES.get(found, found)


def math_svg(latex: str, key: str, size: float = 12.0) -> str | None:
    r"""Return a formula as an inline ``<svg>`` element, or None where mathtext cannot set it."""
    import matplotlib as mpl
    from matplotlib.font_manager import FontProperties
    from matplotlib.mathtext import math_to_image

    buffer = io.BytesIO()
    font = FontProperties(size=size, math_fontfamily="cm")
    try:
        with mpl.rc_context({**_SETTINGS, "svg.fonttype": "path", "savefig.transparent": True}):
            math_to_image(f"${latex}$", buffer, prop=font, format="svg", color=INK)
    except ValueError:
        return None
    return _inline(buffer.getvalue().decode(), key, latex)


def _inline(text: str, key: str, label: str) -> str:
    """Strip what only a file of its own needs, and make ids unique in the page."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->|<style.*?</style>", "", text, flags=re.DOTALL)
    text = re.sub(r"<defs>\s*</defs>", "", text)
    text = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", text)
    text = text.replace("xlink:href", "href")
    text = re.sub(r'\bid="', f'id="{key}-', text)
    text = re.sub(r'\bhref="#', f'href="#{key}-', text)
    text = re.sub(r"url\(#", f"url(#{key}-", text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(label)}"', 1).strip()


def equations_html(plant: Plant, key: str) -> str:
    """Return dynamics and outputs as inline SVG formulas, plain text where that fails."""
    lines = []
    for i, (plain, left, row) in enumerate(equations(plant)):
        formula = math_svg(f"{left} = {sp.latex(row)}".replace(r"\frac", r"\dfrac"), f"{key}{i}")
        shown = formula or f"<code>{html.escape(f'{plain} = {row}')}</code>"
        width = re.search(r'<svg[^>]* width="([\d.]+)pt"', shown)
        natural = f' style="--natural:{width[1]}pt"' if width else ""
        lines.append(f'<div class="formula"{natural}>{shown}</div>')
    return "\n".join(lines)


def constants_html(plant: Plant) -> str:
    """List the constants in one paragraph, with exact value and unit."""
    items = []
    for signal in plant.constants:
        value = plant.constant_values[signal.symbol]
        decimal = f"{float(value):.12g}"
        unit = f" {signal.unit}".replace("^2", "²").replace("^3", "³") if signal.unit else ""
        items.append(f"<span>{html.escape(f'{signal.name} = {decimal}{unit}')}</span>")
    return f'<p class="constants">with {" ".join(items)}</p>' if items else ""
