"""Functions of our own in single precision: errors, limits, and the same bits in C."""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen import functions
from obsynth.codegen.functions import FARTHEST, ULPS, own_function
from obsynth.codegen.kernel import EXACT, LIBRARY, SINGLE
from obsynth.codegen.single import SingleMachine
from obsynth.codegen.tape import write_function
from obsynth.designs.core.boxes import Lifted, Rounding
from obsynth.designs.core.lifted import combine
from obsynth.designs.core.rounding import rounding_bound

NAMES = {"asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2", "pow": "power"}
NAMES |= {"asinh": "arcsinh", "acosh": "arccosh", "atanh": "arctanh"}
LARGEST = float(np.finfo(np.float32).max)


def exact(name: str) -> Callable[..., Any]:
    """NumPy, or Python, in double precision, 10^8 times as fine."""
    found = getattr(np, NAMES.get(name, name), None)
    function: Callable[..., Any] = found or np.vectorize(getattr(math, name), otypes=[float])
    return lambda *x: function(*(np.float64(a) for a in x))


def errors(found: Any, truth: Any) -> Any:
    """In units in the last place of the truth; infinity is a unit above the largest float."""
    most = LARGEST * (1 + 2.0**-24)
    found, truth = (np.clip(a, -most, most) for a in (found, truth))
    unit = np.ldexp(1.0, np.maximum(np.frexp(truth)[1], -125) - 24)
    return np.where(np.isnan(truth) & np.isnan(found), 0.0, np.abs(found - truth) / unit)


def spread(rng: np.random.Generator, count: int) -> Any:
    """Floats of every size, and those next to multiples of a quarter turn."""
    every = rng.integers(0, 2**32, count, dtype=np.uint32).view(np.float32)
    turns = (np.arange(4096) * (np.pi / 2)).astype(np.float32)
    near = [np.nextafter(turns, np.float32(side * 1e9)) for side in (-1, 1)]
    usual = rng.uniform(-1, 1, count).astype(np.float32) * np.float32(rng.choice([1, 9, 90]))
    return np.concatenate([every, turns, *near, usual])


def worst(name: str, count: int = 20_000) -> float:
    rng = np.random.default_rng(0)
    x = [spread(rng, count)]
    with np.errstate(all="ignore"):
        if name == "pow":
            share = rng.uniform(-1, 1, x[0].size)
            x = [np.abs(x[0]), (88.0 * share / np.log(np.abs(x[0]))).astype(np.float32)]
        elif own_function(name).n_in() == 2:
            x.append((x[0] * rng.uniform(-9, 9, x[0].size)).astype(np.float32))
        if name in {"sin", "cos", "tan"}:
            x = [x[0][np.abs(x[0]) <= FARTHEST]]
        (found,) = SingleMachine(own_function(name))(*(a[None] for a in x))
        told = errors(found[0].astype(float), exact(name)(*x))
    return float(told[np.isfinite(x[-1]) & np.isfinite(x[0])].max())


def test_every_function_of_c_has_a_form() -> None:
    """Mutant: erf without one, which the writer then looks for in vain."""
    assert {*ULPS} == LIBRARY - EXACT


@pytest.mark.parametrize("name", ULPS)
def test_errors_stay_below_what_is_said(name: str) -> None:
    """And not far below. Mutants: see below; ``tools/ulps.py`` tries every float."""
    assert 0.5 < worst(name) <= ULPS[name]


