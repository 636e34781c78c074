"""One self-contained page: what was derived, designed, proved, simulated and shipped."""

import html
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.designs.core.files import write_whole
from obsynth.designs.core.observer import Observer
from obsynth.evaluate.errors import ReportError
from obsynth.evaluate.plotting.alarms import plot_widths
from obsynth.evaluate.plotting.layout import style
from obsynth.evaluate.plotting.plots import plot_errors, plot_run
from obsynth.evaluate.run import Run, coverage_table, percent
from obsynth.evaluate.svg import (
    colour_of,
    constants_html,
    equations_html,
    figure_svg,
)
from obsynth.symbolic import Plant
from obsynth.symbolic.display import signals_table
from obsynth.symbolic.table import Table, text
from obsynth.symbolic.taking import takes

if TYPE_CHECKING:
    from obsynth.evaluate.data.estimated import Estimate

Tables = Table | Sequence[Table]


@dataclass
class _Section:
    """A heading with the pieces of HTML below it."""

    key: str
    title: str
    parts: list[str] = field(default_factory=list)

    def add(self, *parts: str) -> None:
        self.parts += [part for part in parts if part]


@takes(path="Path str", observer="Observer FaultDetector ExtendedKalman dict")
def report(
    path: str | os.PathLike[str],
    observer: "Observer | Mapping[str, Observer]",
    runs: Any = (),
    tables: Tables | Mapping[str, Tables] = (),
    *,
    title: str | None = None,
    lead: str = "",
    highlights: Mapping[str, str] | None = None,
    half_widths: Mapping[str, Any] | None = None,
    progress: Callable[[str], None] | None = None,
) -> Path:
    """Write one HTML page that needs nothing but a browser.

    Figures and formulas are inline SVG and follow the reader's light or dark
    mode; the page prints in light. An existing file is replaced only when the
    new page is complete.

    Parameters
    ----------
    path : path-like
        The file to write; its folder has to exist.
    observer : Observer or mapping of label to Observer
        The designs; the first one's plant is the page's plant.
    runs : Run or Estimate, sequence of them, or mapping of design label to them
        Estimates have a section of their own. Coverage of all runs is tabulated. The first run of
        each scenario and design is plotted, and the errors of all designs in one figure.
    tables : Table, sequence of Table, or mapping of heading to tables
        More tables. The headings ``"Plant"``, ``"Derived bounds"``,
        ``"Design and certificate"``, ``"Half widths"``, ``"Simulation"`` and
        ``"C code"`` put them into the page's own sections, others make new ones.
    title : str, optional
        Heading of the page; the plant's name by default.
    lead : str
        One paragraph below the heading.
    highlights : mapping of label to value, optional
        Figures to show large at the top; by default what the page knows.
    half_widths : mapping of label to (n_x + n_f,), optional
        Half widths for the bar plot, for instance ``{"paper": ..., "peak": ...}``;
        by default those of the observers.
    progress : callable, optional
        Called with a word before each figure is drawn.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    ReportError
        If there is no observer, or the folder does not exist.

    Examples
    --------
    >>> report("report.html", observer, runs=[run])      # doctest: +SKIP
    """
    target = Path(path)
    if not target.parent.is_dir():
        raise ReportError(f"the folder {str(target.parent)!r} does not exist.", path=str(target))
    observers = _labelled_observers(observer)
    every = _labelled_runs(runs)
    labelled = {key: [one for one in many if isinstance(one, Run)] for key, many in every.items()}
    labelled = {key: many for key, many in labelled.items() if many}
    told = [one for many in every.values() for one in many if not isinstance(one, Run)]
    extra = _labelled_tables(tables)
    say = progress or (lambda word: None)
    first = next(iter(observers.values()))
    plant = first.model
    widths = _half_widths(observers) if half_widths is None else dict(half_widths)
    sections = [
        _plant_section(first),
        _Section("bounds", "Derived bounds"),
        _design_section(observers),
        _width_section(plant, widths, say),
        _run_section(labelled, say),
        _record_section(told, say),
        _Section("code", "C code"),
    ]
    known = {section.title: section for section in sections}
    for heading, several in extra.items():
        if heading not in known:
            known[heading] = _Section(f"more{len(known)}", heading)
            sections.append(known[heading])
        known[heading].add(*(table._repr_html_() for table in several))
    page = _render(
        title=title or plant.name,
        lead=lead,
        highlights=_highlights(observers, labelled) if highlights is None else dict(highlights),
        sections=[section for section in sections if section.parts],
    )
    write_whole(target, page)
    return target


def _labelled_observers(given: Any) -> dict[str, "Observer"]:
    observers = dict(given) if isinstance(given, Mapping) else {given.method: given}
    if not observers:
        raise ReportError("a report needs at least one observer.")
    return observers


