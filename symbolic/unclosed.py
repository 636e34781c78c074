"""Brackets and quotes of a TOML text that have no end, which its reader notices lines later."""

import re

_TOKEN = re.compile(
    r"#[^\n]*"
    r'|"""(?:\\.|[^\\])*?"""|' + r"'''.*?'''"
    r'|"(?!"")(?:\\.|[^"\\\n])*"|' + r"'(?!'')[^'\n]*'"
    r"|(?P<open>\[|\{|\"\"\"|'''|\"|')|(?P<close>\]|\})",
    re.DOTALL,
)
_PAIR = {"]": "[", "}": "{"}


def unclosed(text: str) -> tuple[str, int] | None:
    """Return the bracket or quote that stays open, and where; None if none or one too few does."""
    stack: list[tuple[str, int]] = []
    for token in _TOKEN.finditer(text):
        opening, closing = token["open"], token["close"]
        if opening is not None:
            stack.append((opening, token.start()))
            if opening not in "[{":
                return stack[-1]
        elif closing is not None:
            last = stack.pop() if stack else ("", 0)
            if last[0] != _PAIR[closing]:
                return last if _PAIR[closing] in (bracket for bracket, _ in stack) else None
    return stack[-1] if stack else None
