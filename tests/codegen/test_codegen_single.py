"""Single precision: what is written, what it is compared with, what is refused."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen import (
    CodegenError,
    ComparisonError,
    build_and_compare,
    generate_c,
    generate_fmu,
)
from obsynth.codegen.kernel import SINGLE
from obsynth.codegen.single import SingleMachine

WARNINGS = ("-Wconversion", "-Wdouble-promotion", "-Wfloat-conversion", "-Wshadow")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", *WARNINGS)
COMPILERS = [name for name in ("gcc", "clang-14") if shutil.which(name)]
CROSS = "arm-none-eabi-gcc"

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")


@pytest.fixture(scope="module")
def project(make_single: Callable[[], Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project in single precision, nothing compiled yet."""
    folder: Path = tmp_path_factory.mktemp("single") / "p"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
        generate_c(make_single(), folder, vectors=500)
    return folder


@pytest.mark.parametrize("compiler", COMPILERS)
def test_it_is_clean_and_equal(project: Path, compiler: str) -> None:
    """No warning of any file, every bit of the vectors, under either compiler."""
    for level in (("-O0",), ("-O3", "-march=native")):
        flags = (*STRICT, *level)
        _, told = build_and_compare(project, "two_tanks", compiler=(compiler,), extra_flags=flags)
        assert told.vectors == 500


def test_it_says_so(project: Path) -> None:
    """Header, README, manifest and design; default writer; every literal typed."""
    manifest = json.loads((project / "manifest.json").read_text())
    assert (manifest["precision"], manifest["backend"]) == ("single", "tape")
    assert manifest["arithmetic"]["format"] == "binary32 of IEEE 754"
    assert manifest["bytes"] == {"state": 24, "out": 36}
    header = (project / "include/two_tanks.h").read_text()
    assert "typedef float two_tanks_real_t;" in header
    assert "#define TWO_TANKS_SAMPLE_TIME 0.5f" in header
    assert "single precision (`float`)" in (project / "README.md").read_text()
    for path in (*project.glob("src/*"), *project.glob("include/*"), *project.glob("examples/*")):
        text = re.sub(r"(?s)/\*.*?\*/|\"[^\"]*\"", "", path.read_text())
        assert not re.search(r"(?<![\w.])\d+(\.\d+|(\.\d+)?[eE][-+]?\d+)(?![\w.])", text), path
        assert not re.search(r"\bdouble [a-z]", text), path


def symbols(path: Path, compiler: str, *flags: str) -> set[str]:
    """What an object file asks for."""
    library = path / f"{compiler}.o"
    command = [compiler, *STRICT, *flags, "-O2", "-Iinclude", "-c", "src/two_tanks.c"]
    subprocess.run([*command, "-o", str(library)], cwd=path, check=True)
    tool = "arm-none-eabi-nm" if compiler == CROSS else "nm"
    told = subprocess.run([tool, "-u", str(library)], capture_output=True, text=True, check=True)
    return {line.split()[-1] for line in told.stdout.splitlines()}


def test_no_routine_of_double_and_no_heap(project: Path) -> None:
    """Mutant: a literal without its f calls for __aeabi_d* on a processor without double."""
    assert symbols(project, COMPILERS[0]) <= {"_GLOBAL_OFFSET_TABLE_", "sqrtf"}
    if shutil.which(CROSS) is None:
        pytest.skip("no cross compiler")
    for flags in (
        ("-mcpu=cortex-m3",),
        ("-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16"),
    ):
        found = symbols(project, CROSS, "-mthumb", *flags)
        assert not {name for name in found if re.match(r"__aeabi_(d|.*2d)|.*alloc|free", name)}
    assert "sqrtf" in found


MUTANTS = {
    "a literal of double": (r"\b0\.9f", "0.9"),
    "a literal rounded to double": (r"\b0\.1f", "0.1"),
    "the function of double": (r"\bsqrtf\(", "sqrt("),
}


@pytest.mark.parametrize("mutant", MUTANTS)
def test_mistakes_of_single_precision_are_seen(project: Path, tmp_path: Path, mutant: str) -> None:
    """Without warnings, by the vectors alone. Mutant: the machine's constants not rounded."""
    folder = Path(shutil.copytree(project, tmp_path / "p"))
    kernel = folder / "src/two_tanks_kernel.h"
    text, count = re.subn(*MUTANTS[mutant], kernel.read_text())
    assert count, kernel.read_text()
    kernel.write_text(text)
    with pytest.raises(ComparisonError):
        build_and_compare(folder, "two_tanks", compiler=COMPILERS[:1], extra_flags=("-w",))


