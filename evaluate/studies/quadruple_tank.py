"""The quadruple tank of Buciakowski et al., all the way, against the printed numbers."""

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from obsynth.codegen import CProject, generate_c
from obsynth.codegen.folder import complete_folder
from obsynth.derive import JacobianBounds, jacobian_bounds, split
from obsynth.designs import BoundedErrorUIO, Observer
from obsynth.evaluate.errors import SimulationError
from obsynth.evaluate.papers.buciakowski import ask, claims_of, tank
from obsynth.evaluate.papers.claim import Claim, claims_table
from obsynth.evaluate.report import report
from obsynth.evaluate.run import Run, coverage_summary, percent
from obsynth.evaluate.simulate import simulate
from obsynth.symbolic import Scenario, scenarios
from obsynth.symbolic.arrays import FloatArray
from obsynth.symbolic.table import Table

# The largest round value that leaves room below the largest feasible gamma of all forms.
GAMMA = 0.005
# The method's own sets, which forget nothing, as the paper has them.
OWN: dict[str, Any] = {"cuts": (), "horizon": 10**9}

BEFORE, ELLIPSOID, PEAK = "(51), repaired", "ellipsoid", "peak"
STAGES = (
    ("deriving bounds with proof", 0.0),
    ("asking for the printed design", 0.05),
    ("designing by (51), repaired", 0.08),
    ("designing the ellipsoid", 0.21),
    ("designing for peak bounds", 0.28),
    ("simulating", 0.59),
    ("writing and comparing the C code", 0.64),
    ("writing the report", 0.79),
    ("done", 1.0),
)
"""The stages with the share of the time that is over when they begin, for progress bars."""

RUN = "obsynth run"
"""What the manifest of a study's folder says that it is."""

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class QuadrupleTank:
    """What the study found on the euler model, Ts = 1 s; the last of the designs ships."""

    bounds: JacobianBounds
    claims: tuple[Claim, ...]
    designs: dict[str, Observer]
    runs: dict[str, tuple[Run, ...]]
    project: CProject
    folder: Path

    @property
    def coverage(self) -> float:
        """The smallest coverage of any signal in any run."""
        every = [run for several in self.runs.values() for run in several]
        return min(min(run.coverage.values()) for run in every)

    def highlights(self) -> dict[str, str]:
        """Return the figures to show first."""
        claims = [c for label in (ELLIPSOID, PEAK) for c in self.designs[label].certificate]
        sums = [half_widths(self.designs[label]).sum() for label in (BEFORE, PEAK)]
        shown = {
            f"vertices in place of {self.bounds.naive_vertex_count}": str(
                len(self.bounds.vertices())
            ),
            "claims proved": f"{sum(c.holds for c in claims)} of {len(claims)}",
            "sum of guaranteed half widths": f"{sums[0]:.2f} → {sums[1]:.2f}",
            "of all instants inside": percent(self.coverage),
        }
        if self.project.comparison is not None:
            shown["C steps equal to the last bit"] = f"{self.project.comparison.vectors:,}"
        return shown

    def tables(self) -> list[Table]:
        """Return the short account that the command prints."""
        return [
            claims_table("What the paper prints, and what holds", self.claims),
            width_table(self.designs),
            coverage_summary(self.runs),
            self.project.table(),
        ]


