"""A generated project: contents, determinism, build systems, languages."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from methods import observer_of
from obsynth import FaultDetector, load
from obsynth.codegen import (
    BuildError,
    CodegenError,
    CProject,
    build_and_compare,
    find_compiler,
    generate_c,
)
from obsynth.codegen.description import describe
from obsynth.designs.core.certificate import Claim
from obsynth.designs.core.observer import STATUS

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def run(*command: str, cwd: Path) -> str:
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def contents(project: CProject) -> dict[str, bytes]:
    return {name: (project.folder / name).read_bytes() for name in project.files}


@needs_compiler
def test_all_recorded_steps_are_equal_to_the_last_bit(toy: Any, tmp_path: Path) -> None:
    project = generate_c(toy, tmp_path / "tanks")
    assert project.comparison is not None
    assert project.comparison.vectors == project.vectors == 3000
    assert project.comparison.values > 17 * 3000
    bits_seen = {bit for status in project.statuses for bit in STATUS.values() if status & bit}
    assert bits_seen == {1, 2, 4, 8}, "every bit the toy can set"
    assert "3000 steps" in str(project)
    assert "equal to the last bit" in project._repr_html_()


@pytest.mark.usefixtures("unbuilt")
def test_the_same_options_give_the_same_bytes(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = generate_c(toy, tmp_path / "one", vectors=200)
    monkeypatch.chdir(tmp_path)
    second = generate_c(toy, "deep/er/two", vectors=200)
    assert contents(first) == contents(second)
    for name, data in contents(first).items():
        assert str(tmp_path).encode() not in data, name
        assert b"/usr/" not in data, name
    other = generate_c(toy, tmp_path / "three", vectors=200, seed=1)
    assert contents(other)["tests/vectors.txt"] != contents(first)["tests/vectors.txt"]


@pytest.mark.usefixtures("unbuilt")
def test_the_folder_holds_the_listed_files_and_nothing_else(toy: Any, tmp_path: Path) -> None:
    project = generate_c(toy, tmp_path / "p", name="tank", vectors=100)
    found = {p.relative_to(project.folder).as_posix() for p in project.folder.rglob("*.*")}
    found |= {"Makefile"} & {p.name for p in project.folder.iterdir()}
    assert found == set(project.files)
    assert found == {
        "CMakeLists.txt",
        "Makefile",
        "README.md",
        "design.json",
        "examples/main.c",
        "include/tank.h",
        "library.json",
        "library.properties",
        "manifest.json",
        "pyproject.toml",
        "python/library.c",
        "python/tank/__init__.py",
        "src/tank.c",
        "src/tank.h",
        "src/tank_kernel.h",
        "tests/test_tank.c",
        "tests/vectors.txt",
        "tests/vectors_small.c",
        "zephyr/module.yml",
    }
    assert json.loads((project.folder / "library.json").read_text())["name"] == "tank"
    manifest = json.loads((project.folder / "manifest.json").read_text())
    for name, digest in manifest["files"].items():
        assert hashlib.sha256((project.folder / name).read_bytes()).hexdigest() == digest
    assert set(manifest["files"]) == found - {"manifest.json"}
    assert manifest["guarantee"]["claims"] == ["each state lies\nbetween its bounds"]
    assert manifest["sizes"] == {"memory": 6, "u": 1, "y": 2, "x": 2, "f": 1}
    assert [p for p in tmp_path.iterdir() if p.name.startswith(".")] == []


def test_two_designs_never_share_a_hash(
    toy: Any, proved: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one plant too, nor do two certificates. Mutant: either hash taken of the plant."""
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)

    def hashes(name: str) -> list[str]:
        project = generate_c(toy, tmp_path / name, vectors=100)
        manifest = json.loads((project.folder / "manifest.json").read_text())
        header = (project.folder / "include/two_tanks.h").read_text()
        found = re.findall(r"_(MODEL|DESIGN|CERTIFICATE)_HASH \\\n +\"(\w{64})\"", header)
        assert found == [
            (kind.upper(), manifest[kind]["sha256"]) for kind in ("model", "design", "certificate")
        ]
        return [value for _, value in found]

    model, design, certificate = hashes("one")
    toy.record["design"] = 1.0000000000000002
    assert hashes("two") == [model, changed := hashes("two again")[1], certificate]
    assert changed != design
    toy.certificate = proved([Claim("lmi", "an inequality", True, 0.1, "a proof")])
    assert hashes("three")[:2] == [model, changed]
    assert hashes("four")[2] != certificate


