"""Compiled functions: the same bits, built once, and the virtual machine where none can be."""

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.codegen.build import find_compiler
from obsynth.evaluate import compiled as module
from obsynth.evaluate.compiled import compiled

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv(module.CACHE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def _function():
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    return ca.Function("f", [x, y], [ca.sqrt(x) * y, ca.if_else(x[0] > y, ca.fmax(x[1], 0), -y)])


def test_built_once_and_only_where_it_pays(cache):
    function = _function()
    assert compiled(function, 10) is function and not cache.exists()
    found = compiled(function, module.PAYS)
    assert found.class_name().endswith("External")
    (library,) = cache.iterdir()
    made = library.stat().st_mtime_ns
    again = compiled(function, 10)
    assert again.class_name().endswith("External")
    assert [p.stat().st_mtime_ns for p in cache.iterdir()] == [made]


def test_a_library_that_differs_in_a_bit_is_not_used(cache, monkeypatch):
    """Without the comparison the other function would run in its place."""
    function = _function()
    compiled(function, module.PAYS)
    (library,) = cache.iterdir()
    x, y = ca.SX.sym("x", 2), ca.SX.sym("y")
    results = [ca.sqrt(x) * y * (1 + 2**-52), ca.if_else(x[0] > y, ca.fmax(x[1], 0), -y)]
    library.unlink()
    module._compile(ca.Function("f", [x, y], results), library, find_compiler())
    assert compiled(function, 10) is function


def test_no_compiler_and_no_place(cache, monkeypatch):
    function = _function()
    cache.write_text("a file, not a folder")
    assert compiled(function, module.PAYS) is function
    monkeypatch.setenv("CC", "no-such-compiler")
    assert compiled(function, module.PAYS) is function


def test_a_simulation_and_an_estimate_are_the_same_to_the_last_bit(cache, monkeypatch):
    plant = ob.plants.leaking_tanks()
    observer = ob.IntervalObserver().design(plant)
    record = ob.records.three_tank_leak()
    scenario = ob.scenarios.gentle(plant)
    runs = []
    for pays in (module.PAYS, 0):
        monkeypatch.setattr(module, "PAYS", pays)
        runs.append((ob.simulate(plant, observer, scenario), ob.estimate(observer, record)))
    assert cache.is_dir()
    for one, other in zip(*runs, strict=True):
        for key in ("xhat", "fhat", "x_lower", "x_upper", "f_lower", "f_upper", "status"):
            assert np.array_equal(getattr(one, key), getattr(other, key), equal_nan=True)
