"""What `make firmware` takes for equal, and that it sees a difference."""

import importlib.util
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen.kernel import DOUBLE, SINGLE
from obsynth.codegen.single import machine_of
from obsynth.designs.core.rounding import rounding_bound

FIRMWARE = Path(__file__).parents[2] / "tools" / "firmware"


@pytest.fixture(scope="module")
def boards() -> ModuleType:
    sys.path.insert(0, str(FIRMWARE))
    spec = importlib.util.spec_from_file_location("boards", FIRMWARE / "boards.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["boards"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_results_are_apart_by_the_numbers_between_them(boards: ModuleType, real: type) -> None:
    """Mutants: zeros of both signs as equal; NaN beside a number as equal; sizes as signs."""
    tiny, one = np.finfo(real).smallest_subnormal, real(1)
    expected = np.array([1, 1, 0, tiny, np.nan, np.nan, np.inf, 2], dtype=real)
    found = np.array([1, np.nextafter(one, 2), -0.0, -tiny, -np.nan, 1, -np.inf, 1], dtype=real)
    ulps = boards.apart(expected, found)
    assert ulps[:5].tolist() == [0, 1, 1, 3, 0]
    assert ulps[5] > 0 and ulps[6] > 2.0**31
    assert ulps[7] == 2.0 ** np.finfo(real).nmant


@pytest.mark.long
def test_a_changed_constant_is_seen_on_every_board() -> None:
    """Mutant: the allowance for library functions given to a step that calls none."""
    if not (shutil.which("qemu-system-arm") and shutil.which("arm-none-eabi-gcc")):
        pytest.skip("make firmware installs the compiler and the emulator")
    command = [sys.executable, str(FIRMWARE), "luenberger", "--workers", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "is seen" in done.stdout and "WRONG" not in done.stdout


def test_records_hold_what_the_machine_makes_of_them(
    boards: ModuleType, make_toy: Callable[[], Any], make_single: Callable[[], Any]
) -> None:
    """Mutants: the memory of the step before in place of its own; records in another type."""
    for toy, real in ((make_toy(), np.float64), (make_single(), np.float32)):
        given, made = boards.recorded(toy)
        assert (given.dtype, made.dtype, len(given)) == (real, real, boards.RECORDS)
        step = machine_of(toy.step, SINGLE if real is np.float32 else DOUBLE)
        size = toy.step.numel_in(0)
        for k in (0, 1, boards.TIMED, boards.RECORDS - 1):
            results = step(given[k, :size], *np.split(given[k, size:], [toy.step.numel_in(1)]))
            np.testing.assert_array_equal(made[k, -size:], results[0])
            np.testing.assert_array_equal(made[k, 0], results[1][0])
        assert np.isfinite(given[: boards.TIMED]).all()
        assert not np.isfinite(given).all()
        if real is np.float64:
            np.testing.assert_array_equal(boards.softened(toy, given), made)


def test_sums_of_the_library_are_bounded_as_roundings_are_counted(boards: ModuleType) -> None:
    """Off by nearly twice what rounding to nearest is, never by more than u |sum| (1 + 2^-31).

    Mutant: half the distance of numbers counted for sums of doubles.
    """
    soft_sum: Any = boards.soft_sum
    # as QEMU's Cortex-M3 computes it, with the library of GCC 12.2
    seen = float.fromhex("0x1.fffffffeb45f1p-1")
    assert soft_sum(1.0, float.fromhex("-0x1.4ba0e0e7aeb2fp-33")) == seen
    rng, count = np.random.default_rng(0), 200_000
    a = np.ldexp(1.0 + rng.choice([0.0, 2.0**-52, 2.0**-33], count), rng.integers(-9, 9, count))
    apart = rng.choice([32, 33, 33, 33, 34, 35], count)
    b = -np.ldexp(rng.uniform(1.0, 2.0, count), np.frexp(a)[1] - 1 - apart)
    a, b = (np.where(rng.random(count) < 0.5, v, -v) for v in (a, b))
    given = np.where(rng.random(count) < 0.1, np.abs(b), b)

    def off(a: Any, b: Any) -> Any:
        """What is lost of a + b."""
        nearest = a + b
        back = nearest - a
        return np.abs((nearest - soft_sum(a, b)) + ((a - (nearest - back)) + (b - back)))

    found = soft_sum(a, given)
    assert (found != a + given).sum() > count // 20
    assert 0.99 < (off(a, given) / np.spacing(np.abs(found))).max() < 1.0
    v = ca.SX.sym("v")
    less = ca.Function("less", [v], [1.0 - v], ["v"], ["r"])
    ends = (np.array([[2.0**-33]]), np.array([[2.0**-32]]))
    counted = rounding_bound(less, {"v": ends})["r"].error[0]
    x = -b[(np.abs(a) == 1.0) & (a > 0.0) & (apart == 33) & (b < 0.0)]
    assert 0.9 * counted < off(1.0, -x).max() <= counted