def test_the_design_in_the_folder_is_the_one_that_was_shipped(tmp_path: Path) -> None:
    """Loaded, it ships the same bytes and hashes again; a detector is another design.

    Loading proves less than designing does, so the rest is proved when it ships. Mutant: it is not.
    """
    observer = observer_of("interval_observer")
    description = describe(observer)
    (tmp_path / "design.json").write_text(description.design)
    again = describe(load(tmp_path / "design.json"))
    for fact in ("design", "design_hash", "certificate_hash", "claims", "model_hash"):
        assert getattr(again, fact) == getattr(description, fact)
    assert len(again.claims) > len(load(tmp_path / "design.json").certificate.claims)
    found = {describe(FaultDetector(observer, count)).design_hash for count in (1, 2)}
    assert len({*found, description.design_hash}) == 3
    assert describe(FaultDetector(observer)).design == description.design


def test_the_header_speaks_the_users_names(toy: Any, tmp_path: Path) -> None:
    project = generate_c(toy, tmp_path / "p", vectors=100)
    header = (project.folder / "include/two_tanks.h").read_text()
    assert header.isascii()
    assert "casadi" not in header.lower()
    for line in (
        "#define TWO_TANKS_SAMPLE_TIME 0.5",
        "#define TWO_TANKS_FAULT_DELAY 0",
        "#define TWO_TANKS_X_h_2 1 /* h_2 [cm], declared range 1 to 40 */",
        "#define TWO_TANKS_F_phi 0",
        "double two_tanks_real_t;",
        "two_tanks_real_t z[2];",
        "two_tanks_real_t xhat[2];",
    ):
        assert line in header
    for name, value in STATUS.items():
        assert f"#define TWO_TANKS_{name.upper()} {value} " in header
    readme = (project.folder / "README.md").read_text()
    assert "- each state lies between its bounds\n" in readme


@pytest.mark.usefixtures("unbuilt")
def test_the_kernel_is_private(toy: Any, tmp_path: Path) -> None:
    project = generate_c(toy, tmp_path / "p", vectors=100)
    kernel = (project.folder / "src/two_tanks_kernel.h").read_text()
    assert "casadi" not in kernel.split("*/", 1)[1]
    assert re.findall(r"^\w.*\($", kernel, re.MULTILINE) == ["static void two_tanks_kernel("]


@needs_compiler
@pytest.mark.usefixtures("unbuilt")
@pytest.mark.skipif(shutil.which("nm") is None, reason="no nm")
def test_no_heap_no_global_data_five_exported_functions(toy: Any, tmp_path: Path) -> None:
    project = generate_c(toy, tmp_path / "p", vectors=100)
    compiler = find_compiler()
    assert compiler is not None
    run(*compiler, "-c", "-O0", "-Iinclude", "src/two_tanks.c", "-o", "p.o", cwd=project.folder)
    symbols = run("nm", "p.o", cwd=project.folder)
    kinds = {line.split()[-1]: line.split()[-2] for line in symbols.splitlines()}
    exported = {name for name, kind in kinds.items() if kind == "T"}
    assert exported == {
        f"two_tanks_{verb}" for verb in ("init", "init_default", "set_memory", "get_memory", "step")
    }
    assert set(kinds.values()) <= {"T", "t", "r", "U"}, "no data that can change"
    undefined = {name for name, kind in kinds.items() if kind == "U"}
    assert undefined <= {"sqrt", "fmax", "fabs", "memcpy", "memset", "_GLOBAL_OFFSET_TABLE_"}


@needs_compiler
@pytest.mark.parametrize(
    "flags",
    [
        ("-O0",),
        ("-O3", "-march=native"),
        (
            "-O1",
            "-Wconversion",
            "-Wshadow",
            "-Wstrict-prototypes",
            "-Wmissing-prototypes",
            "-Wdouble-promotion",
            "-Wundef",
            "-Wcast-qual",
        ),
    ],
    ids=["no optimisation", "all optimisation", "more warnings"],
)
def test_every_optimisation_gives_the_same_bits(
    toy: Any, tmp_path: Path, flags: tuple[str, ...], unbuilt: None
) -> None:
    project = generate_c(toy, tmp_path / "p", vectors=1000)
    compiler = find_compiler()
    assert compiler is not None
    _, comparison = build_and_compare(
        project.folder, project.name, compiler=compiler, extra_flags=flags
    )
    assert comparison.vectors == 1000


