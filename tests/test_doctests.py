"""Every example in a docstring runs."""

import doctest
import importlib
import pkgutil

import pytest

ROOMS = ("symbolic", "derive", "designs", "codegen", "evaluate")


def module_names() -> list[str]:
    names = []
    for room in ROOMS:
        package = importlib.import_module(f"obsynth.{room}")
        names.append(package.__name__)
        found = pkgutil.walk_packages(package.__path__, prefix=f"{package.__name__}.")
        names += [info.name for info in found]
    return names


@pytest.mark.parametrize("name", module_names())
def test_examples(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    results = doctest.testmod(
        importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE
    )
    assert results.failed == 0
