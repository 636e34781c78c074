"""What Buciakowski et al. print for the quadruple tank, set against what is found."""

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from obsynth.codegen import CProject
from obsynth.derive import JacobianBounds, Split
from obsynth.designs import InfeasibleDesign, Observer
from obsynth.evaluate.run import Run
from obsynth.evaluate.table import Table, text

# M_min and M_max of Section 6, by row and column from 1.
PRINTED_BOUNDS: Mapping[tuple[int, int], tuple[float, float]] = {
    (1, 1): (0.0026, 0.0065),
    (1, 3): (-0.0144, 0.0039),
    (2, 2): (0.0008, 0.0033),
    (2, 4): (-0.0078, 0.0037),
    (3, 3): (-0.0039, 0.0144),
    (4, 4): (-0.0037, 0.0078),
}
PRINTED_GAMMA = 0.01
PRINTED_Z0 = (125.0, 165.0, 25.0, 35.0)
# Of (51) as printed, and of the direct LMI at the printed gamma.
Refusals = tuple[InfeasibleDesign, InfeasibleDesign]


def bounds_table(bounds: "JacobianBounds") -> Table:
    """Set the derived bounds of the Jacobian of g against the printed ones."""
    rows: list[list[Any]] = []
    marked: list[int] = []
    for (i, j), (low, high) in PRINTED_BOUNDS.items():
        found = (float(bounds.min[i - 1, j - 1]), float(bounds.max[i - 1, j - 1]))
        # Printed with four decimals: half a unit of the last one is rounding, not a mistake.
        wrong = low > found[0] + 6e-5 or high < found[1] - 6e-5
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


def errata_table(parts: "Split", bounds: "JacobianBounds", refusals: Refusals, run: Run) -> Table:
    """List what does not hold as printed, with the numbers found."""
    E = -parts.D @ np.linalg.pinv(parts.C @ parts.D)
    e0 = ", ".join(f"{v:.1f}".replace("-", "−") for v in run.x[0] - (PRINTED_Z0 - E @ run.y[0]))
    corner = 100 * float(np.sum(parts.model.box("w")[:, 1] ** 2))
    n, m = parts.A.shape[0], parts.C.shape[0]
    low = float(bounds.max[0, 2])
    printed = PRINTED_BOUNDS[1, 3][1]
    return Table(
        "What the paper prints, and what holds",
        ["printed", "found"],
        [
            [
                "gravity is not given",
                f"g = 981 cm/s² gives the printed equilibrium, h1 = {parts.at.x[0]:.3f} cm",
            ],
            [f"M bounds, for example m13 ≤ {printed:g}", f"m13 reaches {low:.6f} at h3 = 5 cm"],
            [
                "Remark 2: N = 2^((n−c)²) vertices",
                f"{bounds.naive_vertex_count} = 2⁶ for six varying entries; "
                f"{len(bounds.vertices())} suffice",
            ],
            [
                "(18): third block of Wbar is E W1",
                f"E W2; E is {n}×{m} and W1 has {n} rows, so E W1 is no product",
            ],
            ["(51) is solved", "infeasible for every γ and gain, with an exact certificate"],
            [
                f"γ = {PRINTED_GAMMA:g}",
                f"above the largest feasible value, {refusals[1].largest_gamma:.5f}",
            ],
            [
                "Q_w = 100 I holds the noise",
                f"a corner of the cube gives w'Q_w w = {corner:g}; (100/3) I holds it",
            ],
            [
                "(49): max trace(P) makes the set small",
                "trace(P) is no sum of axes; min trace(P⁻¹) is what bounds them",
            ],
            ["z_0 is 5 cm off in every level", f"x̂_0 = z_0 − E y_0, so e_0 = ({e0})"],
        ],
    )


def _names(observer: Observer) -> tuple[str, ...]:
    return (*observer.model.names("x"), *observer.model.names("f"))


def half_widths(observer: Observer) -> Any:
    """Return the method's own half widths of states, then faults; infinite without a guarantee."""
    widths = observer.performance.get("core_half_widths")
    return np.full(len(_names(observer)), np.inf) if widths is None else widths
