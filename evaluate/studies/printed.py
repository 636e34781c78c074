"""What Buciakowski et al. print for the quadruple tank, set against what is found."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.codegen import CProject
from obsynth.derive import JacobianBounds
from obsynth.designs import Observer
from obsynth.evaluate.papers.buciakowski import (
    PRINTED_BOUNDS,
    PRINTED_GAMMA,
    Refusals,
    too_narrow,
)
from obsynth.symbolic.table import Table, text


def bounds_table(bounds: "JacobianBounds") -> Table:
    """Set the derived bounds of the Jacobian of g against the printed ones."""
    rows: list[list[Any]] = []
    marked: list[int] = []
    for (i, j), (low, high) in PRINTED_BOUNDS.items():
        found = (float(bounds.min[i - 1, j - 1]), float(bounds.max[i - 1, j - 1]))
        wrong = too_narrow(bounds, (i, j))
        if wrong:
            marked.append(len(rows))
        rows.append(
            [
                f"m{i}{j}",
                f"[{low:.4f}, {high:.4f}]".replace("-", "−"),
                f"[{found[0]:.6f}, {found[1]:.6f}]".replace("-", "−"),
                text(bounds.gap[i - 1, j - 1], 2),
                "too narrow" if wrong else "rounded",
            ]
        )
    return Table(
        "Jacobian of g over the box",
        ["entry", "printed", "derived", "gap", "printed is"],
        rows,
        note="The derived bounds are guaranteed, and attained within the gap. The printed ones "
        "agree with forward differences of 1 cm, which do not reach the ends of the box where h3 "
        "or h4 is 5 cm.",
        marked=marked,
    )


def vertices_table(bounds: "JacobianBounds") -> Table:
    """Say how many vertices the design needs, and why."""
    # A constant of 1e-17 is what the doubles of A leave of the exact dependence.
    why = [
        re.sub(r" (?:[+-]|up to) [\d.]+e-1[5-9]", "", str(dependence).split("; ")[0])
        for dependence in bounds.dependences
        if dependence.coefficients
    ]
    return Table(
        "Vertices of the Jacobian set",
        ["set", "vertices", "reason"],
        [
            ["printed (Remark 2)", bounds.naive_vertex_count, "six entries taken as independent"],
            ["derived", len(bounds.vertices()), "; ".join(why)],
        ],
    )


def refusal_table(refusals: Refusals) -> Table:
    """Say why the printed design is refused."""
    printed, direct = refusals
    point = printed.certificate
    vector = ", ".join(f"{float(v):.4g}" for v in point.e_f)
    return Table(
        "The printed design is refused",
        ["asked for", "answer", "evidence"],
        [
            [
                f"(51), γ = {PRINTED_GAMMA:g}",
                "infeasible for every γ and every gain",
                f"exact fixed point of the error with e = (0, 0, 0, 1), e_f = ({vector}); both "
                f"quadratic forms are ≥ 0: {float(point.q1):.3g}, {float(point.q2):.3g}",
            ],
            [
                f"direct LMI, γ = {PRINTED_GAMMA:g}",
                "infeasible",
                f"the largest feasible γ is about {direct.largest_gamma:.5f}",
            ],
        ],
        note="Fractions are exact; they are shown rounded.",
    )


def width_table(designs: Mapping[str, Observer]) -> Table:
    """Compare the guaranteed steady half widths of the designs."""
    names = _names(next(iter(designs.values())))
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


def code_table(project: "CProject") -> Table:
    """Say what the C project is and how it was compared."""
    rows: list[list[Any]] = [["operations of one step", str(project.operations)]]
    if project.build is not None and project.comparison is not None:
        rows += [
            ["compiler", project.build.compiler],
            ["flags", " ".join(project.build.flags)],
            ["steps compared with CasADi", f"{project.comparison.vectors:,}"],
            ["values equal to the last bit", f"{project.comparison.values:,} of them, all"],
        ]
    else:
        rows.append(["comparison", "not done: no C compiler found"])
    return Table("C project", ["", ""], rows)


def _names(observer: Observer) -> tuple[str, ...]:
    return (*observer.model.names("x"), *observer.model.names("f"))


def half_widths(observer: Observer) -> Any:
    """Return the method's own half widths of states, then faults; infinite without a guarantee."""
    widths = observer.performance.get("core_half_widths")
    return np.full(len(_names(observer)), np.inf) if widths is None else widths