def _labelled_runs(given: Any) -> dict[str, list[Any]]:
    if isinstance(given, Mapping):
        return {k: [v] if hasattr(v, "estimated") else list(v) for k, v in given.items()}
    labelled: dict[str, list[Any]] = {}
    for run in [given] if hasattr(given, "estimated") else given:
        labelled.setdefault(run.method, []).append(run)
    return labelled


def _labelled_tables(given: Any) -> dict[str, list[Table]]:
    if isinstance(given, Table):
        given = [given]
    named = dict(given) if isinstance(given, Mapping) else ({"Tables": given} if given else {})
    return {k: [v] if isinstance(v, Table) else list(v) for k, v in named.items()}


def _half_widths(observers: Mapping[str, "Observer"]) -> dict[str, Any]:
    return {k: o.half_widths for k, o in observers.items() if o.half_widths is not None}


def _subject(observer: "Observer") -> str:
    """Say which equations the guarantee speaks of."""
    if observer.ode is None:
        return "All guarantees speak of the discrete model."
    if observer.step_covered:
        return "The guarantees speak of the differential equation, observed at these instants."
    return (
        "The guarantees speak of the differential equations of plant and observer; the observer's "
        "step is their approximation with everything measured held over a sample."
    )


def _plant_section(observer: "Observer") -> _Section:
    model = observer.model
    section = _Section("plant", "Plant")
    continuous = model.continuous
    shown = model if continuous is None else continuous
    section.add(equations_html(shown, "eq"))
    if continuous is not None and model.Ts is not None:
        section.add(
            f"<p>Discretised with a sample time of {model.Ts:g} s "
            f"({html.escape(str(model.discretisation))}"
            f"{_remainder_text(model)}). "
            f"{_subject(observer)}</p>"
        )
    section.add(signals_table(shown, "Signals", shown.constants)._repr_html_())
    section.add(constants_html(shown))
    return section


def _remainder_text(model: Plant) -> str:
    if model.remainder is None:
        return ""
    ranges = ", ".join(f"{s.name} in [{s.lower:.3g}, {s.upper:.3g}]" for s in model.remainder)
    return f"; what a step leaves out is a disturbance: {html.escape(ranges or 'nothing')}"


def _design_section(observers: Mapping[str, "Observer"]) -> _Section:
    section = _Section("design", "Design and certificate")
    for label, observer in observers.items():
        if len(observers) > 1:
            section.add(f"<h3>{html.escape(label)}</h3>")
        section.add(
            observer.certificate._repr_html_(),
            _bullets("Guaranteed", observer.guarantee.claims),
            _bullets("Provided that", observer.guarantee.assumptions),
        )
        figures = [[key, value] for key, value in observer.figures.items()]
        if figures:
            section.add(Table("Performance", ["key", "value"], figures)._repr_html_())
        section.add(_gains(observer))
    return section


def _bullets(head: str, lines: Sequence[str]) -> str:
    if not lines:
        return ""
    items = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
    return f'<p class="head">{html.escape(head)}</p><ul>{items}</ul>'


def _gains(observer: "Observer") -> str:
    blocks = []
    for name, gain in observer.gains.items():
        matrix = gain if gain.ndim == 2 else gain.reshape(1, -1)
        rows = "".join(
            "<tr>" + "".join(f'<td class="number">{text(v)}</td>' for v in row) + "</tr>"
            for row in matrix
        )
        blocks.append(
            f'<figure class="matrix"><figcaption>{html.escape(name)}</figcaption>'
            f"<table><tbody>{rows}</tbody></table></figure>"
        )
    if not blocks:
        return ""
    return (
        f'<details><summary>Gains</summary><div class="matrices">{"".join(blocks)}</div></details>'
    )


def _width_section(
    plant: "Plant", widths: Mapping[str, Any], say: Callable[[str], None]
) -> _Section:
    section = _Section("widths", "Half widths")
    if not widths:
        return section
    say("half widths")
    signals = (*plant.x, *plant.f)
    names, units = [s.name for s in signals], [s.unit for s in signals]
    drawn = []
    for unit in dict.fromkeys(units):
        group = [i for i, own in enumerate(units) if own == unit]
        with style():
            figure, ax = _panel(1.9)
            table = {label: [row[i] for i in group] for label, row in widths.items()}
            plot_widths(table, [names[i] for i in group], [unit] * len(group), ax=ax, title="")
        drawn.append((figure, ax))
    section.add(_panels_html(drawn, "widths", "half widths", ""))
    rows = [[label, *map(_width, row), _width(sum(row))] for label, row in widths.items()]
    section.add(Table("Half widths in steady state", ["", *names, "sum"], rows)._repr_html_())
    return section


