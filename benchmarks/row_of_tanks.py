"""How the design of n tanks in a row grows: 2^n vertices, one square root each.

    python benchmarks/row_of_tanks.py [--out FOLDER] [--limit SECONDS] [--largest N]

Through public names: `BoundedErrorUIO` with peak bounds and ellipsoids, derivation and proof
included, and beside them the paper's LMI at all vertices as cvxpy states and solves it (Clarabel),
at the gamma that the ellipsoid was found for, derivation included, proof not. Every row runs in a
process of its own; imports do not count.
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

ROWS = {
    "peak": (2, 4, 5, 8, 16, 32, 64),
    "ellipsoid": (2, 4, 5, 8, 16),
    "naive cvxpy": (2, 4, 5, 6, 8, 10),
}
# Targets of the project, in seconds: (way, n) -> seconds on one quiet core.
TARGETS = {
    ("peak", 16): 10.0,
    ("peak", 64): 120.0,
    ("ellipsoid", 5): 1.0,
    ("ellipsoid", 16): 30.0,
}


def plant_of(n: int) -> Any:
    """N tanks in a row, sampled."""
    import obsynth as ob

    return ob.plants.tanks_in_a_row(n).discretise("euler", Ts=0.5)


def run_row(way: str, n: int, gamma: float | None) -> dict[str, Any]:
    """One row, in this process."""
    for heavy in ("clarabel", "cvxpy", "scipy.optimize"):
        importlib.import_module(heavy)
    import obsynth as ob

    model = plant_of(n)
    start = time.perf_counter()
    if way == "naive cvxpy":
        problem = ob.BoundedErrorUIO(gamma=gamma, form="corrected").problem(model).to_cvxpy()
        problem.solve(solver="CLARABEL")
        row: dict[str, Any] = {"note": f"{problem.status} at gamma {gamma:.3g}, not proved"}
    else:
        observer = ob.BoundedErrorUIO(bounds=way, form="general").design(model)
        half = observer.performance["core_half_widths"]
        row = {
            "note": f"certified, f within {half[-1]:.4f} of .5",
            "gamma": observer.performance.get("gamma"),
        }
    row["seconds"] = time.perf_counter() - start
    row["peak_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return row


def fresh(way: str, n: int, gamma: float | None, limit: float) -> dict[str, Any]:
    """One row in a process of its own, stopped at a limit."""
    command = [sys.executable, __file__, "--row", way, str(n), str(gamma or 0.0)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=limit)
        row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    except subprocess.TimeoutExpired:
        row = {"seconds": None, "note": f"over {limit:.0f} s"}
    except (IndexError, json.JSONDecodeError):
        row = {"seconds": None, "note": (done.stderr or "died").strip()[-100:]}
    return row | {"way": way, "n": n}


def print_row(row: dict[str, Any], naive: dict[int, float]) -> None:
    """One line of the table, with the ratio to the naive way where that was measured."""
    seconds = row["seconds"]
    shown = f"{seconds:9.2f}" if seconds is not None else f"{'-':>9}"
    ratio = f"{naive[row['n']] / seconds:8.1f}" if seconds and row["n"] in naive else " " * 8
    peak = f"{row['peak_mib']:7.0f}" if "peak_mib" in row else " " * 7
    target = TARGETS.get((row["way"], row["n"]))
    verdict = ""
    if target is not None:
        verdict = f"target {target:.0f} s: "
        met = seconds is not None and seconds <= target
        verdict += "not measured" if seconds is None else "met" if met else "MISSED"
    print(f"{row['way']:12} {row['n']:4d} {shown} {ratio} {peak}  {row['note']}  {verdict}")


def main() -> None:
    """Read the command line and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--row", nargs=3, metavar=("WAY", "N", "GAMMA"), help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help="folder for the table (JSON)")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds per row")
    parser.add_argument("--largest", type=int, default=64, help="largest number of tanks")
    options = parser.parse_args()
    if options.row:
        way, n, gamma = options.row
        print(json.dumps(run_row(way, int(n), float(gamma) or None)))
        return
    print(f"{'way':12} {'n':>4} {'seconds':>9} {'x naive':>8} {'MiB':>7}")
    results, naive, gammas = [], {}, {}
    for n in ROWS["ellipsoid"] + (6, 10):
        if n <= options.largest and n not in gammas:
            row = fresh("ellipsoid", n, None, options.limit)
            gammas[n] = row.get("gamma")
            results.append(row)
    for n in ROWS["naive cvxpy"]:
        if n <= options.largest and gammas.get(n):
            row = fresh("naive cvxpy", n, gammas[n], options.limit)
            results.append(row)
            if row["seconds"]:
                naive[n] = row["seconds"]
    rows = [n for n in ROWS["peak"] if n <= options.largest]
    results += [fresh("peak", n, None, options.limit) for n in rows]
    for row in sorted(results, key=lambda r: (r["way"], r["n"])):
        print_row(row, naive)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "row_of_tanks.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
