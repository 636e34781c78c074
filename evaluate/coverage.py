"""Coverage of many runs in one table."""

from collections.abc import Mapping, Sequence
from typing import Any

from obsynth.evaluate.run import Run, covered
from obsynth.symbolic.table import Table
from obsynth.symbolic.taking import takes


@takes(runs="dict")
def coverage_table(runs: Mapping[str, Sequence[Run]]) -> Table:
    """Tabulate the coverage of all signals for every scenario, design and seed.

    Parameters
    ----------
    runs : mapping of design label to runs

    Returns
    -------
    Table
        With a last column that says whether the run kept the assumptions of the
        guarantee, which is what makes its coverage a test of it.
    """
    names, rows = _tabulated(runs, apart=True)
    return Table(
        "Coverage",
        ["scenario", "design", "seed", *names, "assumptions kept"],
        rows,
        note="Fraction of all instants, the first included, at which the truth is inside its "
        "interval; counted at tolerance zero.",
    )


def coverage_summary(runs: Mapping[str, Sequence[Run]]) -> Table:
    """Tabulate the smallest coverage over the seeds, one row for each scenario and design."""
    names, rows = _tabulated(runs, apart=False)
    return Table(
        "Inside the guaranteed interval, smallest over the seeds",
        ["scenario", "design", "seeds", *names, "assumptions kept"],
        rows,
    )


def _tabulated(
    runs: Mapping[str, Sequence[Run]], apart: bool
) -> tuple[tuple[str, ...], list[list[Any]]]:
    """Return the signals and a row for every run, or for all of a scenario and design."""
    groups: dict[tuple[str, str, int], list[Run]] = {}
    for label, several in runs.items():
        for run in several:
            groups.setdefault((run.scenario, label, apart * len(groups)), []).append(run)
    order = list(dict.fromkeys(scenario for scenario, *_ in groups))
    names = next(iter(groups.values()))[0].estimated if groups else ()
    rows = [
        [
            scenario,
            label,
            group[0].seed if apart else len(group),
            *(covered(group, name) for name in names),
            all(run.kept for run in group),
        ]
        for (scenario, label, _), group in sorted(
            groups.items(), key=lambda g: order.index(g[0][0])
        )
    ]
    return names, rows
