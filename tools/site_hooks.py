"""What MkDocs asks while it builds the site: formulas as MathML, the gallery, pages of the root.

Formulas become MathML when the site is built, so that pages need no script and no other host.
"""

import html
import re
import tomllib
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
OF_THE_ROOT = {"contributing.md": "CONTRIBUTING.md", "changelog.md": "CHANGELOG.md"}
FORMULA = re.compile(r'<(span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</\1>', re.DOTALL)
ERRATA = re.compile(r"<!-- errata:.*?-->")
SHOWN = ("states", "inputs", "unknown_inputs", "actuator_faults", "process_faults")
SHOWN += ("sensor_faults", "disturbances", "scheduling")


def on_files(files: Files, config: Any) -> Files:
    """Add the gallery, and the pages that stand at the root of the repository."""
    made = {page: (ROOT / source).read_text("utf-8") for page, source in OF_THE_ROOT.items()}
    made["gallery.md"] = gallery((ROOT / "symbolic" / "plants").glob("*.toml"))
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to the root lead to its pages here, and join the errata."""
    for page, source in OF_THE_ROOT.items():
        for link in (f"](../{source}", f"]({source}"):
            markdown = markdown.replace(link, f"]({page}")
    return ERRATA.sub(errata, markdown)


def on_page_content(page_html: str, **_: Any) -> str:
    """Write formulas as MathML."""
    return FORMULA.sub(formula, page_html)


def errata(_: re.Match[str]) -> str:
    """Return the errata of all papers as one table, from the pages of their methods."""
    rows = ["| paper | in print | correct | what shows it |", "|---|---|---|---|"]
    for path in sorted((ROOT / "docs" / "methods").glob("*.md")):
        _, found, table = path.read_text("utf-8").partition("\n## Errata\n\n")
        if found:
            link = f"| [{path.stem}](methods/{path.name}#errata) "
            lines = table.split("\n\n")[0].splitlines()
            rows += [link + line for line in lines[2:]]
    return "\n".join(rows)


def formula(found: re.Match[str]) -> str:
    """Return the MathML of a formula; one that is displayed stands in a box that scrolls."""
    text = html.unescape(found[3]).replace("{aligned}", "{align*}")  # which the converter knows
    shown = convert(text, display="block" if found[2] == "[" else "inline")
    shown = shown.replace(r"\_", "_")
    return f'<div class="wide">{shown}</div>' if found[2] == "[" else shown


def gallery(paths: Any) -> str:
    """Return the page of all plants that are text files: signals, equations, sources."""
    told = {path.stem: tomllib.loads(path.read_text("utf-8")) for path in sorted(paths)}
    parts = [GALLERY]
    parts += [f"| [{name}](#{name}) | {_counts(plant)} |" for name, plant in told.items()]
    for name, plant in told.items():
        parts += ["", f"## {name}", "", *_plant(name, plant)]
    return "\n".join(parts) + "\n"


GALLERY = """# Gallery

Plants of `ob.plants`, generated from their text files (`symbolic/plants/*.toml`).
`ob.plants.NAME()` returns one, `obsynth new mine.toml --like NAME` writes its text to be edited,
`ob.plants.text("NAME")` returns it. Plants that take parameters are functions: `bicycle`,
`hinf_example`, `leaking_tanks`, `planar_arm`, `planar_arm_bias`, `planar_arm_terms`,
`tanks_in_a_row`, `van_der_pol`; `help(ob.plants.NAME)` tells of them.

| plant | states | inputs | faults | outputs |
|---|---|---|---|---|"""


def _counts(plant: dict[str, Any]) -> str:
    faults = sum(
        _number(plant.get(f"{kind}_faults", {})) for kind in ("actuator", "process", "sensor")
    )
    shown = (_number(plant.get(table, {})) for table in ("states", "inputs"))
    return " | ".join(map(str, (*shown, faults, _number(plant["outputs"]))))


def _number(table: dict[str, Any]) -> int:
    """Count the signals of a table, whose keys may name several: "w1:4", "p q r"."""
    total = 0
    for name in " ".join(table).replace(",", " ").split():
        head, several, end = name.partition(":")
        first = re.search(r"\d*$", head)
        total += int(end) - int((first and first[0]) or 0) if several else 1
    return total


def _plant(name: str, plant: dict[str, Any]) -> list[str]:
    """Return the lines of one plant: what it is, equations, signals, where they are from."""
    about, _, sources = plant["about"].strip().partition("References\n----------\n")
    noun = about.removeprefix("Return ")
    after = "'" if "Ts" not in plant else "+"
    equations = [f"{key} = {_said(value)}" for key, value in plant.get("definitions", {}).items()]
    equations += [f"{key}{after} = {_said(value)}" for key, value in plant["dynamics"].items()]
    equations += [f"{key} = {_said(value)}" for key, value in plant["outputs"].items()]
    told = [(noun[0].upper() + noun[1:]).strip(), "", "```text", *equations, "```", ""]
    rows = [(table, plant[table]) for table in (*SHOWN, "parameters") if plant.get(table)]
    told += [f"- {table.replace('_', ' ')}: {_signals(entries)}" for table, entries in rows]
    if sources:
        told += ["", "Source: " + " ".join(sources.split())]
    return told


def _said(value: Any) -> str:
    return (
        value if isinstance(value, str) else value["is"] if isinstance(value, dict) else str(value)
    )


def _signals(entries: dict[str, Any]) -> str:
    """Return signals with what is said of each."""
    parts = []
    for name, told in entries.items():
        said = told if isinstance(told, dict) else {"value": told}
        facts = ", ".join(f"{key} {_plain(value)}" for key, value in said.items())
        parts.append(f"`{name}`" + (f": {facts}" if facts else ""))
    return "; ".join(parts)


def _plain(value: Any) -> str:
    return str(value).replace("'", "").replace("True", "yes").replace("False", "no")
