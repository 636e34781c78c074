"""The wheel holds every module of the tree, and nothing else."""

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")


def tracked(*patterns: str) -> set[str]:
    done = subprocess.run(
        ["git", "ls-files", "--", *patterns], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return set(done.stdout.split())


def test_the_wheel_holds_every_module(tmp_path):
    source = tmp_path / "source"
    subprocess.run(["git", "checkout-index", "-a", f"--prefix={source}/"], cwd=ROOT, check=True)
    subprocess.run(
        [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path)],
        cwd=source,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if "dist-info" not in name}
    expected = {name.removeprefix("src/") for name in tracked("src/obsynth/*.py")}
    expected |= {"obsynth/py.typed", "obsynth/__init__.pyi"}
    expected |= {f"obsynth/{name}" for room in ROOMS for name in tracked(f"{room}/*.py")}
    expected |= {f"obsynth/{name}" for room in ROOMS for name in tracked(f"{room}/templates/*")}
    expected |= {f"obsynth/{name}" for name in tracked("symbolic/*.toml")}
    data = ("csv", "md", "LICENSE")
    expected |= {f"obsynth/{n}" for end in data for n in tracked(f"symbolic/records/*.{end}")}
    assert names == expected
