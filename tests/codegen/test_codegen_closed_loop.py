"""A hundred thousand steps in closed loop: C of the tape against its machine, bit by bit."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import methods
from obsynth.codegen import generate_c
from obsynth.codegen.description import Description, describe
from obsynth.codegen.single import SingleMachine
from obsynth.designs.detection.detector import FaultDetector

COMPILERS = [name for name in ("gcc", "clang-14") if shutil.which(name)]
LEVELS = (("-O0",), ("-O2",), ("-O3", "-march=native"))
EVERY = [(compiler, *level) for compiler in COMPILERS for level in LEVELS]
KINDS = ("u", "d", "f", "w", "p", "rho")
STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wdouble-promotion")
STRICT += ("-Wfloat-conversion", "-Wshadow", "-Werror")
EXTREME = [0.0, -0.0, 5e-324, 1e-40, -1e-30, 1e12, -1e30, 1e300, np.inf, -np.inf, np.nan]

pytestmark = pytest.mark.skipif(not COMPILERS, reason="no C compiler")


def inside(rng: np.random.Generator, box: Any, lanes: int) -> Any:
    """Values in a box, open ends one unit from the other, a column a lane."""
    low, high = np.asarray(box, dtype=float).reshape(-1, 2).T
    low = np.where(np.isfinite(low), low, np.minimum(high, 1.0) - 1.0)
    high = np.where(np.isfinite(high), high, low + 1.0)
    return (low + (high - low) * rng.random((lanes, low.size))).T


def driven(description: Description, lanes: int, steps: int) -> Iterator[list[Any]]:
    """Inputs, readings and scheduling of plants from anywhere in their ranges, a lane each."""
    model, rng = description.observer.model, np.random.default_rng(0)
    plant = model.function().map(lanes)
    x = inside(rng, model.box("x"), lanes)
    for k in range(steps):
        if k % 20 == 0:
            values = {kind: inside(rng, model.box(kind), lanes) for kind in KINDS}
        values |= {kind: inside(rng, model.box(kind), lanes) for kind in ("d", "w")}
        following, y = (np.asarray(v) for v in plant(x, *(values[kind] for kind in KINDS)))
        theta = [values["rho"][list(description.scheduling)]] if description.scheduling else []
        told = [values["u"].copy(), y, *theta]
        for signal in told:
            spoilt = rng.random(signal.shape) < 0.005
            signal[spoilt] = rng.choice(EXTREME, spoilt.sum())
        yield told
        low, high = np.asarray(model.box("x"), dtype=float).reshape(-1, 2).T[..., None]
        fresh = inside(rng, model.box("x"), lanes)
        x = np.where(np.isfinite(following), np.clip(following, low, high), fresh)


def compiled(folder: Path, name: str, flags: tuple[str, ...], where: Path) -> Any:
    """The step of a project for many observers at once."""
    compiler, *more = flags
    where.mkdir(exist_ok=True)
    (where / "lanes.c").write_text(
        f"""#include "{name}.h"
