"""How fast the LMI layer is, certified answer included, and how it grows.

    python benchmarks/lmi.py [--out FOLDER] [--limit SECONDS]

Every row runs in a process of its own, so that times and peak memory do not mix; imports do
not count. Prints a table with the targets of the project, and with ``--out`` leaves the table
as JSON and a plot of time and memory against the number of uncertain entries.
"""

from __future__ import annotations

import argparse
import importlib
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

CHAIN = {
    "naive cvxpy + Clarabel": (1, 2, 3, 4),
    "thin layer, whole": (1, 2, 3),
    "thin layer, split and lazy": (1, 2, 4, 6),
    "thin layer, row multipliers": (1, 2, 4, 6, 8, 10, 12, 14, 16, 18),
}


def proof_of_many() -> dict[str, Any]:
    """Prove 2^14 random blocks of 28 x 28 with a radius."""
    import numpy as np

    from obsynth.derive.rigour import prove_positive_definite

    roots = np.random.default_rng(0).normal(size=(2**14, 28, 56))
    matrices = roots @ np.swapaxes(roots, 1, 2)
    matrices = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    radius = np.full_like(matrices, 1e-12)
    start = time.perf_counter()
    result = prove_positive_definite(matrices, radius, sharp=False)
    seconds = time.perf_counter() - start
    return {"seconds": seconds, "objective": None, "proof": f"{int(result.proved.sum())} proved"}


def run_row(case: str, way: str) -> dict[str, Any]:
    """One row, in this process."""
    for heavy in ("clarabel", "cvxpy", "flint", "scipy.optimize"):
        importlib.import_module(heavy)
    import lmi_bounded_error
    import lmi_chain
    import lmi_qpv

    if case == "proof":
        row = proof_of_many()
    elif case.startswith("chain"):
        row = lmi_chain.run(way, int(case.split()[1]))
    else:
        row = {"(51)": lmi_bounded_error, "QPV": lmi_qpv}[case].ROWS[way]()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return row | {"case": case, "way": way, "peak_mib": peak / 1024}


def run_rows(rows: list[tuple[str, str]], limit: float) -> list[dict[str, Any]]:
    """All rows, each in a fresh process, stopped at a limit."""
    results = []
    for case, way in rows:
        command = [sys.executable, __file__, "--row", case, way]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
            row = json.loads(done.stdout.splitlines()[-1])
        except subprocess.TimeoutExpired:
            row = {"case": case, "way": way, "seconds": None, "proof": f"over {limit:.0f} s"}
        except (IndexError, json.JSONDecodeError):
            row = {"case": case, "way": way, "seconds": None, "proof": done.stderr[-200:]}
        results.append(row)
        print_row(row, results)
    return results


def _reference(row: dict[str, Any], results: list[dict[str, Any]]) -> float | None:
    """Seconds of the naive way for the same case (and box)."""
    box = row["way"].rpartition(", ")[2] if row["case"] == "QPV" else ""
    for other in results:
        same = other["case"] == row["case"] and other["way"].startswith("naive")
        if same and other["way"].endswith(box):
            return other["seconds"]
    return None


def print_row(row: dict[str, Any], results: list[dict[str, Any]]) -> None:
    """One line of the table."""
    seconds, naive = row["seconds"], _reference(row, results)
    ratio = f"{naive / seconds:8.1f}" if seconds and naive else " " * 8
    shown = f"{seconds:10.3f}" if seconds is not None else f"{'-':>10}"
    peak = f"{row['peak_mib']:6.0f}" if "peak_mib" in row else f"{'-':>6}"
    value = row.get("objective")
    objective = f"{value:11.6g}" if value is not None else " " * 11
    print(f"{row['case']:9} {row['way']:40} {shown} {ratio} {peak} {objective}  {row['proof']}")


def print_targets(results: list[dict[str, Any]]) -> None:
    """Compare with what the project asks for."""
    seconds = {(row["case"], row["way"]): row["seconds"] or float("inf") for row in results}
    naive, sdpa = (seconds["(51)", f"naive cvxpy + {name}"] for name in ("Clarabel", "SDPA"))
    variants = {w: s for (c, w), s in seconds.items() if c == "(51)" and w.startswith("thin")}
    best = min(variants, key=lambda way: variants[way])
    qpv = min(
        seconds["QPV", f"naive cvxpy + Clarabel, {box}"]
        / seconds["QPV", f"thin layer, reduced and lazy, {box}"]
        for box in ("box_tight", "box_insc")
    )
    last = next(r for r in results if r["case"] == "chain 18")
    many = seconds["proof", "2^14 of 28 x 28"]
    lines = [
        ("(51) against naive cvxpy + Clarabel", naive / variants[best], 30.0, f"x, {best}"),
        ("(51) against naive cvxpy + SDPA", sdpa / variants[best], 8.0, f"x, {best}"),
        ("QPV box against naive, extrapolated", qpv, 100.0, "x"),
        ("2^18 vertices, room in 30 s", 30.0 / (last["seconds"] or 1e9), 1.0, "x"),
        ("2^18 vertices, room in 4 GiB", 4096.0 / last.get("peak_mib", 1e9), 1.0, "x"),
        ("2^14 blocks of 28 x 28, room in .5 s", 0.5 / many, 1.0, "x"),
    ]
    print()
    for name, value, target, unit in lines:
        measured = 0.0 < value < float("inf")
        verdict = ("met" if value >= target else "MISSED") if measured else "not measured"
        print(f"{name:40} {value:8.1f} {unit:40} target {target:5.1f}  {verdict}")


def plot(results: list[dict[str, Any]], path: Path) -> None:
    """Time and memory against the number of uncertain entries."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    for way in CHAIN:
        rows = [r for r in results if r["way"] == way and r["case"].startswith("chain")]
        rows = [r for r in rows if r["seconds"] is not None]
        entries = [int(r["case"].split()[1]) for r in rows]
        left.semilogy(entries, [r["seconds"] for r in rows], "o-", label=way)
        right.semilogy(entries, [r["peak_mib"] for r in rows], "o-", label=way)
    left.set(xlabel="uncertain entries k (2^k vertices)", ylabel="seconds, proof included")
    right.set(xlabel="uncertain entries k (2^k vertices)", ylabel="peak memory, MiB")
    left.legend()
    figure.savefig(path, dpi=150)


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", nargs=2, metavar=("CASE", "WAY"), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help="folder for the table (JSON) and the plot")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds per row")
    options = parser.parse_args()
    if options.row:
        print(json.dumps(run_row(*options.row)))
        return
    import lmi_bounded_error
    import lmi_qpv

    rows = [("(51)", way) for way in lmi_bounded_error.ROWS]
    rows += [("QPV", way) for way in lmi_qpv.ROWS]
    rows += [(f"chain {k}", way) for way, entries in CHAIN.items() for k in entries]
    rows += [("proof", "2^14 of 28 x 28")]
    print(f"{'case':9} {'way':40} {'seconds':>10} {'x naive':>8} {'MiB':>6} {'objective':>11}")
    results = run_rows(rows, options.limit)
    print_targets(results)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "lmi.json").write_text(json.dumps(results, indent=1), encoding="utf-8")
        plot(results, options.out / "lmi.png")


if __name__ == "__main__":
    main()
