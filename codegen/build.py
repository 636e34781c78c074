"""Compile a generated project and compare it with its vectors, to the last bit."""

import os
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from obsynth.codegen.errors import BuildError, ComparisonError

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off")
"""Flags of every build."""

_CANDIDATES = ("cc", "gcc", "clang")
_SECONDS = 300

_DIFFERENCE = re.compile(
    r"first difference: vector (?P<vector>\d+), line (?P<line>\d+), output (?P<output>\S+),"
    r" expected (?P<expected>\S+) (?P<expected_value>\S+), computed (?P<computed>\S+)"
    r" (?P<computed_value>\S+)"
)
_SUMMARY = re.compile(
    r"(?P<vectors>\d+) vectors, (?P<values>\d+) values compared, (?P<differing>\d+) records differ"
)


@dataclass(frozen=True)
class Build:
    """How a project was compiled: what the compiler says of its version, and the flags."""

    compiler: str
    flags: tuple[str, ...]

    def __str__(self) -> str:
        return f"built by {self.compiler} with {' '.join(self.flags)}"


@dataclass(frozen=True)
class Comparison:
    """Numbers of steps and of values, each of which the compiled step gives to the last bit."""

    vectors: int
    values: int

    def __str__(self) -> str:
        return f"{self.vectors} steps, {self.values} values: equal to the last bit"


def find_compiler() -> tuple[str, ...] | None:
    """Return the command of a C compiler: ``CC``, else cc, gcc or clang; None without one."""
    wanted = shlex.split(os.environ.get("CC", ""))
    if wanted:
        if shutil.which(wanted[0]) is None:
            raise BuildError(
                f"the environment's CC names {wanted[0]!r}, which is no program on the path;"
                " correct CC, or unset it to take cc, gcc or clang",
                command=tuple(wanted),
                output="",
            )
        return tuple(wanted)
    for name in _CANDIDATES:
        if shutil.which(name) is not None:
            return (name,)
    return None


def build_and_compare(
    folder: str | os.PathLike[str],
    name: str,
    *,
    compiler: Sequence[str],
    extra_flags: Sequence[str] = ("-O2",),
    shared: tuple[Path, Path] | None = None,
) -> tuple[Build, Comparison]:
    """Compile library, test and example of a project elsewhere and run them.

    BuildError where the compiler rejects a file, ComparisonError where a result differs in any bit.

    name: its C name
    compiler: see `find_compiler`; extra_flags: flags besides `FLAGS`
    shared: a library to make of the object that was compared and of a further source file
    """
    project = Path(folder).absolute()
    flags = (*FLAGS, *extra_flags)
    with tempfile.TemporaryDirectory(prefix="obsynth-build-") as place:
        out = Path(place)
        test, example = out / "test", out / "example"
        source, library = project / "src" / f"{name}.c", out / f"{name}.o"
        command = [*compiler, *flags, f"-I{project / 'include'}"]
        built = [str(source), "-c", "-o", str(library)]
        _run([*command, *built], f"compiling {source.name}", out)
        tests = project / "tests"
        for program, sources in (
            (test, [tests / f"test_{name}.c", tests / "vectors_small.c"]),
            (example, [project / "examples" / "main.c"]),
        ):
            files = [*map(str, sources), str(library), "-o", str(program), "-lm"]
            _run([*command, *files], f"compiling {sources[0].name}", out)
        compared = _run(
            [str(test), str(project / "tests" / "vectors.txt")], "the test", out, (0, 1)
        )
        _run([str(example)], "the example", out)
        if shared is not None:
            target, more = shared
            files = ["-shared", "-s", str(more), str(library), "-o", str(target), "-lm"]
            _run([*command, *files], f"linking {target.name}", out)
    return Build(_version(compiler), flags), _read(compared, name)


def _run(command: Sequence[str], what: str, place: Path, accepted: tuple[int, ...] = (0,)) -> str:
    try:
        done = subprocess.run(
            command,
            cwd=place,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            timeout=_SECONDS,
            check=False,
        )
    except OSError as error:
        raise BuildError(
            f"{what}: {Path(command[0]).name} cannot be run here ({error.strerror}); where CC names"
            " a cross compiler, unset it to compare on this machine",
            command=tuple(command),
            output="",
        ) from error
    except subprocess.TimeoutExpired as error:
        raise BuildError(
            f"{what}: no end after {_SECONDS} s", command=tuple(command), output=""
        ) from error
    if done.returncode not in accepted:
        shown = "\n".join(done.stdout.splitlines()[:12])
        raise BuildError(
            f"{what} failed with code {done.returncode}:\n{shown}",
            command=tuple(command),
            output=done.stdout,
        )
    return done.stdout


def _version(compiler: Sequence[str]) -> str:
    try:
        done = subprocess.run(
            [*compiler, "--version"], capture_output=True, text=True, timeout=60, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return compiler[0]
    lines = done.stdout.splitlines()
    return lines[0].strip() if done.returncode == 0 and lines else compiler[0]


def _read(output: str, name: str) -> Comparison:
    summary = _SUMMARY.search(output)
    if summary is None:
        raise BuildError(f"the test of {name} ends without a summary:\n{output}", output=output)
    vectors, values, differing = (int(summary[key]) for key in ("vectors", "values", "differing"))
    if differing == 0:
        return Comparison(vectors, values)
    found = _DIFFERENCE.search(output)
    if found is None:
        raise BuildError(f"the test of {name} does not say what differs:\n{output}", output=output)
    raise ComparisonError(
        f"{name}: the compiled step differs from its vectors in {differing} of"
        f" {vectors} steps. First difference: vector {found['vector']} (line {found['line']} of"
        f" tests/vectors.txt), output {found['output']}: expected {found['expected']}"
        f" {found['expected_value']}, computed {found['computed']} {found['computed_value']}."
        " Look for flags that change arithmetic (-ffast-math, fused multiply-adds, 80 bit"
        " registers) in CC, and for edits of the sources",
        vector=int(found["vector"]),
        line=int(found["line"]),
        output=found["output"],
        expected=found["expected"],
        computed=found["computed"],
        differing=differing,
        vectors=vectors,
    )
