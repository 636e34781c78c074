"""Every example runs: those in public docstrings, and those of internals in tests/examples."""

import doctest
import importlib
import pkgutil
from pathlib import Path

import pytest

ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")
EXAMPLES = Path(__file__).parent / "examples"


def module_names() -> list[str]:
    names = []
    for room in ROOMS:
        package = importlib.import_module(f"obsynth.{room}")
        names.append(package.__name__)
        found = pkgutil.walk_packages(package.__path__, prefix=f"{package.__name__}.")
        names += [info.name for info in found]
    return names


def internal() -> dict[str, tuple[str, str]]:
    """Name of an example -> the module in whose namespace it runs, and its text.

    A line ``==== module name`` opens the example of one name of one module.
    """
    found = {}
    for path in sorted(EXAMPLES.glob("*.txt")):
        for part in path.read_text().split("==== ")[1:]:
            head, text = part.split("\n", 1)
            module, name = head.split()
            assert (module, name) not in found
            found[f"{module}.{name}"] = (module, text)
    return found


@pytest.mark.parametrize("name", module_names())
def test_examples_in_docstrings(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE
    )
    assert results.failed == 0


@pytest.mark.parametrize("name", internal())
def test_examples_of_internals(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    module, text = internal()[name]
    namespace = dict(vars(importlib.import_module(module)))
    test = doctest.DocTestParser().get_doctest(text, namespace, name, None, None)
    assert test.examples
    results = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test)
    assert results.failed == 0