@needs_compiler
def test_sanitizers_find_nothing(toy: Any, tmp_path: Path, unbuilt: None) -> None:
    flags = ("-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    compiler = find_compiler()
    assert compiler is not None
    probe = tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    if subprocess.run([*compiler, *flags, str(probe), "-o", str(tmp_path / "probe")]).returncode:
        pytest.skip("no sanitizers")
    project = generate_c(toy, tmp_path / "p", vectors=500)
    _, comparison = build_and_compare(
        project.folder, project.name, compiler=compiler, extra_flags=flags
    )
    assert comparison.vectors == 500
    source = project.folder / "src/two_tanks.c"
    source.write_text(source.read_text().replace("i < 2;", "i < 3;"))
    with pytest.raises(BuildError, match=r"AddressSanitizer|runtime error"):
        build_and_compare(project.folder, project.name, compiler=compiler, extra_flags=flags)


@pytest.mark.skipif(shutil.which("g++") is None, reason="no C++ compiler")
@needs_compiler
def test_the_header_serves_cpp(toy: Any, tmp_path: Path, unbuilt: None) -> None:
    folder = generate_c(toy, tmp_path / "p", vectors=100).folder
    (tmp_path / "use.cpp").write_text(
        """#include "two_tanks.h"
#include <cmath>
#include "two_tanks.h"
int main() {
    two_tanks_state_t state;
    two_tanks_in_t in = {{4.0}, {25.0, 20.0}};
    two_tanks_out_t out;
    two_tanks_init(&state);
    int cold = two_tanks_step(&state, &in, &out);
    two_tanks_init_default(&state);
    int warm = two_tanks_step(&state, &in, &out);
    in.y[TWO_TANKS_Y_level_1] = NAN;
    int blind = two_tanks_step(&state, &in, &out);
    bool open = std::isinf(out.x_upper[0]) && std::isfinite(out.xhat[0]);
    return !((cold & TWO_TANKS_NOT_INITIALISED) && warm == 0
             && blind == TWO_TANKS_NON_FINITE_INPUT && open);
}
"""
    )
    compiler = find_compiler()
    assert compiler is not None
    flags = ("-pedantic", "-Wall", "-Wextra", "-Werror", f"-I{folder / 'include'}")
    run(*compiler, "-std=c99", *flags, "-c", str(folder / "src/two_tanks.c"), cwd=tmp_path)
    run("g++", "-std=c++11", *flags, "use.cpp", "two_tanks.o", "-o", "use", cwd=tmp_path)
    run("./use", cwd=tmp_path)


@needs_compiler
@pytest.mark.skipif(shutil.which("make") is None, reason="no make")
def test_make_builds_and_tests(toy: Any, tmp_path: Path, unbuilt: None) -> None:
    folder = generate_c(toy, tmp_path / "p", vectors=300).folder
    assert "300 vectors" in run("make", "test", cwd=folder)
    assert "k = 4" in run("make", "example", cwd=folder)
    generate_c(toy, folder, vectors=300, overwrite=True)
    assert not (folder / "build").exists(), "what make built is no obstacle and is gone"


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cmake_builds_and_tests(toy: Any, tmp_path: Path, unbuilt: None) -> None:
    folder = generate_c(toy, tmp_path / "p", vectors=100).folder
    run("cmake", "-S", ".", "-B", "build", cwd=folder)
    run("cmake", "--build", "build", cwd=folder)
    assert "100% tests passed" in run("ctest", "--test-dir", "build", cwd=folder)


USE = """cmake_minimum_required(VERSION 3.15)
project(use C)
enable_testing()
if(INSTALLED)
  find_package(two_tanks REQUIRED PATHS ${INSTALLED})
else()
  add_subdirectory(${FOLDER} tanks)
  if(TARGET test_two_tanks OR TARGET example_two_tanks)
    message(FATAL_ERROR "tests of a subproject")
  endif()
endif()
add_executable(use use.c)
target_link_libraries(use two_tanks::two_tanks)
"""


@pytest.mark.long
@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="no cmake")
def test_cmake_serves_other_projects(toy: Any, tmp_path: Path) -> None:
    """As a subdirectory, without its tests, installed, and as a module of Zephyr (its functions
    told here). Mutant: tests built in subprojects; no header installed."""
    folder = generate_c(toy, tmp_path / "p", vectors=100).folder
    place = tmp_path / "use"
    place.mkdir()
    (place / "CMakeLists.txt").write_text(USE)
    (place / "use.c").write_text(
        '#include "two_tanks.h"\nint main(void) { two_tanks_state_t s; two_tanks_init(&s);'
        " return 0; }\n"
    )
    run("cmake", "-S", ".", "-B", "sub", f"-DFOLDER={folder}", cwd=place)
    run("cmake", "--build", "sub", cwd=place)
    run("cmake", "-S", str(folder), "-B", "lib", "-DBUILD_TESTING=OFF", cwd=tmp_path)
    run("cmake", "--build", "lib", cwd=tmp_path)
    run("cmake", "--install", "lib", "--prefix", "root", cwd=tmp_path)
    run("cmake", "-S", ".", "-B", "inst", f"-DINSTALLED={tmp_path / 'root'}", cwd=place)
    run("cmake", "--build", "inst", cwd=place)
    (place / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.15)\nproject(use C)\n"
        "function(zephyr_library)\nendfunction()\n"
        "function(zephyr_library_sources file)\nmessage(STATUS told:${file})\nendfunction()\n"
        "function(zephyr_include_directories)\nendfunction()\n"
        f"add_subdirectory({folder} tanks)\n"
    )
    assert "told:src/two_tanks.c" in run("cmake", "-S", ".", "-B", "zephyr", cwd=place)


