"""Whatever is measured: compiled steps return bounds in order, none of them no number."""

import ctypes
import functools
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pytest
from violations import case_of

import obsynth as ob
from methods import METHODS, observer_of, run_of
from obsynth.codegen.build import find_compiler
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS

SAMPLES = 128
"""Steps in a row from one start."""
STARTS = 12
STRANGE = [
    *(np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -5e-324, 2.3e-308, 1e-160, 1e-20),
    *(1e20, -1e20, 1e100, -1e100, 1e154, 1e160, 1e300, -1e300, 1.0000000000000002e300, 1.8e308),
]
DRIVER = """
#include <string.h>
#include "{name}.h"
void many(long count, double *memory, const double *in, double *out, int *status)
{{
    {name}_state_t state;
    {name}_in_t given;
    {name}_out_t said;
    long k;
    {name}_set_memory(&state, memory);
    for (k = 0; k < count; ++k) {{
        memcpy(&given, in + k * (sizeof given / sizeof *in), sizeof given);
        status[k] = {name}_step(&state, &given, &said);
        memcpy(out + k * (sizeof said / sizeof *out), &said, sizeof said);
    }}
    {name}_get_memory(&state, memory);
}}
"""


PEAK = "peak bounds"


def observer_for(name):
    return case_of("four tanks, peak").observer if name == PEAK else observer_of(name)


def run_for(name):
    return run_of("bounded_error_uio" if name == PEAK else name)


