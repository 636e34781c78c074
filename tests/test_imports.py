"""No module imports another in a circle: neither when it is loaded, nor later, nor by name."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")


def sources() -> dict[str, str]:
    """Module -> what it says; the stub of the public names belongs to the package."""
    files = {f"obsynth.{path.stem}": [path] for path in (ROOT / "src/obsynth").glob("*.py")}
    files["obsynth"] = [*files.pop("obsynth.__init__"), ROOT / "src/obsynth/__init__.pyi"]
    for room in ROOMS:
        for path in (ROOT / room).rglob("*.py"):
            parts = path.relative_to(ROOT).with_suffix("").parts
            files[".".join(("obsynth", *parts)).removesuffix(".__init__")] = [path]
    return {name: "\n".join(p.read_text() for p in paths) for name, paths in files.items()}


def running(tree: ast.AST) -> Iterator[ast.AST]:
    """Walk a tree without what stands there for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test).endswith("TYPE_CHECKING"):
            for other in node.orelse:
                yield other
                yield from running(other)
        else:
            yield node
            yield from running(node)


def named(module: str, node: ast.AST) -> list[str]:
    """Return what a node imports, or names in text as ``importlib`` would take it."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        # Relative imports stand in the stub alone, whose package is the module itself.
        base = ".".join(filter(None, (module if node.level else "", node.module)))
        return [f"{base}.{alias.name}" for alias in node.names]
    if isinstance(node, ast.Constant) and isinstance(node.value, str) and "." in node.value:
        return [node.value]
    return []


def imports(texts: dict[str, str]) -> dict[str, set[str]]:
    """Module -> the modules that it imports anywhere, those of a name's package for a name."""
    edges: dict[str, set[str]] = {}
    for module, text in texts.items():
        edges[module] = set()
        for node in running(ast.parse(text)):
            for name in named(module, node):
                if name not in texts and isinstance(node, ast.ImportFrom):
                    name = name.rpartition(".")[0]
                if name in texts:
                    edges[module].add(name)
    return edges


def circles(edges: dict[str, set[str]]) -> set[frozenset[str]]:
    """Return all groups of modules that reach each other, and modules that import themselves."""

    def reached(start: str) -> set[str]:
        found: set[str] = set()
        ahead = [start]
        while ahead:
            new = edges[ahead.pop()] - found
            found |= new
            ahead += new
        return found

    reach = {module: reached(module) for module in edges}
    return {
        frozenset(other for other in reach[module] if module in reach[other])
        for module in edges
        if module in reach[module]
    }


def test_no_module_is_imported_in_a_circle():
    assert [sorted(circle) for circle in circles(imports(sources()))] == []


@pytest.mark.parametrize(
    "line",
    [
        "from obsynth.derive.split import split",
        "from obsynth.derive import split",
        "import obsynth.derive.split",
        "def later():\n    from obsynth.derive.split import split",
        "import importlib\nimportlib.import_module('obsynth.derive.split')",
        "METHODS = {'split': 'obsynth.derive.split'}",
        "if TYPE_CHECKING:\n    pass\nelse:\n    import obsynth.derive.split",
    ],
)
def test_a_circle_is_seen_however_it_is_written(line):
    texts = {
        "obsynth.derive": "",
        "obsynth.derive.split": "import obsynth.symbolic.plant",
        "obsynth.symbolic.plant": line,
    }
    (found,) = circles(imports(texts))
    assert found == {"obsynth.derive.split", "obsynth.symbolic.plant"}


def test_what_type_checkers_alone_read_makes_no_circle():
    texts = {
        "obsynth.a": "from obsynth.b import B",
        "obsynth.b": "if TYPE_CHECKING:\n    from obsynth.a import A",
    }
    assert circles(imports(texts)) == set()


@pytest.mark.long
def test_a_circle_put_into_the_package_is_found():
    texts = sources()
    texts["obsynth.symbolic.errors"] += "\ndef late():\n    import obsynth.evaluate.run\n"
    (found,) = circles(imports(texts))
    assert {"obsynth.symbolic.errors", "obsynth.evaluate.run"} <= found