@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="no compiler for ARM")
def test_an_arm_compiler_takes_every_file(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mutant: PRIx64, which newlib does not define."""
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
    folder = generate_c(toy, tmp_path / "p", vectors=100).folder
    tests = ("tests/test_two_tanks.c", "tests/vectors_small.c")
    for file in ("src/two_tanks.c", *tests, "examples/main.c"):
        flags = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-Iinclude", "-c", "-o", "x.o")
        run("arm-none-eabi-gcc", "-mcpu=cortex-m4", *flags, file, cwd=folder)


def test_without_a_compiler_the_result_says_so(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    project = generate_c(toy, tmp_path / "p", vectors=100)
    assert project.build is None
    assert project.comparison is None
    assert "no C compiler" in str(project)
    assert (project.folder / "tests/vectors.txt").exists()


def test_a_wrong_cc_is_not_passed_over(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "no-such-compiler -m32")
    with pytest.raises(BuildError, match="no-such-compiler"):
        generate_c(toy, tmp_path / "p", vectors=100)
    assert not (tmp_path / "p").exists()


@needs_compiler
def test_fast_math_is_refused_by_the_sources(
    toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = find_compiler()
    assert compiler is not None
    monkeypatch.setenv("CC", f"{compiler[0]} -ffast-math")
    with pytest.raises(BuildError, match="remove the checks for NaN"):
        generate_c(toy, tmp_path / "p", vectors=100)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"precision": "float"}, "available: 'double', 'single'"),
        ({"precision": "single"}, "design it with precision='single'"),
        ({"backend": "hand"}, "available: 'casadi', 'tape'"),
        ({"vectors": 99}, "at least 100"),
        ({"vectors": 1e3}, "whole number"),
        ({"seed": -1}, "seed"),
        ({"memory": np.zeros(5)}, r"\(6,\)"),
        ({"name": "stdio"}, "stdio_observer"),
        ({"name": "m"}, "hide a header, a library or a target"),
        ({"name": "Nightly"}, "hide a header, a library or a target"),
        ({"name": "class"}, "for example name='class_'"),
        ({"name": "nullptr"}, "for example name='nullptr_'"),
        ({"name": "con"}, "no name of a file under Windows"),
        ({"name": "com1"}, "no name of a file under Windows"),
        ({"name": "a" * 300}, "300 letters"),
        ({"precision": 32}, "available: 'double', 'single'"),
    ],
)
def test_options_that_cannot_be_met_are_refused(
    toy: Any, tmp_path: Path, options: dict[str, Any], word: str
) -> None:
    with pytest.raises(CodegenError, match=word):
        generate_c(toy, tmp_path / "p", **options)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("unbuilt")
def test_a_memory_of_the_users_own_is_the_default_memory(toy: Any, tmp_path: Path) -> None:
    memory = np.array([1.0, 1.0, 2.5, np.inf, -0.0, 0.1])
    project = generate_c(toy, tmp_path / "p", vectors=100, memory=memory)
    source = (project.folder / "src/two_tanks.c").read_text()
    assert "INFINITY,\n        -0.0,\n        0.1\n" in source
    assert "given by the user" in (project.folder / "include/two_tanks.h").read_text()


@needs_compiler
def test_no_inputs_and_no_faults(toy: Any, make_step: Any, tmp_path: Path) -> None:
    toy.model.boxes |= {"u": [], "f": []}
    toy.step = make_step(n_u=0, n_f=0)
    project = generate_c(toy, tmp_path / "p", vectors=200)
    assert project.comparison is not None
    header = (project.folder / "include/two_tanks.h").read_text()
    assert "fhat" not in header
    assert " u[" not in header
    assert "FAULT_DELAY" not in header


@needs_compiler
def test_matrix_expressions_and_structural_zeros(toy: Any, make_step: Any, tmp_path: Path) -> None:
    scalar = make_step()
    ports = [ca.MX.sym(name, scalar.numel_in(i)) for i, name in enumerate(("memory", "u", "y"))]
    outputs = scalar.call(ports)
    outputs[1] = ca.MX(ca.DM.zeros(ca.Sparsity(2, 1)))
    toy.step = ca.Function("step", ports, outputs)
    project = generate_c(toy, tmp_path / "p", vectors=200)
    assert project.comparison is not None
    kernel = (project.folder / "src/two_tanks_kernel.h").read_text()
    assert "xhat[1]=" in kernel


@needs_compiler
def test_every_operation_of_casadi_that_c99_has(toy: Any, make_step: Any, tmp_path: Path) -> None:
    memory, u, y = ca.SX.sym("memory", 6), ca.SX.sym("u"), ca.SX.sym("y", 2)
    a, b = memory[4], y[0]
    one = [
        *(f(a) for f in (ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.exp, ca.log)),
        *(f(a) for f in (ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.acosh, ca.atanh, ca.erf)),
        *(f(a) for f in (ca.sqrt, ca.fabs, ca.sign, ca.floor, ca.ceil, ca.log1p, ca.expm1)),
        *(f(a, b) for f in (ca.fmin, ca.fmax, ca.atan2, ca.fmod, ca.copysign, ca.hypot)),
        *(ca.remainder(a, b), a**b, a**2, a**3, 1 / a, 2 * a, -a, a / b),
        *(a < b, a <= b, a == b, a != b, ca.logic_not(a), ca.logic_or(a > 0, b > 0)),
        *(ca.if_else(a > b, ca.inf, -ca.inf), ca.if_else(b > 0, float("nan"), a)),
    ]
    toy.step = ca.Function(
        "step",
        [memory, u, y],
        [
            ca.vertcat(memory[:5], ca.sumsqr(ca.vertcat(*one[:10]))),
            ca.vertcat(*one),
            *make_step()(memory, u, y)[2:3],
            *(ca.vertcat(*one), ca.vertcat(*one)),
            *make_step()(memory, u, y)[5:],
        ],
    )
    count = len(one)
    names = tuple(f"x{i}" for i in range(count))
    signals = tuple(type(toy.model.u[0])(name, "", 1.0, 50.0) for name in names)
    wide = type("Wide", (type(toy.model),), {"x": signals})()
    wide.boxes["x"] = [(1.0, 50.0)] * count
    plant = toy.model.function()
    x = ca.SX.sym("x", count)
    ports = [x, *(ca.SX.sym(f"s{i}", plant.numel_in(i)) for i in range(1, 7))]
    rhs, measured = plant(x[:2], *ports[1:])
    wide.function = lambda: ca.Function("p", ports, [ca.vertcat(rhs, x[2:]), measured])
    toy.model = wide
    toy.memory0 = lambda guess, **ranges: np.array([0.0, 1.0, 1.0, 0.0, 0.5, 0.25])
    project = generate_c(toy, tmp_path / "p", vectors=2000)
    assert project.comparison is not None
    manifest = json.loads((project.folder / "manifest.json").read_text())
    assert {"sin", "pow", "fmod", "remainder"} <= set(manifest["library_functions"])
    assert "sin" in manifest["not_defined_to_the_last_bit"]
    assert "fmod" not in manifest["not_defined_to_the_last_bit"]
    assert "`sin`" in (project.folder / "README.md").read_text()
