"""The tape's C against its machines, where NaN, infinities and zeros decide; both precisions."""

from __future__ import annotations

import ctypes
import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen import CodegenError, find_compiler, generate_c
from obsynth.codegen import kernel as kernel_module
from obsynth.codegen.casadi_text import generate_kernel
from obsynth.codegen.kernel import DOUBLE, REALS, SINGLE, Real
from obsynth.codegen.single import machine_of
from obsynth.codegen.tape import write_tape

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

WARNINGS = ("-Wconversion", "-Wdouble-promotion", "-Wfloat-conversion", "-Wshadow")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", *WARNINGS)
SPECIAL = [0.0, -0.0, 1.0, -1.0, 2.5, -0.3, 5e-324, 1e300, np.inf, -np.inf, np.nan]
BOTH = pytest.mark.parametrize("real", REALS.values(), ids=REALS)


def step_of(outputs: ca.SX, x: ca.SX) -> ca.Function:
    """A step whose estimate is what is looked at."""
    nothing = ca.SX(0, 1)
    ports = [ca.SX.sym("memory", 1), ca.SX.sym("u", 0), x]
    results = [ports[0], outputs, *[nothing] * 5, 0]
    return ca.Function("step", ports, results, {"allow_free": False})


def place(port: str, i: int) -> str:
    struct = "state" if port in {"memory", "next"} else "in" if port == "y" else "out"
    return f"{struct}->{port.replace('next', 'memory')}[{i}]"


