"""Run the C of every method on Cortex-M3, M4F and M7 under QEMU, beside CasADi's machine.

python tools/firmware [part of a method] [--workers 2] [--backend tape]
"""

import argparse
import itertools
import json
import re
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent / "tests")]

from boards import (  # noqa: E402
    CORES,
    RECORDS,
    SOFT,
    Ran,
    apart,
    compiler,
    emulator,
    recorded,
    run,
    softened,
)

import obsynth as ob  # noqa: E402
from methods import METHODS, SINGLE, observer_of, tank  # noqa: E402
from obsynth.codegen.folder import MANIFEST  # noqa: E402

TANKS, DETECTOR = "four tanks, peak", ", detector"
LIBRARY_ULPS = 64
"""By how much results may differ where sin, cos, ... are the library's: 8 units each, and what a
step makes of them."""


@dataclass(frozen=True, eq=False)
class Row:
    """One project on one board; `ulps` (N, n) from CasADi's machine, of which some are allowed."""

    what: str
    core: str
    ran: Ran
    ulps: np.ndarray
    allowed: float

    @property
    def wrong(self) -> bool:
        """Whether a number, or a step of the self-test, differs by more than the library may."""
        differs = self.ran.selftest > 0 and not self.allowed
        return differs or bool(self.ulps.max() > self.allowed)

    def __str__(self) -> str:
        ran, differ = self.ran, int(self.ulps.any(axis=1).sum())
        told = f" of {self.allowed:.0f}" if self.allowed else ""
        told += f", self-test: step {ran.selftest}" if ran.selftest else ""
        return (
            f"{self.what:28} {self.core:4} {ran.text:7} {ran.stack:6} {ran.instructions:9.0f} "
            f"{differ:7} {self.ulps.max():5.0f}{told}{'  WRONG' if self.wrong else ''}"
        )


def observers() -> Iterator[str]:
    """Name all that is run: every method in both precisions, the four tanks, detectors."""
    for name in METHODS:
        yield from (name, name + SINGLE)
    yield from (TANKS, TANKS + SINGLE, TANKS + DETECTOR, "set_membership" + DETECTOR)


def make(what: str) -> Any:
    """Return the observer, or the detector, of that name."""
    of = what.removesuffix(DETECTOR)
    if of.removesuffix(SINGLE) == TANKS:
        precision: Any = "single" if SINGLE in of else "double"
        observer = ob.BoundedErrorUIO(bounds="peak", precision=precision).design(tank())
    else:
        observer = observer_of(of)
    return ob.FaultDetector(observer, window=5) if DETECTOR in what else observer


def planted(kernel: Path) -> None:
    """Change the most frequent of the long constants of a kernel to the next number."""
    text = kernel.read_text()
    (old, _), *_ = Counter(re.findall(r"\b0\.\d{12,}\b", text)).most_common()
    kernel.write_text(text.replace(old, repr(float(np.nextafter(float(old), 9.0)))))


def rows(what: str, backend: Any, mutant: bool = False) -> list[Row]:
    """Generate, build and run one project on every board."""
    observer = make(what)
    given, made = recorded(observer)
    soft = made if SINGLE in what else softened(observer, given)
    with tempfile.TemporaryDirectory(prefix="obsynth-firmware-") as place:
        folder = Path(place) / "project"
        writer = "tape" if SINGLE in what else backend
        name = ob.generate_c(observer, folder, backend=writer, vectors=100).name
        library = json.loads((folder / MANIFEST).read_text())["not_defined_to_the_last_bit"]
        if mutant:
            planted(folder / "src" / f"{name}_kernel.h")
        found = []
        for core in CORES:
            files = folder / "src" / f"{name}.c", folder / "tests" / "vectors_small.c"
            ran = run(core, name, files, [folder / "include"], given, made.shape[1])
            ulps = apart(soft if core in SOFT else made, ran.found)
            found.append(Row(what, core, ran, ulps, LIBRARY_ULPS if library else 0))
    return found


def main() -> int:
    """Print the table; return 1 where something differs, or a planted mistake does not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("part", nargs="?", default="", help="of a name; all by default")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--backend", default="tape")
    args = parser.parse_args()
    names = [what for what in observers() if args.part in what]
    with Pool(args.workers) as pool:
        # those that take longest stand last in the table
        jobs = {what: pool.apply_async(rows, (what, args.backend)) for what in names[::-1]}
        changed = pool.apply_async(rows, ("luenberger", "tape", True))
        found = {what: jobs[what].get() for what in names}
        seen = all(row.wrong for row in changed.get())
    print(f"-std=gnu17 -O2, {args.backend}, {RECORDS} steps; {compiler()}, {emulator()}")
    print(f"{'':28} {'':4} {'text':>7} {'stack':>6} {'instr.':>9} {'differ':>7} {'ulps':>5}")
    table = [*itertools.chain(*found.values())]
    print("\n".join(map(str, table)))
    print("a constant changed by one unit in the last place", "is seen" if seen else "IS NOT SEEN")
    return int(not seen or any(row.wrong for row in table))


if __name__ == "__main__":
    sys.exit(main())
