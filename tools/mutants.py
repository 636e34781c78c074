"""Plant mistakes in what guarantees rest on, one at a time, and print those that no test sees.

``mutants.toml`` beside this file lists mistakes (a file, the text that is changed, what it becomes,
the tests that have to fail), ``guards.toml`` the files in which `mutation` makes more of them, each
with its tests and what is left aside because it only steers or shows. What is made follows from the
words of the source and the seed alone. A test that hangs has seen its mutant; one that fails is run
once with nothing planted, where it has to pass. Mutants that change nothing say why; they are
counted and not planted.

    python tools/mutants.py                   # all listed ones, some made in every file
    python tools/mutants.py derive/rigour     # in files whose name has these words
    python tools/mutants.py derive/rigour/interval.py --each 20 --seed 7
    python tools/mutants.py --each 999 --again told.txt  # those that a run before says survive
"""

import argparse
import contextlib
import importlib
import importlib.util
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import ChainMap, Counter, deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from mutation import changes, pick

HERE = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")
HEAVY = (
    *("numpy", "scipy.optimize", "scipy.linalg", "sympy", "casadi", "mpmath", "flint", "clarabel"),
    *("pytest", "hypothesis"),
)
LISTS = [Path(__file__).with_name(name) for name in ("mutants.toml", "guards.toml")]
# Seconds of the processor and of the clock after which a run of tests counts as one that hangs, and
# bytes that it may take: an endless loop may grow.
BUSY, LIMIT, MEMORY = 120, 600.0, 2**33
PYTEST = ("-q", "-x", "-p", "no:cacheprovider", "-n", "0", "-m", "not long")


@dataclass(eq=False)
class Watch:
    """A plugin of pytest that runs first what has caught before, then what is quick.

    seconds: of tests, as far as known
    caught: how often a test has caught a mistake in a file
    """

    seconds: dict[str, float] = field(default_factory=dict)
    caught: Counter[str] = field(default_factory=Counter)
    last: str = ""

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        """Sort the tests."""
        items.sort(key=lambda i: (-self.caught[i.nodeid], self.seconds.get(i.nodeid, 0.0)))

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Note how long a test takes, or that it fails."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        self.last = report.nodeid if report.failed else self.last

    def pytest_sessionfinish(self) -> None:
        """Hand over what was seen."""
        Path("seen.json").write_text(json.dumps([self.seconds, self.last]))

    def learn(self, place: Path) -> str:
        """Take over what a child has seen; return the test that failed."""
        seen = place / "seen.json"
        seconds, last = json.loads(seen.read_text()) if seen.exists() else ({}, "")
        seen.unlink(missing_ok=True)
        self.seconds.update((k, v) for k, v in seconds.items() if k not in self.seconds)
        self.caught.update([last] if last else [])
        return last


@dataclass(frozen=True)
class Job:
    """Tests to run, in a file that reads otherwise if there is one.

    where, says: place and change of the mistake, for people
    why: reason for which no test can see it
    """

    tests: tuple[str, ...]
    file: str = ""
    text: str = ""
    where: str = ""
    says: str = ""
    why: str = ""

    def told_in(self, line: str) -> bool:
        """Whether a line of an earlier run is about it, wherever it stood in its file then."""
        return f" {self.file}:" in line and line.endswith(f" {self.says}")

    @property
    def room(self) -> str:
        """The folder that the table counts it for."""
        return "/".join(self.file.split("/")[:-1][:2])


def read(files: Iterable[Path]) -> dict[str, Any]:
    """Return what some lists hold together."""
    return dict(ChainMap(*(tomllib.loads(file.read_text()) for file in files)))