void lanes({name}_state_t *s, const {name}_in_t *in, {name}_out_t *out, int *status, int n);
void lanes({name}_state_t *s, const {name}_in_t *in, {name}_out_t *out, int *status, int n)
{{
    int i;
    for (i = 0; i < n; ++i) {{
        status[i] = {name}_step(&s[i], &in[i], &out[i]);
    }}
}}
"""
    )
    files = [str(where / "lanes.c"), str(folder / f"src/{name}.c"), "-o", str(where / "l.so")]
    command = [compiler, *STRICT, *more, "-shared", "-fPIC", f"-I{folder / 'include'}", *files]
    subprocess.run([*command, "-lm"], check=True)
    return ctypes.CDLL(str(where / "l.so")).lanes


def machine(description: Description, lanes: int) -> Callable[..., list[Any]]:
    step = description.observer.step
    if description.real.bits == 32:
        return SingleMachine(step)
    mapped = step.map(lanes)
    return lambda *given: [np.asarray(ca.densify(v)) for v in mapped.call(list(given))]


def differing(one: Any, other: Any) -> bool:
    words = f"u{one.itemsize}"
    same = (one.view(words) == other.view(words)) | (np.isnan(one) & np.isnan(other))
    return not bool(same.all())


def compare(
    observer: Any, folder: Path, lanes: int, steps: int, builds: list[tuple[str, ...]]
) -> dict[int, int]:
    """Run machine and builds side by side; return how often which status was returned.

    Some observers begin again and again from a memory with an entry that is none.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
        project = generate_c(observer, folder, vectors=100, backend="tape")
    description = describe(observer)
    real = description.real.type
    run = machine(description, lanes)
    calls = [
        compiled(project.folder, project.name, flags, folder.with_name(f"build{i}"))
        for i, flags in enumerate(builds)
    ]
    status = np.zeros(lanes, np.int32)
    seen: dict[int, int] = {}
    rng, some, start = np.random.default_rng(1), lanes // 20, description.start.astype(real)
    memory = np.repeat(start[:, None], lanes, axis=1)
    states = [memory.T.copy() for _ in builds]
    for k, inputs in enumerate(driven(description, lanes, steps)):
        with np.errstate(over="ignore"):
            given = [values.astype(real) for values in inputs]
            extreme = rng.choice(EXTREME, some).astype(real)
        if k % 25 == 0:
            memory[:, :some] = start[:, None]
            memory[rng.integers(0, len(memory), some), np.arange(some)] = extreme
            for state in states:
                state[:some] = memory.T[:some]
        memory, *results = run(memory, *given)
        expected = np.ascontiguousarray(np.concatenate([memory, *results]).T)
        told = len(memory) + sum(len(result) for result in results[:6])
        read = np.ascontiguousarray(np.concatenate(given).T)
        for call, state in zip(calls, states, strict=True):
            out = np.zeros((lanes, expected.shape[1] - len(memory) - 1), real)
            call(*(ctypes.c_void_p(a.ctypes.data) for a in (state, read, out, status)), lanes)
            found = np.concatenate([state, out], axis=1)
            assert not differing(found, np.delete(expected, told, axis=1))
            assert (status == expected[:, told]).all()
        for value, count in zip(*np.unique(status, return_counts=True), strict=True):
            seen[int(value)] = seen.get(int(value), 0) + int(count)
    return seen


@pytest.mark.parametrize("precision", ["double", "single"])
def test_a_toy_in_closed_loop(
    make_toy: Any, make_single: Any, precision: str, tmp_path: Path
) -> None:
    """Mutant: the kernel takes a sum for a difference."""
    toy = make_single() if precision == "single" else make_toy()
    seen = compare(toy, tmp_path / "p", 50, 100, [(COMPILERS[-1], "-O2")])
    assert sum(seen.values()) == 5000
    assert seen[0] > 1000


@pytest.mark.long
@pytest.mark.parametrize("name", methods.METHODS)
def test_every_method_in_closed_loop(name: str, tmp_path: Path) -> None:
    """A hundred thousand steps, double: gcc and clang, without and with all optimisation."""
    seen = compare(methods.observer_of(name), tmp_path / "p", 200, 500, EVERY)
    assert sum(seen.values()) == 100_000


@pytest.mark.long
@pytest.mark.parametrize("name", methods.METHODS)
def test_every_method_in_closed_loop_in_single_precision(name: str, tmp_path: Path) -> None:
    """One of them with a detector. Mutant: what its window covers told with the ends of doubles."""
    entry = methods.METHODS[name]
    observer = replace(entry.method, precision="single").design(entry.plant())
    if name == "interval_observer":
        observer = FaultDetector(observer, 2, window=4)
    builds = [(COMPILERS[0], "-O2"), (COMPILERS[-1], "-O3", "-march=native")]
    seen = compare(observer, tmp_path / "p", 500, 200, builds)
    assert sum(seen.values()) == 100_000
