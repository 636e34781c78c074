"""What a wrong C program looks like to the comparison: every mutant has to be caught."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from obsynth.codegen import (
    BuildError,
    ComparisonError,
    build_and_compare,
    find_compiler,
    generate_c,
)
from obsynth.codegen import project as project_module

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

SOURCE, KERNEL = "src/two_tanks.c", "src/two_tanks_kernel.h"


@pytest.fixture(scope="module")
def original(make_toy: Callable[[], Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return generate_c(make_toy(), tmp_path_factory.mktemp("sound") / "p", vectors=1000).folder


@pytest.fixture
def sound(original: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(original, tmp_path / "p"))


def compare(folder: Path, *extra: str) -> Any:
    compiler = find_compiler()
    assert compiler is not None
    return build_and_compare(folder, "two_tanks", compiler=compiler, extra_flags=("-O2", *extra))


def mutate(folder: Path, file: str, pattern: str, replacement: str) -> None:
    path = folder / file
    text, count = re.subn(pattern, replacement, path.read_text(), count=1)
    assert count == 1, "the mutant has to be planted"
    path.write_text(text)


MUTANTS = {
    "flipped sign": (KERNEL, r"=\((a\d+)-(a\d+)\);", r"=(\1+\2);"),
    "swapped outputs": (
        SOURCE,
        r"result\.x_lower,\s+result\.x_upper",
        "result.x_upper, result.x_lower",
    ),
    "memory written before it is read": (
        SOURCE,
        r"two_tanks_real_t next\[TWO_TANKS_N_MEMORY\];",
        "two_tanks_real_t *next = memory;",
    ),
    "memory not kept": (SOURCE, r"two_tanks_set_memory\(state, next\);", "(void)next;"),
    "memory shifted by one": (SOURCE, r"= memory\[4 \+ i\]", "= memory[3 + i]"),
    "other default memory": (SOURCE, r"\b25\.5\b", "25.500000000000004"),
    "default memory never set": (
        SOURCE,
        r"(init_default\((?s:.*?))two_tanks_set_memory\(state, memory\);",
        r"\1(void)state; (void)memory;",
    ),
    "not initialised forgotten": (SOURCE, r"= \{0\};", "= {0.0, 1.0};"),
    "last bit of a constant": (KERNEL, r"=0\.9;", "=0.90000000000000013;"),
    "check that lets NaN through": (KERNEL, r"=\((a\d+)<=(a\d+)\);", r"=!(\1>\2);"),
    "infinity made finite": (KERNEL, r"INFINITY", "1.7976931348623157e308"),
    "other status bit": (KERNEL, r"=4\.;", "=8.;"),
    "status lost": (SOURCE, r"\(int\)status\[0\]", "0"),
    "fmax without NaN": (KERNEL, r"fmax\((a\d+),(a\d+)\)", r"(\1<\2 ? \2 : \1)"),
}


@pytest.mark.parametrize("mutant", MUTANTS.values(), ids=MUTANTS.keys())
def test_mutants_are_caught(sound: Path, mutant: tuple[str, str, str]) -> None:
    mutate(sound, *mutant)
    with pytest.raises(ComparisonError) as caught:
        compare(sound)
    error = caught.value
    assert error.differing > 0
    assert error.expected != error.computed
    assert re.fullmatch(r"[0-9a-f]{16}|[0-9a-f]{2}", error.expected)
    for fact in (f"vector {error.vector}", error.output, error.expected, error.computed):
        assert fact in str(error)


def test_the_first_difference_names_the_output(sound: Path) -> None:
    mutate(sound, *MUTANTS["swapped outputs"])
    with pytest.raises(ComparisonError) as caught:
        compare(sound)
    assert caught.value.vector == 0
    assert caught.value.output == "x_lower[0]"
    line = (sound / "tests/vectors.txt").read_text().splitlines()[caught.value.line - 1]
    fields = line.split()
    assert fields[0] == "S"
    # u, y (2), xhat (2), fhat come before x_lower; the first record has nothing to leave out
    numbers = [
        number for f in fields[2:] for number in ([f] if f[0] != "." else ["0"] * int(f[1:]))
    ]
    assert numbers[1 + 2 + 2 + 1].ljust(16, "0") == caught.value.expected


def test_one_fault_is_not_counted_in_every_later_step(sound: Path) -> None:
    mutate(sound, *MUTANTS["infinity made finite"])
    with pytest.raises(ComparisonError) as caught:
        compare(sound)
    lines = (sound / "tests/vectors.txt").read_text().splitlines()[1:]
    blind = sum(1 for line in lines if line.startswith("S") and int(line.split()[1]) & 2)
    assert 0 < caught.value.differing <= blind + 1, "and the self-test"


def test_a_wrong_memory_is_told_once(sound: Path) -> None:
    """What follows it is not compared until a memory is set. Mutant: `was_lost` always 0."""
    mutate(sound, KERNEL, r"=0\.9;", "=0.8;")
    with pytest.raises(ComparisonError) as caught:
        compare(sound)
    assert (caught.value.output, caught.value.vector) == ("memory[0]", 0)
    calls = (sound / "tests/vectors.txt").read_text().splitlines()[1:]
    assert 0 < caught.value.differing <= 1 + sum(1 for line in calls if line[0] in "NDM")


def test_the_self_test_runs_without_files_and_names_the_step(sound: Path, tmp_path: Path) -> None:
    """Alone, as on a target; no stdio. Mutants: a result not compared (`compare` that returns at
    once), a memory not loaded, `record` from 0 on."""
    text = (sound / "tests/vectors_small.c").read_text()
    assert not {"stdio", "stdlib", "fopen"} & set(re.findall(r"\w+", text))
    main = tmp_path / "main.c"
    main.write_text(
        "int two_tanks_selftest(void);\nint main(void) { return two_tanks_selftest(); }\n"
    )

    def answer() -> int:
        compiler = find_compiler()
        assert compiler is not None
        files = [str(main), *(str(sound / f) for f in (SOURCE, "tests/vectors_small.c"))]
        out = str(tmp_path / "self")
        flags = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror")
        subprocess.run(
            [*compiler, *flags, f"-I{sound}/include", *files, "-o", out, "-lm"], check=True
        )
        return subprocess.run([out], check=False).returncode

    assert answer() == 0
    few = re.search(r"vectors_small.c: (\d+) of", text)
    assert few is not None
    # the memory mixed, and a result of the last step
    for last in re.findall(r"0x\w+ULL", text)[-2:]:
        start, _, end = text.rpartition(last)
        other = f"0x{int(last[2:-3], 16) ^ 1:x}ULL"
        (sound / "tests/vectors_small.c").write_text(start + other + end)
        assert answer() == int(few[1]) > 30
    (sound / "tests/vectors_small.c").write_text(text)
    mutate(sound, KERNEL, r"=0\.9;", "=0.8;")
    assert answer() == 1


def fused() -> bool:
    try:
        return bool(re.search(r"\bfma\b", Path("/proc/cpuinfo").read_text()))
    except OSError:
        return False


@pytest.mark.skipif(not fused(), reason="no fused multiply-add in this processor")
def test_fused_multiply_adds_are_caught(sound: Path) -> None:
    """What the sources switch off is seen where they do not."""
    mutate(sound, SOURCE, r"#if defined\(__clang__\)(?s:.*?)#endif", "")
    with pytest.raises(ComparisonError, match="fused multiply-adds"):
        compare(sound, "-mfma", "-ffp-contract=fast")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda lines: lines[:-1], "number of steps"),
        (
            lambda lines: [lines[0].replace("two_tanks", "three_tanks"), *lines[1:]],
            "another project",
        ),
        (lambda lines: [lines[0].replace(" 6 1 2 ", " 6 1 3 "), *lines[1:]], "other sizes"),
        (lambda lines: [*lines[:-1], lines[-1][:-20]], "too early"),
        (lambda lines: [*lines[:-1], lines[-1] + "z"], "digit"),
        (lambda lines: [*lines, "X"], "none of S, N, D, M|too early"),
        (lambda lines: ["nothing"], "format|too early"),
    ],
)
def test_spoiled_vectors_do_not_pass(
    sound: Path, change: Callable[[list[str]], list[str]], word: str
) -> None:
    path = sound / "tests/vectors.txt"
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")
    with pytest.raises(BuildError, match=word):
        compare(sound)


def test_a_wrong_kernel_never_reaches_the_folder(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = generate_c(toy, tmp_path / "p", vectors=100)
    before = {name: (good.folder / name).read_bytes() for name in good.files}
    real = project_module.render

    def wrong(*arguments: Any, **options: Any) -> dict[str, str]:
        files = real(*arguments, **options)
        files[KERNEL] = files[KERNEL].replace("=0.9;", "=0.8;")
        return files

    monkeypatch.setattr(project_module, "render", wrong)
    with pytest.raises(ComparisonError, match="memory"):
        generate_c(toy, tmp_path / "p", vectors=100, overwrite=True)
    with pytest.raises(ComparisonError):
        generate_c(toy, tmp_path / "q", vectors=100)
    assert {name: (good.folder / name).read_bytes() for name in good.files} == before
    assert [p.name for p in tmp_path.iterdir()] == ["p"]


def test_a_runner_that_compares_less_is_noticed(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = project_module.render

    def lazy(*arguments: Any, **options: Any) -> dict[str, str]:
        files = real(*arguments, **options)
        name = "tests/test_two_tanks.c"
        files[name] = files[name].replace(
            '    compare("x_upper", at', '    if (0) compare("x_upper", at'
        )
        return files

    monkeypatch.setattr(project_module, "render", lazy)
    with pytest.raises(BuildError, match="the test compared"):
        generate_c(toy, tmp_path / "p", vectors=100)


def test_a_compiler_that_cannot_run_here_is_named(sound: Path, tmp_path: Path) -> None:
    cross = tmp_path / "cross-cc"
    target = tmp_path / "other"
    target.write_bytes(b"\x7fELF not for this machine")
    target.chmod(0o755)
    copy = shutil.which("cp")
    assert copy is not None
    cross.write_text(
        f'#!/bin/sh\nwhile [ "$1" != "-o" ]; do shift; done\nexec {copy} {target} "$2"\n'
    )
    cross.chmod(0o755)
    with pytest.raises(BuildError, match="cross compiler"):
        build_and_compare(sound, "two_tanks", compiler=(str(cross),))