def listed(lists: dict[str, Any]) -> Iterator[Job]:
    """Mutants that are written down."""
    for entry in lists.get("mutant", []):
        source, was, becomes = (HERE / entry["file"]).read_text(), entry["was"], entry["becomes"]
        if source.count(was) != 1:
            raise SystemExit(f"{was!r} does not stand once in {entry['file']}")
        line = source[: source.index(was)].count("\n") + 1
        says = f"{' '.join(was.split())} -> {' '.join(becomes.split()) or 'nothing'}"
        text, why = source.replace(was, becomes), entry.get("why", "")
        yield Job(tuple(entry["tests"]), entry["file"], text, str(line), says, why)


def made(lists: dict[str, Any], each: int | None, seed: int) -> Iterator[tuple[int, Job]]:
    """Mutants made in the guarded files with their number in their file."""
    reasons = lists.get("equivalent", [])
    for guard in lists.get("guard", []):
        source, file = (HERE / guard["file"]).read_text(), guard["file"]
        chosen = pick(changes(source, set(guard.get("leave", ()))), seed, file)
        mine = [entry for entry in reasons if entry["file"] == file]
        for number, change in enumerate(islice(chosen, each or guard.get("each", 3))):
            why = next((entry["why"] for entry in mine if change.fits(entry)), "")
            where = f"{change.line} {change.function}"
            says = f"[{change.kind}] {change.was} -> {change.becomes}   in: {change.text}"
            job = Job(tuple(guard["tests"]), file, change.apply(source), where, says, why)
            yield number, job


def copied(place: Path) -> Path:
    """Copy what tests need of this checkout, links as links."""
    for name in (*ROOMS, "src", "tests", "tools"):
        ignored = shutil.ignore_patterns("__pycache__", ".hypothesis")
        shutil.copytree(HERE / name, place / name, symlinks=True, ignore=ignored)
    shutil.copy(HERE / "pyproject.toml", place)
    return place