def _width(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "n/a"


def _run_section(runs: Mapping[str, Sequence[Run]], say: Callable[[str], None]) -> _Section:
    section = _Section("runs", "Simulation")
    scenarios = dict.fromkeys(run.scenario for several in runs.values() for run in several)
    if not scenarios:
        return section
    section.add(coverage_table(runs)._repr_html_())
    for i, scenario in enumerate(scenarios):
        section.add(f"<h3>{html.escape(scenario)}</h3>")
        first: dict[str, Run] = {}
        for label, several in runs.items():
            for run in several:
                if run.scenario == scenario:
                    first.setdefault(label, run)
        for j, (label, run) in enumerate(first.items()):
            shown = ["truth", "estimate", *(["interval"] if run.bounded else [])]
            shown += ["alarms"] if run.alarm is not None else []
            shown += ["void instants"] if run.domain.voids else []
            words = f"{', '.join(shown[:-1])} and {shown[-1]}"
            caption = f"{scenario}, {label}, seed {run.seed}: {words}"
            say(caption)
            drawn = _panels(run, plot_run)
            section.add(_panels_html(drawn, f"run{i}{j}", caption, caption), _facts(run))
        between = " between their guaranteed bounds"
        between = between if any(run.bounded for run in first.values()) else ""
        caption = f"{scenario}: errors{between}, settled"
        say(caption)
        drawn = _panels(first if len(first) > 1 else next(iter(first.values())), plot_errors)
        section.add(_panels_html(drawn, f"err{i}", caption, caption))
    return section


def _record_section(every: "Sequence[Estimate]", say: Callable[[str], None]) -> _Section:
    section = _Section("records", "Records")
    for i, told in enumerate(every):
        caption = f"{told.record.source}: estimate and interval"
        say(caption)
        table, drawn = replace(told.summary(), note=""), _panels(told, plot_run)
        section.add(table._repr_html_(), _panels_html(drawn, f"record{i}", caption, caption))
        section.add(_bullets("In words", told.said))
    return section


def _facts(run: Run) -> str:
    lines = [f"truth: {run.truth}", *(f"outside the guarantee: {line}" for line in run.reasons)]
    lines += str(run.domain).splitlines() + [str(v) for v in run.violations]
    return "<ul>" + "".join(f"<li>{html.escape(line)}</li>" for line in lines) + "</ul>"


Drawn = list[tuple[Any, Any]]


def _panels(shown: Any, plot: Callable[..., Any]) -> Drawn:
    """Draw a figure for each estimated signal, so that a page sets as many in a row as fit."""
    first = next(iter(shown.values())) if isinstance(shown, Mapping) else shown
    drawn = []
    for name in first.estimated:
        with style():
            figure, ax = _panel(1.6)
            plot(shown, signals=[name], ax=[ax])
        drawn.append((figure, ax))
    return drawn


def _panel(height: float) -> tuple[Any, Any]:
    """Make a figure as wide as a telephone in inches, whose letters stay legible there."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.2, height), layout="constrained")
    return figure, figure.subplots()


def _panels_html(drawn: Drawn, key: str, label: str, caption: str) -> str:
    """Set figures beside each other, their lines named once above them."""
    named: dict[str, str] = {}
    pictures = []
    for i, (figure, ax) in enumerate(drawn):
        for line, word in zip(*ax.get_legend_handles_labels(), strict=True):
            named.setdefault(word, colour_of(line))
        for legend in (*figure.legends, ax.get_legend()):
            if legend is not None:
                legend.remove()
        picture = figure_svg(figure, f"{key}{i}", f"{label}: {ax.get_ylabel() or caption}")
        pictures.append(f"<figure>{picture}</figure>")
    keys = "".join(
        f'<span style="--key:{colour}">{html.escape(word)}</span>' for word, colour in named.items()
    )
    words = f'<p class="caption">{html.escape(caption)}</p>' if caption else ""
    return f'<div class="keys">{keys}</div><div class="panels">{"".join(pictures)}</div>{words}'


def _highlights(
    observers: Mapping[str, "Observer"], runs: Mapping[str, Sequence[Run]]
) -> dict[str, str]:
    claims = [claim for observer in observers.values() for claim in observer.certificate]
    shown = {"claims proved": f"{sum(c.holds for c in claims)} of {len(claims)}"}
    every = [run for several in runs.values() for run in several]
    found = [run.coverage[name] for run in every for name in run.bounded]
    if found:
        shown["of all instants inside"] = percent(min(found))
    return shown


def _render(**content: Any) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("report.html").render(**content)
