"""Scheduled observers: theta as one more group of inputs, from the plant to the compiled step."""

from __future__ import annotations

import json
import re
import subprocess
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
import sympy as sp

from obsynth.codegen import (
    CodegenError,
    ComparisonError,
    build_and_compare,
    find_compiler,
    generate_c,
)
from obsynth.codegen.description import describe
from obsynth.codegen.drive import Drive
from obsynth.symbolic import Plant

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")

NAMES = ("next", "xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status")


def cart() -> Plant:
    """Two measured scheduling signals around one that is bounded only."""
    plant = Plant("cart")
    a, b = plant.states("a b", range=(-5, 5), unit="m")
    (v,) = plant.inputs("v", range=(-1, 1), unit="N")
    (mass,) = plant.scheduling("mass", range=(1, 3), nominal=2, unit="kg")
    (drag,) = plant.scheduling("drag", range=(0, 0.2), measured=False)
    (speed,) = plant.scheduling("speed", range=(-1, 4), unit="m/s")
    (w,) = plant.disturbances("w", bound=0.1)
    plant.dynamics([a + 0.1 * b, b + 0.1 * (v / mass - drag * b + sp.sin(speed))], Ts=0.1)
    plant.outputs([a + w], unit="m")
    return plant


def step(n_theta: int = 2, last: str = "theta") -> ca.Function:
    memory, u, y = ca.SX.sym("memory", 3), ca.SX.sym("u"), ca.SX.sym("y")
    theta = ca.SX.sym("theta", n_theta)
    finite = ca.logic_and(ca.fabs(y) <= 1e300, ca.fabs(u) <= 1e300)
    for i in range(n_theta):
        finite = ca.logic_and(finite, ca.fabs(theta[i]) <= 1e300)
    z, ready = memory[1:], memory[0] >= 0.5
    gain = 0.3 + 0.1 * theta[0]
    xhat = z + ca.if_else(finite, y - z[0], 0) * ca.vertcat(gain, 0.5)
    push = ca.if_else(finite, u / ca.fmax(theta[0], 0.5) + ca.sqrt(ca.fabs(theta[-1])), 0)
    following = ca.vertcat(memory[0], xhat[0] + 0.1 * xhat[1], xhat[1] + 0.1 * push)
    radius = ca.if_else(finite, 0.4, ca.inf)
    low = ca.if_else(ca.logic_and(theta[0] >= 1, theta[0] <= 3), 0, 4)
    status = ca.if_else(ready, 0, 1) + ca.if_else(finite, low, 2)
    none = ca.SX(0, 1)
    outputs = [following, xhat, none, xhat - radius, xhat + radius, none, none, status]
    inputs = ["memory", "u", "y", last]
    return ca.Function("step", [memory, u, y, theta], outputs, inputs, list(NAMES))


class Unproved(tuple[Any, ...]):
    """No claims."""

    def check(self, level: str) -> Unproved:
        return self


@dataclass
class Scheduled:
    step: ca.Function
    model: Plant
    method: str = "toy_observer"
    precision: str = "double"
    fault_delay: int = 0
    record: Any = field(default_factory=lambda: {"design": 1})
    certificate: Unproved = field(default_factory=Unproved)

    @property
    def memory_layout(self) -> dict[str, slice]:
        return {"initialised": slice(0, 1), "z": slice(1, 3)}

    @property
    def guarantee(self) -> SimpleNamespace:
        return SimpleNamespace(claims=("a bound",), assumptions=("theta in its range",))

    def memory0(self, guess: Any, **ranges: Any) -> Any:
        return np.array([1.0, *guess])


@pytest.fixture
def observer() -> Scheduled:
    return Scheduled(step(), cart())


@needs_compiler
def test_all_recorded_scheduled_steps_are_equal_to_the_last_bit(
    observer: Scheduled, tmp_path: Path
) -> None:
    project = generate_c(observer, tmp_path / "p")
    assert project.comparison is not None
    assert project.comparison.vectors == 3000
    assert dict(project.sizes) == {"memory": 3, "u": 1, "y": 1, "theta": 2, "x": 2, "f": 0}
    assert {1, 2} & set(project.statuses)
    assert project.statuses[0] > 1_500, "most closed loops stay in the declared ranges"