def quadruple_tank(
    folder: str | os.PathLike[str],
    steps: int = 5000,
    seeds: int = 3,
    progress: Progress | None = None,
) -> QuadrupleTank:
    """Derive, design, prove, simulate, generate C and report, and leave a folder.

    The folder holds ``report.html``, ``design.json`` (peak bounds, the design
    that ships), ``design_ellipsoid.json`` and the C project ``c/``. It appears
    only when all of it is complete, and replaces only what an earlier run left.
    """
    if seeds < 1:
        raise SimulationError(f"seeds={seeds}; at least one noise seed is needed.", seeds=seeds)
    cases = [shortened(name, steps) for name in ("FS1", "FS2")]

    def say(i: int) -> None:
        if progress is not None:
            progress(*STAGES[i])

    with complete_folder(folder, RUN) as place:
        say(0)
        parts = split(tank())
        bounds = jacobian_bounds(parts)
        say(1)
        claims = tuple(claims_of(parts, bounds, ask(parts, bounds)))
        designs = {}
        methods = {
            BEFORE: BoundedErrorUIO(form="repaired", gamma=GAMMA, objective="trace", **OWN),
            ELLIPSOID: BoundedErrorUIO(gamma=GAMMA, **OWN),
            PEAK: BoundedErrorUIO(bounds="peak", **OWN),
        }
        for i, (label, method) in enumerate(methods.items(), start=2):
            say(i)
            designs[label] = method.design(parts, bounds)
        say(5)
        runs = {label: _runs(designs[label], cases, seeds) for label in (ELLIPSOID, PEAK)}
        say(6)
        project = generate_c(designs[PEAK], place / "c")
        designs[PEAK].save(place / "design.json")
        designs[ELLIPSOID].save(place / "design_ellipsoid.json")
        study = QuadrupleTank(
            bounds=bounds,
            claims=claims,
            designs=designs,
            runs=runs,
            project=replace(project, folder=Path(folder).resolve() / "c"),
            folder=Path(folder).resolve(),
        )
        say(7)
        _write(study, place / "report.html")
    say(8)
    return study


def _runs(observer: Observer, cases: Sequence[Scenario], seeds: int) -> tuple[Run, ...]:
    return tuple(
        simulate(observer.model, observer, scenario, seed=seed)
        for scenario in cases
        for seed in range(seeds)
    )


def shortened(name: str, steps: int) -> Scenario:
    """Return the first samples of a scenario of the paper."""
    whole = scenarios.quadruple_tank(name)
    if not 1 <= steps <= whole.steps:
        raise SimulationError(
            f"steps={steps}; the paper's scenarios have 1 to {whole.steps} steps.", steps=steps
        )
    kept = {
        field: getattr(whole, field)[: steps + 1]
        for field in ("inputs", "faults", "unknown_inputs")
    }
    return replace(whole, steps=steps, **kept)


def _write(study: QuadrupleTank, path: Path) -> None:
    printed, _, _, code = study.tables()
    report(
        path,
        {label: study.designs[label] for label in (ELLIPSOID, PEAK)},
        runs=study.runs,
        tables={
            "What the paper prints": printed,
            "C code": code,
        },
        title="Quadruple tank: states and pump faults with guaranteed bounds",
        lead="After Buciakowski, Witczak, Puig, Rotondo, Nejjari and Korbicz, A bounded-error "
        "approach to simultaneous state and actuator fault estimation for a class of nonlinear "
        "systems. Everything below was derived from the equations, proved, and compared with what "
        "the paper prints.",
        highlights=study.highlights(),
        half_widths={label: half_widths(o) for label, o in study.designs.items()},
    )


def width_table(designs: Mapping[str, Observer]) -> Table:
    """Compare the guaranteed steady half widths of the designs."""
    model = next(iter(designs.values())).model
    names = (*model.names("x"), *model.names("f"))
    base = None
    rows: list[list[Any]] = []
    for label, observer in designs.items():
        widths = half_widths(observer)
        base = widths.sum() if base is None else base
        numbers = [*widths, widths.sum(), widths.sum() / base]
        rows.append([label, *(f"{number:.3f}" for number in numbers)])
    return Table(
        "Guaranteed half widths in steady state",
        ["design", *names, "sum", "ratio"],
        rows,
        marked=[len(rows) - 1],
    )


def half_widths(observer: Observer) -> FloatArray:
    """Return the method's own half widths of states, then faults; infinite without a guarantee."""
    model, widths = observer.model, observer.performance.get("core_half_widths")
    return np.full(len(model.x) + len(model.f), np.inf) if widths is None else widths
