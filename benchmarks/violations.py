"""What do observers say when an assumption breaks for a while, and how soon are they right again?

Glitches up to 1e20, drop-outs, excursions beyond the box, fault jumps and bursts of disturbances,
for an observer of every method. Counted are samples with status 0 and a set that misses the
truth. Prints one table; nothing may stand in the columns "unbroken", "after" and "late".

Usage: python benchmarks/violations.py [trials of each kind, 60] [part of a case's name]
"""

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from violations import CASES, KINDS, campaign

from obsynth.symbolic import Table


def main(count=60, part=""):
    """Run the campaign and print its table."""
    rows, start = [], time.perf_counter()
    for name in (name for name in CASES if part in name):
        found = campaign(name, count)
        for kind in (kind for kind in KINDS if kind in found):
            c = found[kind]
            numbers = [c.unbroken, c.after, c.late, c.before, c.never, c.longest, c.flagged]
            rows.append([name, kind, c.trials, *numbers, *c.recovery, c.lasting])
    heads = ["observer", "kind", "trials", "unbroken", "after", "late", "before", "never"]
    heads += ["longest", "flagged", "recovery", "at most", "lasting"]
    title = f"Samples with status 0 and a set that misses the truth, {count} trials of each kind"
    rows.append(["all", "", sum(r[2] for r in rows)])
    rows[-1] += [sum(r[i] for r in rows[:-1]) for i in range(3, 8)]
    rows[-1] += [max(r[8] for r in rows[:-1]), sum(r[9] for r in rows[:-1]), "", "", ""]
    print(Table(title, heads, rows))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main(*(int(a) if a.isdigit() else a for a in sys.argv[1:]))
