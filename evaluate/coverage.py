"""Coverage of many runs in one table."""

from collections.abc import Mapping, Sequence

from obsynth.evaluate.run import Run, covered, percent
from obsynth.evaluate.table import Table


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
    every = [(label, run) for label, several in runs.items() for run in several]
    scenarios = list(dict.fromkeys(run.scenario for _, run in every))
    names = every[0][1].estimated if every else ()
    rows = [
        [
            run.scenario,
            label,
            run.seed,
            *(covered(run, name) for name in names),
            run.domain.ok and not run.outside,
        ]
        for label, run in sorted(every, key=lambda entry: scenarios.index(entry[1].scenario))
    ]
    return Table(
        "Coverage",
        ["scenario", "design", "seed", *names, "assumptions kept"],
        rows,
        note="Fraction of all instants, the first included, at which the truth is inside its "
        "interval; counted at tolerance zero.",
    )


def _smallest(group: Sequence[Run], name: str) -> str:
    found = [run.coverage[name] for run in group if name in run.bounded]
    return percent(min(found)) if found else "n/a"


def coverage_summary(runs: Mapping[str, Sequence[Run]]) -> Table:
    """Tabulate the smallest coverage over the seeds, one row for each scenario and design."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for label, several in runs.items():
        for run in several:
            groups.setdefault((run.scenario, label), []).append(run)
    order = list(dict.fromkeys(scenario for scenario, _ in groups))
    names = next(iter(groups.values()))[0].estimated if groups else ()
    rows = [
        [
            scenario,
            label,
            len(group),
            *(_smallest(group, name) for name in names),
            all(run.domain.ok and not run.outside for run in group),
        ]
        for (scenario, label), group in sorted(groups.items(), key=lambda g: order.index(g[0][0]))
    ]
    return Table(
        "Inside the guaranteed interval, smallest over the seeds",
        ["scenario", "design", "seeds", *names, "assumptions kept"],
        rows,
    )
