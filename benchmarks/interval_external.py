"""How wide is the interval observer beside other set observers on an example of the literature?

Alamo, Bravo, Camacho, "Guaranteed state estimation by zonotopes", Automatica 41(6), 2005, section
7.1. The hull of the exact feasible set and that of the zonotopic Kalman filter (Combastel 2015) at
the last of 20 measurements are those of the tests of CORA. Run as

    python benchmarks/interval_external.py
"""

import runpy
from pathlib import Path

import numpy as np

import obsynth as ob

CASE = Path(__file__).parents[1] / "tests" / "designs" / "interval" / "test_alamo.py"
VARIANTS = {
    "interval observer (default)": {},
    "without contraction": {"contraction": False},
    "gains by Sylvester": {"gains": "sylvester"},
    "single precision": {"precision": "single"},
}


def main() -> None:
    """Print one row per method."""
    case = runpy.run_path(str(CASE))
    rows = {"exact feasible set": case["LAST"], "zonotopic Kalman": case["ZONOTOPIC_KALMAN"]}
    for name, options in VARIANTS.items():
        observer = ob.IntervalObserver(**options).design(case["plant"]())
        rows[name] = case["sets"](observer, case["MEASUREMENTS"])[-1]
    exact = np.diff(case["LAST"]).sum()
    print(f"{'':28s} {'x1':>20s} {'x2':>20s} {'sum of widths':>14s} {'/ exact':>8s}")
    for name, hull in rows.items():
        ends = " ".join(f"[{low:8.4f}, {high:8.4f}]" for low, high in hull)
        total = float(np.diff(hull).sum())
        print(f"{name:28s} {ends} {total:14.4f} {total / exact:8.3f}")


if __name__ == "__main__":
    main()
