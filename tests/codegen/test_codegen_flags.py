"""Flags that change arithmetic: refused, without effect, or seen by the vectors."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from obsynth.codegen import ComparisonError, build_and_compare, generate_c

CLANG = next(filter(shutil.which, ("clang", "clang-14")), "clang")
COMPILERS = [name for name in ("gcc", CLANG) if shutil.which(name)]
BACKENDS = (pytest.param("casadi", marks=pytest.mark.long), "tape")

REFUSED = {
    "gcc": (
        "-ffast-math",
        "-Ofast -fno-finite-math-only",
        "-fassociative-math -fno-signed-zeros -fno-trapping-math",
        "-funsafe-math-optimizations",
        "-freciprocal-math",
        "-ffinite-math-only",
        "-fno-signed-zeros",
        "-mfpmath=387",
        "-fsingle-precision-constant",
    ),
    CLANG: ("-ffast-math", "-ffinite-math-only"),
}
HARMLESS = {
    "gcc": (
        "-std=gnu17 -O3 -march=native -ffp-contract=fast",
        "-Os -flto -march=native -ffp-contract=fast",
        "-O2 -frounding-math -fno-math-errno",
    ),
    CLANG: (
        "-Ofast -fno-finite-math-only -march=native -ffp-contract=on",
        "-O2 -fassociative-math -fno-signed-zeros -fno-trapping-math",
        "-O2 -freciprocal-math -fno-honor-nans",
        "-O2 -fapprox-func -fno-honor-infinities",
    ),
}


def cases(table: dict[str, tuple[str, ...]]) -> list[tuple[str, str]]:
    return [(name, flags) for name in COMPILERS for flags in table[name]]


@pytest.fixture(scope="module", params=BACKENDS)
def project(
    request: pytest.FixtureRequest,
    make_toy: Callable[[], Any],
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """Without a build: nothing here depends on what the machine's own compiler does."""
    folder: Path = tmp_path_factory.mktemp("flags") / "p"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
        generate_c(make_toy(), folder, vectors=1000, backend=request.param)
    return folder


@pytest.mark.parametrize(("compiler", "flags"), cases(REFUSED))
def test_flags_that_leave_a_trace_are_refused(project: Path, compiler: str, flags: str) -> None:
    """Mutants: any of the macros not asked for (one is never alone: associative)."""
    command = [compiler, "-Iinclude", "-fsyntax-only", *flags.split(), "src/two_tanks.c"]
    done = subprocess.run(command, cwd=project, capture_output=True, text=True)
    assert done.returncode
    assert re.search(r"error: (#error )?\W?two_tanks: -ff|kept in their own|64_bits", done.stderr)


@pytest.mark.parametrize(("compiler", "flags"), cases(HARMLESS))
def test_flags_that_leave_none_change_nothing(project: Path, compiler: str, flags: str) -> None:
    """Mutants: without `optimize` and without `float_control` these results differ."""
    told = build_and_compare(
        project, "two_tanks", compiler=(compiler,), extra_flags=("-w", *flags.split())
    )
    assert told[1].vectors == 1000


@pytest.mark.skipif(CLANG not in COMPILERS, reason="no clang")
def test_what_no_source_can_switch_off_is_seen(project: Path) -> None:
    with pytest.raises(ComparisonError, match="fused multiply-adds"):
        build_and_compare(
            project,
            "two_tanks",
            compiler=(CLANG,),
            extra_flags=("-w", "-O2", "-mfma", "-ffp-contract=fast"),
        )
    assert "-ffp-contract=fast" in (project / "README.md").read_text()