def test_the_project_speaks_of_the_measured_signals_only(
    observer: Scheduled, tmp_path: Path
) -> None:
    project = generate_c(observer, tmp_path / "p", vectors=100)
    header = (project.folder / "include/cart.h").read_text()
    for line in (
        "#define CART_N_THETA 2",
        "#define CART_THETA_mass 0 /* mass [kg], declared range 1 to 3 */",
        "#define CART_THETA_speed 1 /* speed [m/s], declared range -1 to 4 */",
        "    cart_real_t theta[2]; /* scheduling: mass [kg], speed [m/s] */",
    ):
        assert line in header
    assert "drag" not in header
    readme = (project.folder / "README.md").read_text()
    assert "| `theta[1]` | `speed` | m/s | -1 to 4 |" in readme
    assert "fill in.u, in.y and in.theta with" in readme
    assert "- **Scheduling.**" in readme
    assert "status, u, y, theta, xhat, x_lower" in readme
    manifest = json.loads((project.folder / "manifest.json").read_text())
    assert [signal["name"] for signal in manifest["signals"]["theta"]] == ["mass", "speed"]
    main = (project.folder / "examples/main.c").read_text()
    assert re.search(r"\{\{0\.0\}, \{[^}]*\}, \{2\.0, 1\.5\}\}", main), "nominal, else mid-range"


@needs_compiler
def test_the_example_of_a_scheduled_project_runs(observer: Scheduled, tmp_path: Path) -> None:
    folder = generate_c(observer, tmp_path / "p", vectors=100).folder
    done = subprocess.run(["make", "example"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("status 0") == 5


MUTANTS = {
    "places swapped": ("src/cart_kernel.h", r"theta\[0\]", "theta[1]"),
    "another group": ("src/cart.c", r"in->theta", "in->y"),
    "neighbour": ("src/cart.c", r"in->theta", "in->theta - 1"),
}


@needs_compiler
@pytest.mark.parametrize("mutant", MUTANTS)
def test_wrong_scheduling_is_caught(
    observer: Scheduled, tmp_path: Path, mutant: str, unbuilt: None
) -> None:
    project = generate_c(observer, tmp_path / "p", vectors=300)
    file, pattern, replacement = MUTANTS[mutant]
    path = project.folder / file
    text, count = re.subn(pattern, replacement, path.read_text())
    assert count
    path.write_text(text)
    compiler = find_compiler()
    assert compiler is not None
    with pytest.raises(ComparisonError):
        build_and_compare(
            project.folder, "cart", compiler=compiler, extra_flags=("-w", "-fno-strict-aliasing")
        )


def test_the_drive_gives_the_step_what_the_plant_moves_by(observer: Scheduled) -> None:
    drive = Drive(describe(observer), np.random.default_rng(0))
    drive.begin(60)
    seen = []
    for k in range(60):
        inputs = drive.sample(k)
        assert [value.size for value in inputs] == [1, 1, 2]
        rho = drive._levels["rho"]
        np.testing.assert_array_equal(inputs[2], rho[[0, 2]])
        seen.append(inputs[2])
    theta = np.array(seen)
    assert len(np.unique(theta[:, 0])) == 3, "held over 20 samples"
    box = np.array([(1, 3), (-1, 4)])
    assert np.all((theta >= box[:, 0]) & (theta <= box[:, 1]))


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"step": step(n_theta=3)}, r"takes vectors of .*, 3\] numbers.* ask for .*theta \(2\)"),
        ({"step": step(last="p")}, r"takes vectors of \[\d+, \d+, \d+, \d+\] numbers"),
    ],
)
def test_steps_that_do_not_fit_are_refused(
    observer: Scheduled, tmp_path: Path, changes: dict[str, Any], word: str
) -> None:
    for key, value in changes.items():
        setattr(observer, key, value)
    with pytest.raises(CodegenError, match=word):
        generate_c(observer, tmp_path / "p", vectors=100)


def test_a_plant_without_measured_scheduling_is_refused(tmp_path: Path) -> None:
    plant = Plant("blind")
    a, b = plant.states("a b", range=(-5, 5))
    (v,) = plant.inputs("v", range=(-1, 1))
    (r,) = plant.scheduling("r", range=(1, 3), measured=False)
    plant.dynamics([a + r * b, b + v], Ts=0.1)
    plant.outputs([a])
    with pytest.raises(CodegenError, match="'blind' and the memory layout ask for memory"):
        generate_c(Scheduled(step(1), plant), tmp_path / "p", vectors=100)


def test_half_of_the_trajectories_are_kept_where_they_start(observer: Scheduled) -> None:
    drive = Drive(describe(observer), np.random.default_rng(1))
    moved = {True: 0.0, False: 0.0}
    for sequence in range(1, 9):
        drive.begin(20)
        start = drive._x.copy()
        kept = sequence % 4 < 2
        assert drive._rest is kept
        inputs = [drive.sample(k)[0] for k in range(20)]
        assert np.ptp(inputs) == 0.0, "held"
        assert np.all(np.abs(inputs) <= 1.0)
        moved[kept] += abs(drive._x[1] - start[1])
    assert moved[True] < 0.5 * moved[False]
