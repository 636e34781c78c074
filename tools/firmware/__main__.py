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

from boards import CORES, Ran, apart, compiler, emulator, run  # noqa: E402

import obsynth as ob  # noqa: E402
from methods import METHODS, observer_of, tank  # noqa: E402
from obsynth.codegen.description import describe  # noqa: E402
from obsynth.codegen.folder import MANIFEST  # noqa: E402
from obsynth.codegen.kernel import Machine  # noqa: E402
from obsynth.codegen.vectors import Drive  # noqa: E402
from obsynth.designs.core.observer import STEP_OUTPUTS  # noqa: E402

RECORDS, TIMED, SPOILT = 256, 64, 4
"""Steps, how many of them are counted, and every which of the others has entries spoilt."""
LIBRARY_ULPS = 64
"""By how much results may differ where sin, cos, ... are the library's: 8 units each, and what a
step makes of them."""
_EXTREMES = np.array([np.nan, np.inf, -np.inf, 1e300, -1e300, 5e-324, -0.0, 0.0])


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
        """Whether a number differs by more than the mathematics library may."""
        return bool(self.ulps.max() > self.allowed)

    def __str__(self) -> str:
        ran, differ = self.ran, int(self.ulps.any(axis=1).sum())
        told = f" of {self.allowed:.0f}" if self.allowed else ""
        return (
            f"{self.what:28} {self.core:4} {ran.text:7} {ran.stack:6} {ran.instructions:9.0f} "
            f"{differ:7} {self.ulps.max():5.0f}{told}{'  WRONG' if self.wrong else ''}"
        )


def observers() -> Iterator[str]:
    """Name all that is run: every method, the four tanks' peak bounds, detectors."""
    yield from METHODS
    yield "four tanks, peak"
    yield "four tanks, peak, detector"
    yield "set_membership, detector"


def make(what: str) -> Any:
    """Return the observer, or the detector, of that name."""
    of, *detects = what.removesuffix(", detector"), *([1] if what.endswith("detector") else [])
    if of == "four tanks, peak":
        observer = ob.BoundedErrorUIO(bounds="peak").design(tank())
    else:
        observer = observer_of(of)
    return ob.FaultDetector(observer, window=5) if detects else observer


def recorded(observer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return states with inputs, and what a step makes of them on CasADi's machine.

    Along trajectories of the plant; behind the timed ones a number of one in `SPOILT` is extreme.
    """
    description, rng = describe(observer), np.random.default_rng(0)
    step, drive = Machine(observer.step), Drive(description, rng)
    status = STEP_OUTPUTS.index("status")
    given, made = [], []
    for k in range(RECORDS):
        if k % TIMED == 0:
            begun = drive.begin(TIMED)
            memory = description.start if begun is None else begun
        parts = [memory, *drive.sample(k % TIMED)]
        row = np.concatenate(parts)
        if k >= TIMED and k % SPOILT == 0:
            first = memory.size if k % (2 * SPOILT) else 0
            row[rng.integers(first, row.size)] = rng.choice(_EXTREMES)
        results = step(*np.split(row, np.cumsum([part.size for part in parts[:-1]])))
        memory, reported = results[0], results.pop(status)
        given.append(row)
        made.append(np.concatenate([*results[1:], reported, memory]))
    return np.array(given), np.array(made)


def planted(kernel: Path) -> None:
    """Change the most frequent of the long constants of a kernel to the next number."""
    text = kernel.read_text()
    (old, _), *_ = Counter(re.findall(r"\b0\.\d{12,}\b", text)).most_common()
    kernel.write_text(text.replace(old, repr(float(np.nextafter(float(old), 9.0)))))


def rows(what: str, backend: Any, mutant: bool = False) -> list[Row]:
    """Generate, build and run one project on every board."""
    observer = make(what)
    given, made = recorded(observer)
    with tempfile.TemporaryDirectory(prefix="obsynth-firmware-") as place:
        folder = Path(place) / "project"
        name = ob.generate_c(observer, folder, backend=backend, vectors=100).name
        library = json.loads((folder / MANIFEST).read_text())["not_defined_to_the_last_bit"]
        if mutant:
            planted(folder / "src" / f"{name}_kernel.h")
        found = []
        for core in CORES:
            source, include = [folder / "src" / f"{name}.c"], [folder / "include"]
            ran = run(core, name, source, include, given, made.shape[1], TIMED)
            found.append(
                Row(what, core, ran, apart(made, ran.found), LIBRARY_ULPS if library else 0)
            )
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
        changed = pool.apply_async(rows, ("luenberger", args.backend, True))
        found = {what: jobs[what].get() for what in names}
        seen = all(row.wrong for row in changed.get())
    print(f"-O2 -ffp-contract=off, {args.backend}, {RECORDS} steps; {compiler()}, {emulator()}")
    print(f"{'':28} {'':4} {'text':>7} {'stack':>6} {'instr.':>9} {'differ':>7} {'ulps':>5}")
    for row in itertools.chain(*found.values()):
        print(row)
    print("a constant changed by one unit in the last place", "is seen" if seen else "IS NOT SEEN")
    return int(not seen or any(row.wrong for row in itertools.chain(*found.values())))


if __name__ == "__main__":
    sys.exit(main())
