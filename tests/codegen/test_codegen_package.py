"""The Python package of a generated project: the step by ctypes, and the wheel."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from methods import observer_of, run_of
from obsynth import FaultDetector
from obsynth.codegen import find_compiler, generate_c
from obsynth.codegen.kernel import REALS
from obsynth.codegen.render import package_name
from obsynth.codegen.single import machine_of

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def imported(folder: Path) -> Any:
    """The package in a folder, under a name that nobody else has."""
    spec = importlib.util.spec_from_file_location("compiled_step", folder / "__init__.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def assert_equal(one: Any, observer: Any, samples: Any) -> None:
    """Every result and the memory, to the last bit, any NaN like any other."""
    machine = machine_of(observer.step, REALS[getattr(observer, "precision", "double")])
    memory = one.memory
    for sample in samples:
        memory, *results = machine(np.array(memory), *sample)
        told = one.step(*sample)
        names = [observer.step.name_out(i) for i in range(1, observer.step.n_out())]
        for name, result in zip(names, results, strict=True):
            if result.size:
                found = np.array(getattr(told, name), dtype=float).reshape(result.shape)
                assert np.array_equal(found, result.astype(float), equal_nan=True), name
                assert (np.signbit(found) == np.signbit(result))[~np.isnan(found)].all(), name
        assert np.array_equal(one.memory, memory, equal_nan=True)


@pytest.mark.parametrize("kind", ["make_toy", "make_single"])
def test_the_package_computes_the_step(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    """Mutants: doubles where the step has floats; results in another order; a short vector filled
    with zeros."""
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
    toy = request.getfixturevalue(kind)()
    folder = generate_c(toy, tmp_path / "p", vectors=100).folder
    package = folder / "python/two_tanks"
    compiler = find_compiler()
    assert compiler is not None
    sources = [f"-I{folder}/include", f"{folder}/src/two_tanks.c", "-lm"]
    target = ["-shared", "-fPIC", "-o", f"{package}/_step.so"]
    subprocess.run([*compiler, *target, *sources], check=True)
    module = imported(package)
    rng = np.random.default_rng(0)
    y = rng.uniform(10, 30, (40, 2)).astype(np.float32)
    y[5::7, 1] = np.nan
    samples = [(np.float32([4.0 + k / 9]), row) for k, row in enumerate(y)]
    one = module.Observer()
    assert one.memory == tuple(np.array([0, 1, 10, 0, 25.5, 20.5]))
    assert_equal(one, toy, samples)
    other = module.Observer(memory=one.memory)
    assert other.step(*samples[0]) == one.step(*samples[0])
    assert other.step(*samples[1]) != other.step(*samples[1])
    with pytest.raises(ValueError, match=r"y has 1 numbers; it takes 2 \(level 1, level 2\)"):
        one.step([4.0], [20.0])
    with pytest.raises(ValueError, match="memory has 5 numbers; it takes 6"):
        module.Observer(memory=np.zeros(5))
    assert module.NAMES["u"] == ("v*/",) and module.UNITS["f"] == ("V",)


def test_a_package_hides_no_module_of_python() -> None:
    assert [package_name(name) for name in ("tank", "lambda", "queue")] == [
        "tank",
        "lambda_observer",
        "queue_observer",
    ]


@pytest.mark.long
def test_a_folder_becomes_a_wheel(tmp_path: Path) -> None:
    """And what that leaves there is no obstacle to writing it anew.

    Mutant: no ``python/*.egg-info`` among what may be left.
    """
    observer = FaultDetector(observer_of("qpv_observer"), window=3)
    folder = generate_c(observer, tmp_path / "p", vectors=100).folder
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation"]
    subprocess.run(command, cwd=folder, check=True, capture_output=True)
    (wheel,) = (folder / "dist").glob("*.whl")
    assert wheel.name.startswith("vessel-1.0.0-cp39-abi3-")
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    found = {path.name for path in (tmp_path / "site/vessel").iterdir()}
    assert len(found) == 2 and "__init__.py" in found
    run = run_of("qpv_observer")
    y = run.y[:50].copy()
    y[7::9] = np.nan
    module = imported(tmp_path / "site/vessel")
    assert_equal(module.Observer(), observer, zip(run.u, y, run.rho, strict=False))
    generate_c(observer, folder, vectors=100, overwrite=True)
    assert not (folder / "dist").exists()
