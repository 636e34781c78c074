"""Figures and formulas as SVG that stands inside a page and follows its colours."""

import html
import io
import re
from typing import Any

from obsynth.evaluate.plotting.style import INK, SOFT

# Drawn in these colours, shown in the page's own, so that dark pages have light ink.
_VARIABLES = {INK: "var(--ink)", SOFT: "var(--soft)"}

# A hundredth of a point is invisible and a third of the page.
_LONG = re.compile(r"(\d+\.\d\d)\d+")

_SETTINGS = {"svg.fonttype": "path", "svg.hashsalt": "obsynth", "path.simplify": True}


def figure_svg(figure: Any, key: str, label: str) -> str:
    """Return a matplotlib figure as an inline ``<svg>`` element."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context(_SETTINGS):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    return _inline(buffer.getvalue(), key, label)


def math_svg(latex: str, key: str, size: float = 12.0) -> str | None:
    r"""Return a formula as an inline ``<svg>`` element, or None where mathtext cannot set it."""
    import matplotlib as mpl
    from matplotlib.font_manager import FontProperties
    from matplotlib.mathtext import math_to_image

    buffer = io.BytesIO()
    font = FontProperties(size=size, math_fontfamily="cm")
    try:
        with mpl.rc_context({**_SETTINGS, "savefig.transparent": True}):
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
    text = re.sub(r' d="[^"]*"', lambda match: _LONG.sub(r"\1", match[0]), text)
    text = re.sub(r"\s*\n\s*", "\n", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{html.escape(label)}"', 1).strip()
