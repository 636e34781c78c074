"""What `make firmware` takes for equal, and that it sees a difference."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FIRMWARE = Path(__file__).parents[2] / "tools" / "firmware"


@pytest.fixture(scope="module")
def boards() -> ModuleType:
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
    if subprocess.run(["which", "qemu-system-arm", "arm-none-eabi-gcc"], check=False).returncode:
        pytest.skip("make firmware installs the compiler and the emulator")
    command = [sys.executable, str(FIRMWARE), "luenberger", "--workers", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "is seen" in done.stdout and "WRONG" not in done.stdout