def begin(place: Path, job: Job, watch: Watch) -> int:
    """Run tests in a child of this process, which has loaded what is heavy; return its number."""
    if job.file:
        (place / job.file).write_text(job.text)
        Path(importlib.util.cache_from_source(str(place / job.file))).unlink(missing_ok=True)
    child = os.fork()
    if child:
        return child
    code = 3
    try:
        os.setsid()
        os.chdir(place)
        resource.setrlimit(resource.RLIMIT_CPU, (BUSY, BUSY + 10))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        output = os.open("output.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        # bytecode of what is right is kept, that of a mutant never
        sys.dont_write_bytecode = bool(job.file)
        os.environ |= {"PYTHONPATH": str(place / "src"), "PYTHONDONTWRITEBYTECODE": "1"}
        sys.path.insert(0, str(place / "src"))
        # a failure is enough, the smallest one is not looked for
        hypothesis = importlib.import_module("hypothesis")
        phases = hypothesis.Phase.explicit, hypothesis.Phase.generate
        hypothesis.settings.register_profile("mutants", phases=phases, report_multiple_bugs=False)
        hypothesis.settings.load_profile("mutants")
        plugins = [Watch(watch.seconds, watch.caught)]
        code = int(importlib.import_module("pytest").main([*PYTEST, *job.tests], plugins))
    finally:
        os._exit(code)


def run(
    places: list[Path], jobs: deque[Job], watch: Watch
) -> Iterator[tuple[Job, int, float, str]]:
    """Run jobs, one in every copy at a time; yield return code (-1: too long), seconds, output.

    Where a test has failed, its name is the output. Jobs may be added in between.
    """
    free = list(places)
    running: dict[int, tuple[Job, Path, str, float]] = {}
    while True:
        while free and jobs:
            place, job = free.pop(), jobs.popleft()
            right = (place / job.file).read_text() if job.file else ""
            running[begin(place, job, watch)] = job, place, right, time.monotonic()
        if not running:
            return
        time.sleep(0.02)
        for child, (job, place, right, since) in list(running.items()):
            ended, status = os.waitpid(child, os.WNOHANG)
            spent = time.monotonic() - since
            if not ended and spent < LIMIT:
                continue
            code = os.waitstatus_to_exitcode(status) if ended else -1
            code = -1 if code in (-signal.SIGXCPU, -signal.SIGKILL) else code
            # what the tests have started ends with them
            with contextlib.suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            if not ended:
                os.waitpid(child, 0)
            if job.file:
                (place / job.file).write_text(right)
            del running[child]
            free.append(place)
            yield job, code, spent, watch.learn(place) or (place / "output.txt").read_text()


def main(arguments: list[str] | None = None) -> int:
    """Plant the mutants that are asked for and print the survivors."""
    form = argparse.RawTextHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=form)
    parser.add_argument("words", nargs="?", default="", help="in the file's name")
    parser.add_argument("--each", type=int, help="made in every file, or as listed")
    parser.add_argument("--seed", type=int, default=0, help="which are made")
    parser.add_argument("--most", type=int, default=10**6, help="mutants at most")
    parser.add_argument("--minutes", type=float, default=60.0, help="none is planted later")
    parser.add_argument("--workers", type=int, default=2, help="copies of the checkout")
    parser.add_argument("--again", type=Path, help="what a run printed: its survivors alone")
    parser.add_argument("--list", type=Path, nargs="*", default=LISTS, help="instead of ours")
    asked = parser.parse_args(arguments)
    began, lists = time.monotonic(), read(asked.list)
    found = made(lists, asked.each, asked.seed)
    everything = [*listed(lists), *(job for _, job in sorted(found, key=lambda f: f[0]))]
    chosen = [job for job in everything if asked.words in job.file][: asked.most]
    if asked.again:
        before = [line for line in asked.again.read_text().splitlines() if "SURVIVES" in line]
        chosen = [job for job in chosen if any(map(job.told_in, before))]
    told = [job for job in chosen if job.why]
    for name in HEAVY:
        importlib.import_module(name)
    late, alive, table = 0, [], Counter((job.room, "explained") for job in told)
    with tempfile.TemporaryDirectory() as name:
        places = [copied(Path(name) / str(k)) for k in range(asked.workers)]
        watch, sound = Watch(), set[str]()
        jobs = deque(job for job in chosen if not job.why)
        for job, code, spent, output in run(places, jobs, watch):
            if code not in (-1, 0, 1, 2):
                raise SystemExit(f"{' '.join(job.tests)} did not run:\n{output[-3000:]}")
            if not job.file and code:
                raise SystemExit(f"{job.tests[0]} fails with nothing planted")
            if time.monotonic() - began > 60.0 * asked.minutes:
                late += len(jobs)
                jobs.clear()
            if not job.file:
                continue
            test = output if code == 1 and output in watch.seconds else ""
            if test and test not in sound:
                # what catches has to pass where nothing is planted
                sound.add(test)
                jobs.appendleft(Job((test,)))
            by = f"caught by {test.split('::')[-1] or 'the import'}:"
            word = {0: "SURVIVES", -1: "too long"}.get(code, by)
            alive += [job] if code == 0 else []
            table[job.room, "planted"] += 1
            table[job.room, "survive"] += code == 0
            print(f"{spent:5.1f} s  {word} {job.file}:{job.where} {job.says}", flush=True)
    columns = ("planted", "survive", "explained")
    print(f"\n{'room':24}" + "".join(f"{column:>12}" for column in columns))
    for room in [*sorted({room for room, _ in table}), "all"]:
        counts = (
            sum(table[r, c] for r, _ in {k for k in table if k[1] == c} if room in (r, "all"))
            for c in columns
        )
        print(f"{room:24}" + "".join(f"{count:12}" for count in counts))
    for job in alive:
        print(f"survives: {job.file}:{job.where} {job.says}")
    for job in told:
        print(f"changes nothing: {job.file}:{job.where} {job.says}: {job.why}")
    print(f"{late} not planted for want of time" if late else f"{time.monotonic() - began:.0f} s")
    return 1 if alive else 0


if __name__ == "__main__":
    sys.exit(main())
