"""Prove and search the C of every method (backend "tape") with other people's tools.

python tools/prove [parts of names] [--long] [--workers 2] [--fuzz 10]
"""

import argparse
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing import Pool
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent.parent / "tests")]

from checks import Project, Said, compilers, eva, fuzz, misra, numbers  # noqa: E402

import obsynth as ob  # noqa: E402
from methods import METHODS, SINGLE, observer_of  # noqa: E402
from obsynth.codegen.description import describe  # noqa: E402
from obsynth.codegen.drive import Drive  # noqa: E402
from obsynth.codegen.single import machine_of  # noqa: E402

DETECTOR = "detector with window"
PLANTED = "luenberger"
FUZZED = ("bounded_error_uio", "interval_observer", DETECTOR)
"""Those that `make prove` fuzzes; --long fuzzes all."""
SINGLES = ("bounded_error_uio", "set_adaptive_observer")
"""Those that `make prove` takes in single precision too; --long takes all."""
SEEDS = 64
# Over the box no operation gives NaN, which Eva shows of these.
NUMBERS = frozenset(
    {"general_uio", "general_uio.l2", "hinf_uio", "interval_observer", "luenberger"}
)
LONG_NUMBERS = frozenset({"set_adaptive_observer"})

# What is planted in a project, by what has to see it: file, text, what stands there then.
CALL = r"= (NAME_kernel\(state, in, out\));"
PLANTS: dict[str, tuple[str, str, str]] = {
    "index out of range": ("eva", r"i < 2; \+\+i", "i <= 2; ++i"),
    "local not initialised": (
        "eva",
        rf"const (NAME_real_t status) {CALL}",
        r"\1;\n    if (in->y[0] > 0.0) {\n        status = \2;\n    }",
    ),
    "status beyond int": ("eva", r"return \(.*;", "return (int)(status * 1e9);"),
    "division by zero": ("box", CALL, r"= \1 / (in->y[0] - in->y[0]);"),
    "ends out of order": (
        "fuzz",
        r"\n    /\* Converting",
        r"\n    if (in->y[0] > 20.0) {\n        out->x_lower[0] = INFINITY;\n    }\n\g<0>",
    ),
    "essential types": ("misra", r"return \(.*;", r"return (status > 0.0) + 'a';"),
    "unused": ("compilers", CALL, r"= \1;\n    int unused = 3;"),
}


def observer_for(what: str) -> Any:
    """Return the observer of a method, or a detector."""
    if what == DETECTOR:
        return ob.FaultDetector(observer_of("bounded_error_uio"), persistence=3, window=5)
    return observer_of(what)


def generated(what: str, place: Path) -> Project:
    """Generate a project, and run its step along the plant for what a fuzzer begins from."""
    observer = observer_for(what)
    name = re.sub(r"\W+", "_", f"p_{what}")
    ob.generate_c(observer, place / "project", name=name, backend="tape", vectors=100)
    description, rng = describe(observer), np.random.default_rng(0)
    step = machine_of(observer.step, description.real)
    drive, rows = Drive(description, rng), list[np.ndarray]()
    memory = drive.begin(SEEDS)
    memory = description.start if memory is None else memory
    for k in range(SEEDS):
        inputs = drive.sample(k)
        rows.append(np.concatenate([memory, *inputs]))
        memory = step(memory, *inputs)[0]
    return Project(place / "project", name, np.array(rows, dtype=description.real.type))


def checked(what: str, long: bool, seconds: int) -> Iterator[tuple[str, str, Said, bool]]:
    """Yield (project, check, what was said, whether that is wrong)."""
    with tempfile.TemporaryDirectory(prefix="obsynth-prove-") as place:
        project = generated(what, Path(place))
        checks: dict[str, Callable[[], Said]] = {
            "numbers": lambda: numbers(project),
            "eva": lambda: eva(project),
            "misra": lambda: misra(project),
            "compilers": lambda: compilers(project),
        }
        if what in (NUMBERS | LONG_NUMBERS if long else NUMBERS):
            checks["box"] = lambda: eva(project, box=True)
        if long or what in FUZZED:
            checks["fuzz"] = lambda: fuzz(project, seconds)
        for name, check in checks.items():
            said = check()
            yield what, name, said, said.found != 0


def planted(bug: str, seconds: int) -> tuple[str, str, Said, bool]:
    """Plant a bug; wrong where the check that has to see it does not."""
    who, old, new = PLANTS[bug]
    with tempfile.TemporaryDirectory(prefix="obsynth-prove-") as place:
        project = generated(PLANTED, Path(place))
        before = project.source.read_text()
        text, count = re.subn(old.replace("NAME", project.name), new, before, count=1)
        assert count, bug
        project.source.write_text(text)
        checks = {"misra": misra, "compilers": compilers, "eva": eva}
        checks |= {"box": lambda p: eva(p, box=True), "fuzz": lambda p: fuzz(p, seconds)}
        said = checks[who](project)
        return bug, who, said, said.found <= 0


@dataclass(frozen=True)
class Row:
    """One check of one project; wrong where it found something, or nothing of what was planted."""

    what: str
    check: str
    said: Said
    wrong: bool
    seconds: float

    def __str__(self) -> str:
        told = self.said.text if self.check == "fuzz" and not self.said.found else ""
        told += "  WRONG" if self.wrong else ""
        return f"{self.what:32} {self.check:10} {self.said!s:>6} {self.seconds:6.1f}  {told}"


def _job(job: tuple[str, bool, int]) -> list[Row]:
    what, long, seconds = job
    found, since = [], time.monotonic()
    rows = iter([planted(what, seconds)]) if what in PLANTS else checked(what, long, seconds)
    for row in rows:
        now = time.monotonic()
        found.append(Row(*row, now - since))
        print(found[-1], file=sys.stderr, flush=True)
        since = now
    return found


def main() -> int:
    """Print a table; return 1 where something was found, or a planted bug was not."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", default=[""], help="of names; all by default")
    parser.add_argument("--long", action="store_true", help="all boxes, the fuzzer on everything")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--fuzz", type=int, default=10, help="seconds of the fuzzer")
    args = parser.parse_args()
    singles = [name + SINGLE for name in (METHODS if args.long else SINGLES)]
    known = (*METHODS, *singles, DETECTOR, *PLANTS)
    names = [what for what in known if any(part in what for part in args.parts)]
    # those that take longest first
    jobs = sorted(names, key=lambda what: ("set" not in what, "detector" not in what))
    begun, rows = time.monotonic(), list[Row]()
    with Pool(args.workers) as pool:
        given = [(what, args.long, args.fuzz) for what in jobs]
        for some in pool.imap_unordered(_job, given):
            rows += some
    rows.sort(key=lambda row: names.index(row.what))
    print(f"{'project':32} {'check':10} {'found':>6} {'s':>6}", *rows, sep="\n")
    wrong = [row for row in rows if row.wrong]
    for row in wrong:
        print(f"\n{row.what}, {row.check}: {row.said.found}\n{row.said.text}")
    print(f"{len(rows)} checks, {len(wrong)} wrong, {time.monotonic() - begun:.0f} s")
    return int(bool(wrong) or not rows)


if __name__ == "__main__":
    sys.exit(main())