@pytest.mark.parametrize(
    ("name", "number", "wrong"),
    [
        ("log1p", "_as_written", nullcontext),
        ("sin", "_SINE", (-0.1666667, 0.0083333, -0.000198, 2.7e-06)),
        ("exp", "_EXP", (0.5, 0.1666667, 0.041667, 0.00833, 0.00139, 0.0002)),
        ("erf", "_ERF", (0.12838, -0.37613, 0.11282, -0.026793, 0.005034, -0.00062)),
        ("erf", "_ERFC", (0.000315, -1.13022, *functions._ERFC[2:])),
        ("log", "_LOG", (0.66667, 0.4, 0.285, 0.233)),
        ("cos", "_PI", functions._PI * (1 + functions.Fraction(1, 2**44))),
    ],
)
def test_mistakes_are_seen(
    name: str, number: str, wrong: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Simplified by CasADi, coefficients with digits less, a quarter turn of 44 bits."""
    monkeypatch.setattr(functions, number, wrong)
    own_function.cache_clear()
    try:
        assert worst(name) > ULPS[name]
    finally:
        own_function.cache_clear()


SPECIAL = np.array([0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, 3.0, -3.0, 1e30, np.inf, -np.inf, np.nan])


@pytest.mark.parametrize("name", ULPS)
def test_limits_and_what_is_not_defined(name: str) -> None:
    """NaN, infinity and zero where C99 has them, but for the sign of a zero and for far angles."""
    two = own_function(name).n_in() == 2
    x = np.meshgrid(SPECIAL, SPECIAL) if two else [SPECIAL]
    flat = [a.ravel() for a in x]
    (found,) = SingleMachine(own_function(name))(*(a[None] for a in flat))
    with np.errstate(all="ignore"):
        truth = exact(name)(*flat)
    if name in {"sin", "cos", "tan"}:
        truth = np.where(np.abs(flat[0]) <= FARTHEST, truth, np.nan)
    told = errors(found[0].astype(float), truth)
    assert (told <= ULPS[name]).all(), [a[~(told <= ULPS[name])] for a in flat]


@pytest.mark.parametrize("op", ["sine", "cosine", "tangent"])
def test_sets_hold_where_an_angle_is_none_any_more(op: str) -> None:
    """An end whose sine is a NaN leaves the other end. Mutant: the angle of double in single."""
    low, high = ca.SX.sym("low"), ca.SX.sym("high")
    angle = Lifted(low, high, -1e4, 1e4)
    found = combine(op, angle, rounding=Rounding("single"))
    ends = SingleMachine(ca.Function("f", [low, high], [found.lower, found.upper]))
    left, right = FARTHEST - 0.1, FARTHEST + 0.1
    told = [float(end[0]) for end in ends(np.array([left]), np.array([right]))]
    function = {"sine": np.sin, "cosine": np.cos, "tangent": np.tan}[op]
    truth = function(np.linspace(left, right, 99))
    assert told[0] <= truth.min()
    assert truth.max() <= told[1]


def test_rounding_is_not_bounded_where_an_angle_is_none_any_more() -> None:
    """Mutant: the same bound on both sides."""
    x = ca.SX.sym("x")
    sine = ca.Function("f", [x], [ca.sin(x)], ["x"], ["s"])
    for end, known in ((FARTHEST - 1.0, True), (FARTHEST + 1.0, False)):
        box = {"x": (np.array([[6000.0]]), np.array([[end]]))}
        assert np.isfinite(rounding_bound(sine, box, "single")["s"].error[0]) == known


WARNINGS = ("-Wconversion", "-Wdouble-promotion", "-Wfloat-conversion", "-Wshadow")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", *WARNINGS)
COMPILERS = [name for name in ("gcc", "clang-14") if shutil.which(name)]
CROSS = "arm-none-eabi-gcc"


def source() -> str:
    """All functions, one behind the other."""
    texts = [write_function(name, "p", SINGLE)[0] for name in ULPS]
    calls = [f"p_{name}(x[i]{', y[i]' * (own_function(name).n_in() == 2)})" for name in ULPS]
    lines = [f"        out[{len(ULPS)} * i + {j}] = {call};" for j, call in enumerate(calls)]
    head = "void all(const float *x, const float *y, float *out, int n)"
    parts = ["#include <math.h>", "typedef float p_real_t;", *texts, f"{head};", head, "{"]
    loop = ["    int i;", "    for (i = 0; i < n; ++i) {", *lines, "    }", "}"]
    return "\n".join([*parts, *loop]) + "\n"


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_they_are_the_same_bits_in_c(tmp_path: Path) -> None:
    """Without a warning, under both compilers. Mutant: a product fused with a sum."""
    (tmp_path / "all.c").write_text(source())
    rng = np.random.default_rng(2)
    x = np.concatenate([spread(rng, 300), SPECIAL.astype(np.float32)])
    y = rng.permutation(x)
    with np.errstate(all="ignore"):
        expected = [
            SingleMachine(own_function(name))(
                *(a[None] for a in (x, y)[: own_function(name).n_in()])
            )
            for name in ULPS
        ]
    told = np.array([values[0][0] for values in expected]).T
    for compiler, *flags in [(name, "-O1", "-march=native") for name in COMPILERS]:
        library = tmp_path / f"{compiler}.so"
        command = [compiler, *STRICT, *flags, "-ffp-contract=off", "-shared", "-fPIC", "all.c"]
        subprocess.run([*command, "-o", str(library), "-lm"], cwd=tmp_path, check=True)
        found = np.zeros_like(told, order="C")
        arrays = (ctypes.c_void_p(a.ctypes.data) for a in (x, y, found))
        ctypes.CDLL(str(library)).all(*arrays, len(x))
        same = (found.view(np.uint32) == told.view(np.uint32)) | (np.isnan(found) & np.isnan(told))
        assert same.all(), [name for name, good in zip(ULPS, same.T, strict=True) if not good.all()]


@pytest.mark.skipif(shutil.which(CROSS) is None, reason="no cross compiler")
def test_they_need_no_routine_of_double(tmp_path: Path) -> None:
    """Mutant: a literal without its f."""
    (tmp_path / "all.c").write_text(source())
    command = [CROSS, *STRICT, "-mcpu=cortex-m3", "-mthumb", "-O0", "-c", "all.c"]
    subprocess.run(command, cwd=tmp_path, check=True)
    told = subprocess.run(
        ["arm-none-eabi-nm", "-u", "all.o"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    found = {line.split()[-1] for line in told.stdout.splitlines()}
    assert {name for name in found if not name.startswith(("__aeabi_f", "__aeabi_i2f"))} <= {
        "sqrtf",
        "floorf",
    }