class Compiled:
    """Many steps of an observer, by its C project or, without a compiler, by CasADi."""

    def __init__(self, observer):
        step = observer.step
        self.inputs = sum(step.numel_in(i) for i in range(1, step.n_in()))
        self.outputs = sum(step.numel_out(i) for i in range(1, 7))
        self.many = self._by_casadi(step) if find_compiler() is None else self._by_c(observer)

    def _by_casadi(self, step):
        def many(memory, given):
            parts = np.split(given, np.cumsum([step.numel_in(i) for i in range(1, step.n_in())]), 1)
            _, *said = step.mapaccum(len(given))(memory, *(part.T for part in parts[:-1]))
            said = np.vstack([np.array(value) for value in said]).T
            return said[:, :-1], said[:, -1].astype(int)

        return many

    def _by_c(self, observer):
        self.folder = tempfile.TemporaryDirectory()
        place = Path(self.folder.name)
        project = ob.generate_c(observer, place / "c", name="fuzzed", vectors=100)
        driver, library = place / "driver.c", place / "driver.so"
        driver.write_text(DRIVER.format(name="fuzzed"))
        source = project.folder / "src" / "fuzzed.c"
        flags = ["-std=c99", "-O1", "-ffp-contract=off", "-shared", "-fPIC"]
        where = ["-I", str(project.folder / "include"), "-o", str(library)]
        command = [*find_compiler(), *flags, str(driver), str(source), *where, "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        function = ctypes.CDLL(str(library)).many
        doubles = np.ctypeslib.ndpointer(np.float64, flags="C")
        integers = np.ctypeslib.ndpointer(np.int32, flags="C")
        function.argtypes = [ctypes.c_long, doubles, doubles, doubles, integers]
        function.restype = None

        def many(memory, given):
            said = np.empty((len(given), self.outputs))
            status = np.empty(len(given), dtype=np.int32)
            function(len(given), memory.copy(), np.ascontiguousarray(given), said, status)
            return said, status

        return many


@functools.cache
def compiled(name):
    return Compiled(observer_for(name))


@functools.cache
def starts(name):
    """Memories for random boxes around states of the run."""
    observer, run = observer_for(name), run_for(name)
    rng, found = np.random.default_rng(5), []
    box, faults = observer.model.box("x"), observer.model.box("f")
    faults = np.clip(faults, -10.0, 10.0)
    for i in range(STARTS):
        k = int(rng.integers(len(run.t)))
        x, share = run.x[k], 10 ** rng.uniform(-9, 0)
        low = x - share * rng.random(x.size) * np.maximum(x - box[:, 0], 0.0)
        high = x + share * rng.random(x.size) * np.maximum(box[:, 1] - x, 0.0)
        options = {} if i == 0 else {"x_range": np.column_stack([low, high])}
        if i % 3 == 1:
            options["f_range"] = faults * rng.random()
        try:
            found.append((k, observer.memory0(x, y0=run.y[k], **options)))
        except ob.ObsynthError:
            continue
    return found


def given(name, rng):
    """A start, and a stretch of the run in which numbers were replaced."""
    observer, run = observer_for(name), run_for(name)
    at, memory = starts(name)[rng.integers(len(starts(name)))]
    rows = (at + np.arange(SAMPLES)) % len(run.t)
    values = np.hstack([run.u[rows], run.y[rows]])
    if observer.step.n_in() == 4:
        seen = [i for i, s in enumerate(observer.model.rho) if s.measured]
        values = np.hstack([values, run.rho[rows][:, seen]])
    shape = values.shape
    rate = rng.choice([0.003, 0.02, 0.1, 0.4, 1.0])
    spoilt = rng.random(shape) < rate
    if rng.random() < 0.5:  # what follows a spoilt stretch, undisturbed
        spoilt[SAMPLES // 3 :] = False
    count = int(spoilt.sum())
    kind = rng.random(count)
    wild = rng.standard_normal(count) * 10.0 ** rng.uniform(-12, 12, count)
    near = values[spoilt] * (1 + 10.0 ** rng.uniform(-8, 1, count) * rng.standard_normal(count))
    values[spoilt] = np.where(
        kind < 0.4, rng.choice(STRANGE, count), np.where(kind < 0.6, wild, near)
    )
    return memory, values


def fuzz(name, steps, seed):
    """Run about so many steps; return how often which status came."""
    observer, step = observer_for(name), compiled(name)
    rng = np.random.default_rng(seed)
    n, n_f = len(observer.model.x), len(observer.model.f)
    lower = np.r_[n + n_f : 2 * n + n_f, 3 * n + n_f : 3 * n + 2 * n_f]
    upper = np.r_[2 * n + n_f : 3 * n + n_f, 3 * n + 2 * n_f : 3 * n + 3 * n_f]
    counts = {}
    for i in range(-(-steps // SAMPLES)):
        memory, values = given(name, rng)
        said, status = step.many(np.asarray(memory, dtype=float).ravel(), values)
        wrong = ~(said[:, lower] <= said[:, upper])
        if wrong.any():
            k, j = np.argwhere(wrong)[0]
            label = [*observer.outputs["x_lower"], *observer.outputs["f_lower"]][j]
            raise AssertionError(
                f"{name}, seed {seed}, start {i}, step {k}: {label} {said[k, lower[j]]}, upper "
                f"{said[k, upper[j]]}, status {status[k]}, given {values[max(k - 1, 0) : k + 1]}"
            )
        for value, count in zip(*np.unique(status, return_counts=True), strict=True):
            counts[int(value)] = counts.get(int(value), 0) + int(count)
    return counts


LARGE = {"set_membership", "set_adaptive_observer", "filter_bank", "bounded_error_uio"}
"""Steps that take long to compile."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.long] if n in LARGE else []) for n in METHODS]
)
def test_no_measurement_spoils_a_bound(name):
    """Mutant: `finite_or` that hands on what it was given."""
    assert STEP_OUTPUTS[1:7] == ("xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper")
    counts = fuzz(name, 10_000, seed=1)
    assert counts[0] and all(0 <= status < 2 * max(STATUS.values()) for status in counts)
    assert any(status & ~1 for status in counts)


@pytest.mark.long
@pytest.mark.parametrize("name", [*METHODS, PEAK])
def test_ten_million_measurements_spoil_no_bound(name):
    fuzz(name, 10**7 // (len(METHODS) + 1), seed=2)
