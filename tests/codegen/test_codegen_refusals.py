"""Observers that cannot ship and folders that are not ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

from obsynth.codegen import CodegenError, generate_c
from obsynth.symbolic.errors import ObsynthError


def refused(observer: Any, folder: Path, word: str, **options: Any) -> CodegenError:
    with pytest.raises(CodegenError, match=word) as caught:
        generate_c(observer, folder, vectors=100, **options)
    assert isinstance(caught.value, ObsynthError)
    return caught.value


def test_a_plant_without_sample_time(toy: Any, tmp_path: Path) -> None:
    toy.model.Ts = None
    assert refused(toy, tmp_path / "p", "discretise").symbol == "two tanks"


@pytest.mark.parametrize("Ts", [0.0, -1.0, np.inf, np.nan])
def test_a_sample_time_that_is_none(toy: Any, tmp_path: Path, Ts: float) -> None:
    toy.model.Ts = Ts
    refused(toy, tmp_path / "p", "sample time")


def test_a_fault_delay_of_two(toy: Any, tmp_path: Path) -> None:
    toy.fault_delay = 2
    refused(toy, tmp_path / "p", "fault_delay is 2")


@pytest.mark.parametrize(
    ("name", "part", "word"),
    [
        ("width", slice(3, 4), "ends? at|end at"),
        ("z", slice(5, 6), "without gaps"),
        ("z", slice(4, 6, 2), "without gaps"),
        ("z", slice(4, None), "without gaps"),
        ("z", slice(4, 5), r"takes vectors of \[6, 1, 2\] numbers; .* ask for memory \(5\)"),
    ],
)
def test_a_layout_that_does_not_cover_the_memory(
    toy: Any, tmp_path: Path, name: str, part: slice, word: str
) -> None:
    toy.memory_layout[name] = part
    refused(toy, tmp_path / "p", word)


def test_an_empty_layout(toy: Any, tmp_path: Path) -> None:
    toy.memory_layout = {}
    refused(toy, tmp_path / "p", "no memory")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"xhat": ca.SX(3, 1)}, r"returns vectors of \[6, 3, .*xhat \(2\)"),
        ({"status": ca.SX(2, 1)}, r"returns vectors of .*, 2\] .*status \(1\)"),
    ],
)
def test_a_step_of_other_sizes(
    toy: Any, make_step: Any, tmp_path: Path, change: dict[str, Any], word: str
) -> None:
    toy.step = make_step(**change)
    refused(toy, tmp_path / "p", word)


def test_a_step_with_other_outputs(toy: Any, tmp_path: Path) -> None:
    x = ca.SX.sym("x")
    toy.step = ca.Function("step", [x], [x])
    refused(toy, tmp_path / "p", r"takes vectors of \[1\]")


def test_zeros_have_to_count_as_not_initialised(toy: Any, make_step: Any, tmp_path: Path) -> None:
    toy.step = make_step(status=ca.SX(0))
    assert refused(toy, tmp_path / "p", "memory of zeros").status == 0.0


@pytest.mark.parametrize("status", [1.5, 128, float("nan")])
def test_a_status_that_is_no_mask(toy: Any, make_step: Any, tmp_path: Path, status: float) -> None:
    memory = ca.SX.sym("memory", 6)
    plain = make_step()
    ports = [memory, ca.SX.sym("u"), ca.SX.sym("y", 2)]
    outputs = list(plain.call(ports))
    outputs[-1] = ca.if_else(memory[1] > 0.5, status, 1)
    toy.step = ca.Function("step", ports, outputs)
    refused(toy, tmp_path / "p", "no mask of the bits 1, 2, 4, 8, 16")


@pytest.mark.parametrize("kind", ["solver", "external"])
def test_a_step_that_calls_something(toy: Any, make_step: Any, tmp_path: Path, kind: str) -> None:
    plain = make_step()
    ports = [ca.MX.sym(f"p{i}", plain.numel_in(i)) for i in range(3)]
    outputs = list(plain.call(ports))
    z, p = ca.MX.sym("z"), ca.MX.sym("p")
    if kind == "solver":
        solve = ca.rootfinder("root", "newton", {"x": z, "p": p, "g": z**3 - p})
        called = solve(x0=2, p=outputs[1][0])["x"]
    else:
        called = ca.interpolant("table", "linear", [[0.0, 1.0, 9.0]], [0.0, 2.0, 3.0])(
            outputs[1][0]
        )
    outputs[1] = outputs[1] + called
    toy.step = ca.Function("step", ports, outputs)
    refused(toy, tmp_path / "p", "scalar operations")


def test_erfinv_is_not_in_c99(toy: Any, make_step: Any, tmp_path: Path) -> None:
    plain = make_step()
    ports = [ca.SX.sym(f"p{i}", plain.numel_in(i)) for i in range(3)]
    outputs = list(plain.call(ports))
    outputs[1] = ca.erfinv(outputs[1])
    toy.step = ca.Function("step", ports, outputs)
    refused(toy, tmp_path / "p", "erfinv")


def test_a_folder_of_someone_else(toy: Any, tmp_path: Path) -> None:
    target = tmp_path / "mine"
    target.mkdir()
    (target / "thesis.tex").write_text("years of work")
    for overwrite in (False, True):
        refused(toy, target, "is no obsynth C project", overwrite=overwrite)
    (target / "manifest.json").write_text('{"kind": "of another tool"}')
    refused(toy, target, "is no obsynth C project", overwrite=True)
    assert (target / "thesis.tex").read_text() == "years of work"


def test_a_file_is_no_folder(toy: Any, tmp_path: Path) -> None:
    (tmp_path / "p").write_text("")
    refused(toy, tmp_path / "p", "is a file", overwrite=True)


@pytest.mark.usefixtures("unbuilt")
def test_our_own_folder_only_with_overwrite(toy: Any, tmp_path: Path) -> None:
    target = tmp_path / "p"
    target.mkdir()
    first = generate_c(toy, target, name="first", vectors=100)
    refused(toy, target, "overwrite=True")
    assert (target / "src/first.c").exists()
    second = generate_c(toy, target, name="second", vectors=100, overwrite=True)
    assert second.folder == first.folder
    assert not (target / "src/first.c").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["p"]


@pytest.mark.usefixtures("unbuilt")
def test_files_the_user_added_are_not_lost(toy: Any, tmp_path: Path) -> None:
    target = generate_c(toy, tmp_path / "p", vectors=100).folder
    (target / "src/board.c").write_text("int board;\n")
    error = refused(toy, target, "src/board.c", overwrite=True)
    assert error.files == ("src/board.c",)
    assert (target / "src/board.c").exists()


@pytest.mark.usefixtures("unbuilt")
def test_a_link_to_a_folder_stays_a_link(toy: Any, tmp_path: Path) -> None:
    real = tmp_path / "real"
    real.mkdir()
    (tmp_path / "link").symlink_to(real)
    project = generate_c(toy, tmp_path / "link", vectors=100)
    assert project.folder == real.resolve()
    assert (tmp_path / "link").is_symlink()