def run(
    step: ca.Function,
    text: str,
    rows: np.ndarray,
    where: Path,
    *flags: str,
    real: Real = DOUBLE,
    compiler: str | None = None,
) -> np.ndarray:
    """Compile a kernel and evaluate it on rows of inputs."""
    n, m = step.numel_in(2), step.numel_out(1)
    where.mkdir(exist_ok=True)
    source, library = where / "k.c", where / "k.so"
    source.write_text(
        f"""#include <math.h>
typedef {real.c} p_real_t;
typedef struct {{ p_real_t memory[1]; }} p_state_t;
typedef struct {{ p_real_t y[{n}]; }} p_in_t;
typedef struct {{ p_real_t xhat[{m}]; }} p_out_t;
int rows(const p_in_t *in, p_out_t *out, int count);
{text}
int rows(const p_in_t *in, p_out_t *out, int count)
{{
    p_state_t state = {{{{0}}}};
    int k;
    p_real_t status = 0;
    for (k = 0; k < count; ++k) {{
        status += p_kernel(&state, &in[k], &out[k]);
    }}
    return (int)status;
}}
"""
    )
    found = find_compiler() if compiler is None else (compiler,)
    assert found is not None
    command = [*found, *STRICT, *flags, "-shared", "-fPIC", str(source), "-o", str(library)]
    done = subprocess.run([*command, "-lm"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    out = np.zeros((len(rows), m), real.type)
    rows = narrowed(rows, real)
    called = ctypes.CDLL(str(library)).rows
    called(ctypes.c_void_p(rows.ctypes.data), ctypes.c_void_p(out.ctypes.data), len(rows))
    return out


def narrowed(rows: np.ndarray, real: Real) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(rows, real.type)


def virtual(step: ca.Function, rows: np.ndarray, real: Real = DOUBLE) -> np.ndarray:
    machine = machine_of(step, real)
    return np.array([machine(np.zeros(1), np.zeros(0), r)[1] for r in narrowed(rows, real)])


def differing(one: np.ndarray, other: np.ndarray) -> int:
    """How many numbers differ in a bit; a NaN is a NaN."""
    assert one.dtype == other.dtype
    places = f"u{one.itemsize}"
    same = (one.view(places) == other.view(places)) | (np.isnan(one) & np.isnan(other))
    return int((~same).sum())


def choices(limit: float = 1e90) -> ca.Function:
    """Extremes with a NaN in either operand, both or none, choices of zeros, truth as numbers."""
    y = ca.SX.sym("y", 3)
    a, b, c = y[0], y[1], y[2]
    some, truth = ca.fabs(a) <= limit, a <= b
    known = ca.if_else(some, a, 0.1)
    chosen = ca.if_else(truth, a, b)
    outputs = [f(*pair) for f in (ca.fmax, ca.fmin) for pair in ((a, b), (a, 0.0), (-0.0, b))]
    outputs += [ca.fmax(known, b), ca.fmin(ca.fmin(a, 2.0), b), chosen, chosen + c, c - chosen]
    outputs += [ca.if_else(c, a, b), ca.if_else(ca.logic_not(truth), a, b), ca.sign(a), -chosen]
    outputs += [8 * truth, -8 * truth, truth + some, ca.logic_or(c, truth), ca.if_else(c, a, 0)]
    outputs += [1 / chosen, a / ca.fmax(chosen, b), 0.1 * a + b, ca.sqrt(chosen), chosen * c]
    # read here only, so that nothing else asks for the sign of their zeros
    left, right = ca.if_else(a < c, a, c), ca.if_else(b < c, b, c)
    outputs += [left + right, a / ca.if_else(c < a, b, c), ca.fmax(ca.fmax(a, b), c)]
    return step_of(ca.vertcat(*outputs), y)


ROWS = np.array(list(itertools.product(SPECIAL, repeat=3)))


@BOTH
def test_choices_and_extremes_are_those_of_the_machine(real: Real, tmp_path: Path) -> None:
    """Every triple of special numbers. Mutants: all of `MUTANTS`, planted below."""
    step = choices(1e30)
    expected = virtual(step, ROWS, real)
    text = write_tape(step, "p", place, real).functions
    for level in ("-O0", "-O3"):
        found = run(step, text, ROWS, tmp_path / level, level, real=real)
        assert differing(found, expected) == 0
    assert "fmax" not in text
    assert "fmin" not in text


MUTANTS = {
    "< for <=": (r"(t\d+) <= (t\d+)\b", r"\1 < \2"),
    "<= for < in an extreme": (r"\((t\d+) < (t\d+)\) \|\| ", r"(\1 <= \2) || "),
    "a NaN let through": (r"\|\| \((\w+) != \1\)", ""),
    "a literal with a digit less": (r"\b0\.1\b", "0.0"),
    "branches swapped": (r"(t\d+) \? (t\d+) : (t\d+)", r"\1 ? \3 : \2"),
    "the sign of a zero": (r"\) \+ 0\.0;", ");"),
    "the other of two equal ones": (r"\((\S+) < (t\d+)\) \?", r"(\1 <= \2) ?"),
}
OF_SINGLE = {
    "fmaxf": (r"\(\((t\d+) < (t\d+)\) \|\| \(\1 != \1\)\) \? \2 : \1", r"fmaxf(\1, \2)"),
}


@pytest.mark.parametrize("mutant", [*MUTANTS, *OF_SINGLE])
def test_mistakes_of_the_writer_are_seen(mutant: str, tmp_path: Path) -> None:
    step, real = choices(1e30), SINGLE if mutant in OF_SINGLE else DOUBLE
    pattern, wrong = (MUTANTS | OF_SINGLE)[mutant]
    text, count = re.subn(pattern, wrong, write_tape(step, "p", place, real).functions)
    assert count
    found = run(step, text, ROWS, tmp_path / "m", "-w", real=real)
    assert differing(found, virtual(step, ROWS, real)) > 0


def grown(seed: int, size: int = 150, more: tuple[Any, ...] = ()) -> ca.Function:
    """A function of random operations on random earlier values."""
    rng = np.random.default_rng(seed)
    y = ca.SX.sym("y", 4)
    values: list[Any] = [*ca.vertsplit(y), *map(ca.SX, (0.0, -0.0, 0.1, 2.0, -3.0, np.inf))]
    unary = [
        ca.fabs,
        ca.sqrt,
        ca.sign,
        ca.floor,
        ca.ceil,
        ca.logic_not,
        lambda a: a**2,
        lambda a: -a,
    ]
    unary += [lambda a: 2 * a, lambda a: 1 / a, ca.sin, ca.exp, lambda a: a**3, *more]
    binary = [ca.fmax, ca.fmin, ca.plus, ca.minus, ca.times, ca.rdivide, ca.lt, ca.le, ca.eq, ca.ne]
    binary += [ca.logic_and, ca.logic_or, ca.fmax, ca.fmin, ca.atan2, ca.copysign]
    for _ in range(size):
        a, b, c = (values[i] for i in len(values) - 1 - rng.integers(0, min(len(values), 25), 3))
        kind = rng.integers(3)
        if kind == 0:
            values.append(unary[rng.integers(len(unary))](a))
        elif kind == 1:
            values.append(binary[rng.integers(len(binary))](a, b))
        else:
            values.append(ca.if_else(a, b, c))
    return step_of(ca.vertcat(*values[10:]), y)


@pytest.mark.parametrize("seed", [0, 1])
def test_random_functions_of_single_precision(seed: int, tmp_path: Path) -> None:
    """With functions of our own, under both compilers. Mutant: they are written in double."""
    own = [ca.cos, ca.log, ca.tanh, ca.atan, ca.asin, lambda a: ca.fabs(a) ** 1.5, ca.expm1]
    step = grown(seed, more=(*own, lambda a: ca.hypot(a, 2.5), ca.sqrt, ca.tan))
    rows = np.random.default_rng(seed).choice([*SPECIAL, 0.7, 88.5, -104.0, 3.1], (300, 4))
    expected = virtual(step, rows, SINGLE)
    text = write_tape(step, "p", place, SINGLE).functions
    for compiler, level in ((None, "-O1"), ("clang-14", "-O3")):
        if compiler is None or shutil.which(compiler):
            where = tmp_path / level
            found = run(step, text, rows, where, level, real=SINGLE, compiler=compiler)
            assert differing(found, expected) == 0


@pytest.mark.parametrize("seed", range(3))
def test_random_functions_are_those_of_the_machine(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole, and in parts. Mutants: a place freed one part too early; `_seen` of a sum says no."""
    step = grown(seed)
    rows = np.random.default_rng(seed).choice(SPECIAL, (300, 4))
    expected = virtual(step, rows)
    whole = write_tape(step, "p", place).functions
    assert differing(run(step, whole, rows, tmp_path / "whole"), expected) == 0
    monkeypatch.setattr(kernel_module, "_LONG", 20)
    monkeypatch.setattr(kernel_module, "_PART", 20)
    cut = write_tape(step, "p", place).functions
    assert cut.count("static void p_part_") >= 5
    assert differing(run(step, cut, rows, tmp_path / "cut"), expected) == 0


def test_no_product_stands_in_the_expression_of_a_sum() -> None:
    """C lets compilers fuse within an expression. Mutant: `product` not handed on by a choice."""
    y = ca.SX.sym("y", 3)
    a, b, c = ca.vertsplit(y)
    sums = [a * b + c, c - a**2, c + ca.if_else(a, 3 * c, 0), c + ca.if_else(b, 2, b * c)]
    text = write_tape(step_of(ca.vertcat(*sums), y), "p").functions
    for line in text.splitlines():
        assert not re.search(r"\*.* [+-] | [+-] .*\*|-\(.*\*", line.split("=", 1)[-1]), line


def test_what_c_does_not_have_is_refused() -> None:
    y = ca.SX.sym("y", 1)
    with pytest.raises(CodegenError, match="'erfinv'"):
        write_tape(step_of(ca.erfinv(y), y), "p")


def test_a_project_of_the_tape(toy: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No warning, the same results, fewer operations; the manifest counts them."""
    compiler = find_compiler()
    assert compiler is not None
    monkeypatch.setenv("CC", " ".join([*compiler, *WARNINGS]))
    project = generate_c(toy, tmp_path / "p", vectors=300, backend="tape")
    assert project.comparison is not None
    manifest = json.loads((project.folder / "manifest.json").read_text())
    assert manifest["backend"] == "tape"
    theirs = generate_kernel(toy.step, "p")
    assert sum(manifest["operation_counts"].values()) < sum(theirs.counts.values())
    assert sum(theirs.counts.values()) < theirs.operations == manifest["operations"]
    assert manifest["operations_of_backends"] == {
        "casadi": sum(theirs.counts.values()),
        "tape": sum(manifest["operation_counts"].values()),
    }
