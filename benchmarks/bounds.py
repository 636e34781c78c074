"""How fast guaranteed ranges are, and how that compares with ball arithmetic.

    python benchmarks/bounds.py [--case NAME] [--limit SECONDS] [--out FOLDER]

Every row runs in a process of its own and is measured in seconds of one processor. ``search``
begins at CasADi expressions and ends at guaranteed bounds with attained points: differentiation,
translation, branch and bound; ``first`` is the same when nothing has been warmed up, ``whole`` is
what a user waits for, from the plant. The peer is the textbook algorithm over python-flint's arb
(see ``bounds_arb.py``), at equal tolerance, one expression at a time; it is stopped at twenty times
our time, and what it has not finished by then counts as twenty; its gap is that of what it has
bounded. ``as typed``: the peer gets the equations of the user, ``rewritten``: the form that we
bound ourselves (sums for products of sines and cosines, where that pays).
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

ENOUGH = 20.0
WAYS = {
    "arb generated": ("generated", "loss"),
    "arb interpreted": ("interpreted", "loss"),
    "arb generated, widest": ("generated", "widest"),
    "arb interpreted, widest": ("interpreted", "widest"),
}
# expressions, tolerance, seconds that are asked for
CASES: dict[str, tuple[str, float, float | None]] = {
    "quadrotor Jacobian": ("jacobian", 1e-6, 1.0),
    "3R bias vector": ("values", 1e-2, 2.0),
    "3R bias Jacobian": ("jacobian", 1e-2, 2.0),
    "2R dynamics": ("values", 1e-6, None),
    "2R dynamics Jacobian": ("jacobian", 1e-6, None),
    "3R dynamics": ("values", 1e-2, None),
    "3R dynamics Jacobian": ("jacobian", 1e-2, None),
    "four tanks Jacobian": ("jacobian", 1e-6, None),
    "CSTR Jacobian": ("jacobian", 1e-6, None),
    "Haldane Jacobian": ("jacobian", 1e-6, None),
    "bicycle Jacobian": ("jacobian", 1e-6, None),
}


def arm_from_lagrange(n: int) -> Any:
    """Bias vector of an arm with unit masses and lengths as its energy gives it, not simplified."""
    import sympy as sp

    from obsynth.symbolic import Plant

    plant = Plant(f"{n}R arm")
    q = plant.states(f"q1:{n + 1}", range=(-0.3, 0.3))
    dq = plant.states(f"dq1:{n + 1}", range=(-0.5, 0.5))
    mass, x, y = sp.zeros(n, n), sp.Integer(0), sp.Integer(0)
    for i in range(n):
        x, y = x + sp.sin(sum(q[: i + 1])), y - sp.cos(sum(q[: i + 1]))
        jacobian = sp.Matrix([x, y]).jacobian(q)
        mass += jacobian.T * jacobian
    rows = [sp.Integer(0)] * n
    for k in range(n):
        for i in range(n):
            for j in range(n):
                symbol = mass[k, j].diff(q[i]) + mass[k, i].diff(q[j]) - mass[i, j].diff(q[k])
                rows[k] -= symbol * dq[i] * dq[j] / 2
    plant.dynamics([*dq, *rows])
    plant.outputs(list(q))
    return plant


def plant_of(case: str) -> Any:
    """Make the plant of a case."""
    from obsynth.symbolic import plants

    made = {
        "quadrotor": plants.quadrotor,
        "3R bias": lambda: arm_from_lagrange(3),
        "2R dynamics": lambda: plants.planar_arm(2),
        "3R dynamics": lambda: plants.planar_arm(3),
        "four tanks": plants.quadruple_tank,
        "CSTR": plants.exothermic_cstr,
        "Haldane": plants.haldane_bioreactor,
        "bicycle": plants.bicycle,
    }
    return next(make() for name, make in made.items() if case.startswith(name))


def scaled(plant: Any) -> Any:
    """Make a plant whose Jacobian with respect to its only input is the right-hand side."""
    from obsynth.symbolic import Plant

    result = Plant(f"{plant.name}, scaled")
    for kind, declare in (("x", result.states), ("u", result.scheduling)):
        for signal in getattr(plant, kind):
            declare(signal.name, range=(signal.lower, signal.upper))
    (scale,) = result.inputs("scale", range=(0, 1), nominal=1)
    result.dynamics([scale * row for row in plant.rhs])
    result.outputs([s.symbol for s in plant.x])
    return result


def entries_of(case: str) -> list[Any]:
    """List what is bounded: all entries with respect to states and to inputs, where there are."""
    from obsynth.derive.jacobian.entries import jacobian_entries

    plant, kind = plant_of(case), CASES[case][0]
    if kind == "values":
        return [jacobian_entries(scaled(plant), "inputs")]
    return [jacobian_entries(plant, w) for w in ("states", "inputs")[: 1 + bool(plant.u)]]


def typed_of(case: str) -> list[tuple[Any, Any, Any]]:
    """Return the same expressions as the user typed them: column, variables, box."""
    import casadi as ca
    import numpy as np

    plant, kind = plant_of(case), CASES[case][0]
    plant = scaled(plant) if kind == "values" else plant
    sx, kinds = plant.sx(constants="value"), ("x", "u", "d", "f", "w", "p", "rho")
    variables = ca.vertcat(*(getattr(sx, k) for k in kinds))
    box = np.vstack([plant.box(k).reshape(-1, 2) for k in kinds])
    result = []
    for wrt in ("u",) if kind == "values" else ("x", "u")[: 1 + bool(plant.u)]:
        jacobian = ca.jacobian(sx.rhs, getattr(sx, wrt))
        column = ca.vertcat(*jacobian.nz[:].elements()) if jacobian.nnz() else ca.SX(0, 1)
        needed = {str(s) for s in ca.symvar(column)}
        used = [k for k in range(variables.numel()) if str(variables[k]) in needed]
        result.append((column, variables[used], box[used]))
    return result


def ours(case: str) -> dict[str, Any]:
    """Bound the expressions of a case with obsynth."""
    import numpy as np

    from obsynth.derive import jacobian_bounds
    from obsynth.derive.intervals.ranges import bound_ranges

    kind, rtol, _ = CASES[case]
    begin = time.process_time()
    problems = entries_of(case)
    prepared = time.process_time() - begin

    def search() -> tuple[float, list[Any]]:
        start = time.process_time()
        found = [
            bound_ranges(
                e.values,
                e.variables,
                e.box,
                e.constants,
                e.constant_box,
                rtol=rtol,
                quotients=e.quotients,
            )
            for e in problems
        ]
        return time.process_time() - start, found

    first, found = search()
    seconds = min(first, *(search()[0] for _ in range(5 if first < 1.0 else 1)))
    whole = None
    if kind == "jacobian":
        plant, start = plant_of(case), time.process_time()
        for wrt in ("states", "inputs")[: 1 + bool(plant.u)]:
            jacobian_bounds(plant, wrt, rtol=rtol)
        whole = time.process_time() - start
    width = np.concatenate([r.attained_upper - r.attained_lower for r in found])
    gap = np.concatenate([r.gap for r in found])
    status = [s.name for r in found for s in r.status]
    return {
        "seconds": seconds,
        "first": first,
        "preparation": prepared,
        "whole": whole,
        "boxes": sum(r.boxes for r in found),
        "entries": len(gap),
        "open": sum(s in ("BUDGET", "UNBOUNDED") for s in status),
        # what rounding costs on entries that do not vary is no gap
        "gap": float(np.max(np.where(width > 1e-12, gap / np.maximum(width, 1e-12), 0.0))),
    }


def peer(case: str, way: str, form: str, limit: float) -> dict[str, Any]:
    """Bound the expressions of a case with the textbook algorithm over arb."""
    import bounds_arb
    import casadi as ca
    import numpy as np

    make, cut = WAYS[way]
    if form == "rewritten":
        problems = []
        for e in entries_of(case):
            middles = [0.5 * (low + high) for low, high in e.constant_box]
            column = ca.substitute(e.values, e.constants, ca.DM(middles))
            problems.append((column, e.variables, e.box))
    else:
        problems = typed_of(case)
    preparation, seconds, found = 0.0, 0.0, []
    for column, variables, box in problems:
        some, before, after = bounds_arb.bound_all(
            column, variables, box, CASES[case][1], limit - seconds, getattr(bounds_arb, make), cut
        )
        preparation, seconds, found = preparation + before, seconds + after, found + some
    widths = np.array([f.upper - f.lower - f.gap for f in found])
    gaps = np.array([f.gap for f in found])
    known = [bool(np.isfinite(g) and w > 1e-12) for g, w in zip(gaps, widths, strict=True)]
    return {
        "seconds": seconds,
        "preparation": preparation,
        "boxes": sum(f.boxes for f in found),
        "entries": len(found),
        "open": sum(not f.finished for f in found),
        "gap": float(np.max(gaps[known] / widths[known], initial=0.0)),
    }


def run_row(case: str, way: str, form: str, limit: float) -> dict[str, Any]:
    """One row, in this process."""
    row = ours(case) if way == "obsynth" else peer(case, way, form, limit)
    return row | {"case": case, "way": way, "form": form}


def in_a_process(case: str, way: str, form: str, limit: float) -> dict[str, Any]:
    """One row, in a process of its own."""
    command = [sys.executable, __file__, "--row", case, way, form, str(limit)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        return dict(json.loads(done.stdout.splitlines()[-1]))
    except (IndexError, json.JSONDecodeError):
        return {"case": case, "way": way, "form": form, "error": done.stderr.strip()[-200:]}


def import_seconds() -> tuple[float, float]:
    """Time of ``import obsynth`` and of its first name in fresh interpreters, medians of nine."""
    clock = "import time; t = time.process_time(); import obsynth; "
    code = [clock + f"{rest}print(time.process_time() - t)" for rest in ("", "obsynth.Plant; ")]
    medians = []
    for line in code:
        times = [
            float(
                subprocess.run([sys.executable, "-c", line], capture_output=True, text=True).stdout
            )
            for _ in range(9)
        ]
        medians.append(sorted(times)[4])
    return medians[0], medians[1]


def print_row(row: dict[str, Any], reference: dict[str, Any] | None) -> None:
    """One line of the table."""
    name = f"{row['case']:21} {row['way']:24} {row['form']:10}"
    if "error" in row:
        print(f"{name} {row['error']}")
        return
    ratio = ""
    if reference is not None:
        value = row["seconds"] / reference["seconds"]
        ratio = f">= {ENOUGH:.0f}" if row["open"] else f"{value:.1f}"
        cold = (row["seconds"] + row["preparation"]) / reference["seconds"]
        ratio += "" if row["open"] else f" ({cold:.1f})"
    print(
        f"{name} {row['seconds']:9.3f} {row['preparation']:8.3f} {row['boxes']:8d} "
        f"{row['entries'] - row['open']:3d}/{row['entries']:<3d} {row['gap']:8.1e} {ratio:>13}"
    )


def measure(case: str, limit: float) -> list[dict[str, Any]]:
    """All rows of a case."""
    reference = in_a_process(case, "obsynth", "rewritten", 0.0)
    print_row(reference, None)
    rows = [reference]
    if "error" in reference:
        return rows
    for form in ("as typed", "rewritten"):
        # interpretation is shown where the comparison is asked for
        for way in WAYS if case == "quadrotor Jacobian" else ("arb generated",):
            row = in_a_process(case, way, form, min(limit, ENOUGH * reference["seconds"]))
            print_row(row, reference)
            rows.append(row)
    return rows


def print_targets(results: list[dict[str, Any]]) -> None:
    """Compare with what the project asks for."""
    print()
    for case, (_, _, asked) in CASES.items():
        rows = [r for r in results if r["case"] == case and "error" not in r]
        mine = [r for r in rows if r["way"] == "obsynth"]
        if mine and asked is not None:
            whole = mine[0]["whole"] or mine[0]["first"]
            verdict = "met" if whole < asked and not mine[0]["open"] else "MISSED"
            print(
                f"{case:21} whole {whole:6.3f} s, first search {mine[0]['first']:6.3f} s, "
                f"asked {asked:.0f} s: {verdict}"
            )
        others = [r for r in rows if r["way"] != "obsynth"]
        if mine and others and case == "quadrotor Jacobian":
            print_ratios(mine[0], others)


def print_ratios(mine: dict[str, Any], others: list[dict[str, Any]]) -> None:
    """Say how much faster we are, for each of the two rules by which the peer cuts boxes."""
    for rule, text in (("loss", "largest loss"), ("widest", "widest side")):
        rows = [r for r in others if WAYS[r["way"]][1] == rule]
        ratios = [ENOUGH if r["open"] else r["seconds"] / mine["seconds"] for r in rows]
        verdict = "met" if min(ratios) >= ENOUGH else "MISSED"
        least = f"{min(ratios):.1f} to {max(ratios):.1f}"
        said = f"at least {ENOUGH:.0f}" if min(ratios) >= ENOUGH else least
        print(
            f"{mine['case']:21} {said} times faster than arb that cuts the {text}, "
            f"asked {ENOUGH:.0f}: {verdict}"
        )
    best = min(others, key=lambda r: (r["open"] > 0, r["seconds"]))
    print(_WHY.format(mine=mine, best=best, each=1e6 * best["seconds"] / best["boxes"]))


_WHY = """\
  Of the peer's two rules the textbook one, to halve the widest side, needs some 400 000 boxes here;
  to cut where the mean-value form loses most is what makes the peer fast: {best[boxes]} boxes of
  {each:.0f} microseconds, as no entry depends on more than four variables and every operator is one
  call of compiled code. We take {mine[boxes]} boxes and {mine[seconds]:.3f} s, a third of it for
  differentiation, translation and scheduling in Python, which every call does anew. Twenty times
  would leave less for everything than that third."""


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--row", nargs=4, help=argparse.SUPPRESS)
    parser.add_argument("--case", choices=list(CASES), help="one case only")
    parser.add_argument("--out", type=Path, help="folder for the table (JSON)")
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for a row of the peer")
    options = parser.parse_args()
    if options.row:
        case, way, form, limit = options.row
        print(json.dumps(run_row(case, way, form, float(limit))))
        return
    print(
        f"{'case':21} {'way':24} {'form':10} {'search s':>9} {'prep. s':>8} {'boxes':>8} "
        f"{'closed':>7} {'gap':>8} {'x (with prep.)':>14}"
    )
    results = []
    for case in [options.case] if options.case else CASES:
        results += measure(case, options.limit)
    print_targets(results)
    bare, used = import_seconds()
    print(
        f"import obsynth {bare:.3f} s, asked 0.6 s: {'met' if bare < 0.6 else 'MISSED'}; with its "
        f"first name, which loads SymPy and CasADi, {used:.3f} s"
    )
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "bounds.json").write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
