"""The architecture holds: direction of imports, public names, quick import, no leftovers."""

import ast
import importlib
import pkgutil
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")


def imported_rooms(source: str) -> set[str]:
    """Rooms that a module imports, wherever in the module it does."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names = [node.module or ""]
        for name in names:
            parts = name.split(".")
            if parts[0] == "obsynth" and len(parts) > 1 and parts[1] in ROOMS:
                found.add(parts[1])
    return found


def modules_of(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_from_rooms_to_its_left(room):
    allowed = set(ROOMS[: ROOMS.index(room) + 1])
    modules = modules_of(room)
    assert modules
    wrong = {
        str(path.relative_to(ROOT)): sorted(rooms - allowed)
        for path in modules
        if (rooms := imported_rooms(path.read_text())) - allowed
    }
    assert wrong == {}


def test_the_direction_test_sees_a_wrong_import():
    assert imported_rooms("def f():\n    from obsynth.evaluate import run\n") == {"evaluate"}


def all_modules() -> list[str]:
    import obsynth

    names = ["obsynth"]
    for room in ROOMS:
        package = importlib.import_module(f"obsynth.{room}")
        names.append(package.__name__)
        found = pkgutil.walk_packages(package.__path__, prefix=f"{package.__name__}.")
        names += [info.name for info in found]
    assert obsynth.__file__ is not None
    return names


def test_rooms_offer_what_the_public_names_are_taken_from():
    stub = ast.parse((ROOT / "src/obsynth/__init__.pyi").read_text())
    offered = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    assert len(offered) > 40
    for node in offered:
        package = importlib.import_module(f"obsynth.{node.module}")
        for alias in node.names:
            assert hasattr(package, alias.name), f"{node.module} does not offer {alias.name}"


def test_public_names_resolve_and_are_documented():
    import obsynth

    for name in obsynth.__all__:
        value = getattr(obsynth, name)
        assert (value.__doc__ or "").strip(), name
    with pytest.raises(AttributeError, match="attribute nothing"):
        _ = obsynth.nothing


def test_import_loads_no_heavy_library():
    code = (
        "import sys, obsynth\n"
        "heavy = {'casadi', 'sympy', 'numpy', 'scipy', 'cvxpy', 'matplotlib', 'clarabel'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("room", ["symbolic", "derive", "designs"])
def test_rooms_import_without_plotting_or_modelling_libraries(room):
    code = (
        f"import sys, obsynth.{room}\n"
        "heavy = {'cvxpy', 'matplotlib', 'xarray', 'jinja2', 'joblib'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_no_module_is_left_that_nothing_documents():
    undocumented = [
        name for name in all_modules() if not (importlib.import_module(name).__doc__ or "").strip()
    ]
    assert undocumented == []


def test_hosted_checks_call_what_there_is():
    workflow = (ROOT / ".github/workflows/ci.yml").read_text()
    targets = set(re.findall(r"\bmake ([a-z-]+)", workflow))
    assert (
        {"run", "test", "test-long"}
        <= targets
        <= set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    )
    scripts = re.findall(r"\bsh (tools/\S+)", workflow)
    assert scripts and all((ROOT / name).is_file() for name in scripts)


def test_one_version_is_told():
    import obsynth

    files = ("pyproject.toml", "CITATION.cff", "CHANGELOG.md")
    text = "\n".join((ROOT / name).read_text() for name in files)
    told = re.findall(r"^(?:version = \"|version: |## \[)(\d[\d.]*)", text, re.MULTILINE)
    assert told[:3] == [obsynth.__version__] * 3