def test_what_single_precision_does_not_have_is_refused(
    make_single: Callable[[], Any], make_toy: Callable[[], Any], make_step: Any, tmp_path: Path
) -> None:
    """Nothing is left on the disk. Mutant: `rounded` lets 1e300 be infinite."""
    target = tmp_path / "p"

    def refused(toy: Any, word: str, **options: Any) -> None:
        with pytest.raises(CodegenError, match=word):
            generate_c(toy, target, vectors=100, **options)
        assert not target.exists()

    toy = make_single()
    refused(toy, "backend='casadi' computes with constants of double", backend="casadi")
    refused(make_toy(), "designed for double precision", precision="single")
    refused(toy, r"number 1e\+300, which single precision takes for inf", memory=np.full(6, 1e300))
    toy.step = make_step()
    refused(toy, r"number 1e\+300, which single precision takes for inf")


def test_a_design_for_single_precision_can_be_written_in_double(
    make_single: Callable[[], Any], tmp_path: Path
) -> None:
    project = generate_c(make_single(), tmp_path / "p", vectors=100, precision="double")
    assert "typedef double" in (project.folder / "include/two_tanks.h").read_text()
    assert json.loads((project.folder / "manifest.json").read_text())["backend"] == "casadi"


def test_a_constant_below_single_precision_is_zero() -> None:
    """In C and machine alike; designs count it. A design of bounds has coefficients of 1e-295."""
    x = ca.SX.sym("x")
    assert SINGLE.literal(SINGLE.rounded(1e-295), "r") == "0.0f"
    assert SingleMachine(ca.Function("f", [x], [1e-295 * x]))(np.ones(1))[0] == 0.0


def test_the_machine_computes_in_single_precision() -> None:
    """Against rationals; lanes like numbers. Mutants: a constant not rounded."""
    x = ca.SX.sym("x", 2)
    operations = [0.1 * x[0], x[0] + x[1], x[0] / x[1], x[0] * x[1], ca.sqrt(x[0]), 1 / x[1]]
    operations += [ca.if_else(x[0] < x[1], x[0], -3), ca.sign(x[1]), ca.remainder(x[0], x[1])]
    machine = SingleMachine(ca.Function("f", [x], [ca.vertcat(*operations)]))
    a, b = np.float32(0.3), np.float32(-7.7)
    tenth, one = np.float32(0.1), np.float32(1)
    (found,) = machine(np.array([0.3, -7.7]))
    assert found.dtype == np.float32
    root = np.float32(np.sqrt(np.float64(a)))
    assert found.tolist() == [tenth * a, a + b, a / b, a * b, root, one / b, -3, -1, a]
    rows = np.random.default_rng(0).standard_normal((2, 9))
    lanes = machine(rows)[0]
    np.testing.assert_array_equal(lanes, np.transpose([machine(row)[0] for row in rows.T]))


def test_a_unit_without_parameters_builds(
    make_single: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As rounding outwards makes it of first ranges. Mutant: a number is asked to be below 0u."""
    monkeypatch.setattr("obsynth.codegen.fmu._FLAGS", ("-O0", "-fPIC", "-fvisibility=hidden"))
    toy = make_single()
    toy.memory0 = lambda guess, *more, **options: np.array([0.0, 1.0, 10.0, 0.0, 9.0, 8.0])
    unit = generate_fmu(toy, tmp_path / "x.fmu", vectors=100)
    assert unit.comparison is not None
    assert unit.parameters == ()


def test_the_machine_where_there_is_no_number_no_form_and_one_lane_among_many() -> None:
    """Mutants: a remainder of infinity; erfinv looked for; as many lanes as the fewest."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    machine = SingleMachine(ca.Function("f", [x, y], [ca.remainder(x, y)]))
    assert np.isnan(machine(np.array([np.inf]), np.array([2.0]))[0][0])
    assert np.isnan(machine(np.array([1.0]), np.array([0.0]))[0][0])
    lanes = machine(np.array([[5.0, 6.5]]), np.array([2.0]))[0]
    assert lanes.tolist() == [[1.0, 0.5]]
    with pytest.raises(CodegenError, match="no form of 'erfinv'"):
        SingleMachine(ca.Function("f", [x], [ca.erfinv(x)]))(np.ones(1))
