"""Units for co-simulation: valid, run by FMPy as a user would, equal to the virtual machine."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import obsynth as ob
from methods import METHODS, observer_of, run_of
from obsynth.codegen import BuildError, CodegenError, find_compiler
from obsynth.codegen.kernel import REALS
from obsynth.codegen.single import machine_of
from obsynth.codegen.start import start_of
from obsynth.derive.rigour import outward
from obsynth.designs.core.boxes import LIMITS

fmpy = pytest.importorskip("fmpy")
from fmpy.fmi2 import FMU2Slave  # noqa: E402
from fmpy.validation import validate_fmu  # noqa: E402

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True, scope="module")
def quick() -> Any:
    """Flags change no bit, see the tests of flags."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("obsynth.codegen.fmu._FLAGS", ("-O0", "-fPIC", "-fvisibility=hidden"))
        yield


def told_by_machine(observer: Any, memory: Any, samples: Any) -> list[list[Any]]:
    """Results without memories of samples, a list of (u, y[, theta])."""
    machine, rows = machine_of(observer.step, REALS[getattr(observer, "precision", "double")]), []
    for sample in samples:
        memory, *row = machine(memory, *sample)
        rows.append(row)
    return rows


def bits(values: Any) -> Any:
    """Doubles as whole numbers, any NaN as the same one."""
    found = np.array(values, dtype=float)
    found[np.isnan(found)] = np.nan
    return found.view(np.int64)


def flat(observer: Any, rows: list[list[Any]]) -> Any:
    """The results in the order of the unit's outputs, (samples, outputs)."""
    names = [observer.step.name_out(i) for i in range(1, observer.step.n_out())]
    fields = ["xhat", "x_lower", "x_upper", "fhat", "f_lower", "f_upper"]
    fields += ["mean_lower", "mean_upper", "alarm", "status", "mean_status"]
    order = [names.index(field) for field in fields if field in names]
    return np.array([np.concatenate([row[i] for i in order]) for row in rows])


def simulate(fmu: ob.Fmu, Ts: float, samples: Any, **options: Any) -> Any:
    """The outputs at the ends of the steps, as FMPy finds them."""
    t = [k * Ts for k in range(len(samples))]
    rows = [(time, *np.concatenate(sample)) for time, sample in zip(t, samples, strict=True)]
    table = np.array(rows, dtype=[(name, float) for name in ("time", *fmu.inputs)])
    options = {"stop_time": len(t) * Ts, "input": table, **options}
    found = fmpy.simulate_fmu(str(fmu.path), **options)
    assert {*found.dtype.names} == {"time", *fmu.outputs}
    return np.array([found[name][1:].astype(float) for name in fmu.outputs]).T


def samples_of_toy(count: int, seed: int = 0) -> list[Any]:
    rng = np.random.default_rng(seed)
    y = rng.uniform(10, 30, (count, 2))
    y[5::7, 1] = np.nan
    return [(rng.uniform(0, 10, 1), row) for row in y]


def slave(fmu: ob.Fmu, folder: Path, name: str = "one") -> Any:
    """An instance that logs into its attribute ``said``; not initialised yet."""
    if not (folder / "binaries").exists():
        fmpy.extract(str(fmu.path), str(folder))
    one = FMU2Slave(
        guid=fmu.guid, unzipDirectory=str(folder), modelIdentifier=fmu.name, instanceName=name
    )
    said: list[str] = []
    # FMPy shows the message without its numbers
    callbacks = fmpy.fmi2.fmi2CallbackFunctions()
    callbacks.logger = fmpy.fmi2.fmi2CallbackLoggerTYPE(lambda *told: said.append(told[4].decode()))
    one.instantiate(callbacks=callbacks)
    return SimpleNamespace(unit=one, said=said, callbacks=callbacks)


def begin(one: Any) -> Any:
    one.unit.setupExperiment(startTime=0.0)
    one.unit.enterInitializationMode()
    one.unit.exitInitializationMode()
    return one.unit


@pytest.fixture(scope="module")
def toy_unit(make_toy: Any, tmp_path_factory: Any) -> Any:
    if find_compiler() is None:
        pytest.skip("no C compiler")
    toy = make_toy()
    return toy, ob.generate_fmu(toy, tmp_path_factory.mktemp("fmu") / "toy.fmu", vectors=100)


def references(fmu: ob.Fmu) -> dict[str, int]:
    description = fmpy.read_model_description(str(fmu.path))
    return {v.name: v.valueReference for v in description.modelVariables}


def test_a_unit_is_the_virtual_machine_to_the_last_bit(toy_unit: Any) -> None:
    """With readings that are missing. Mutant: outputs of one field at the place of another; a
    reading copied before the inputs."""
    toy, fmu = toy_unit
    assert validate_fmu(str(fmu.path)) == []
    assert fmu.comparison is not None and fmu.platform == fmpy.platform
    samples = samples_of_toy(60)
    found = simulate(fmu, 0.5, samples)
    expected = flat(toy, told_by_machine(toy, toy.memory0([25.5, 20.5]), samples))
    assert set(expected[:, -1]) >= {0.0, 2.0}
    np.testing.assert_array_equal(bits(found), bits(expected))


def test_single_precision_computes_in_float_and_speaks_in_double(
    make_single: Any, tmp_path: Path
) -> None:
    """Mutant: the sample time as float, so that no communication step fits."""
    if find_compiler() is None:
        pytest.skip("no C compiler")
    toy = make_single()
    toy.model.Ts = 0.1
    fmu = ob.generate_fmu(toy, tmp_path / "x.fmu", vectors=100)
    samples = [tuple(np.float32(part) for part in sample) for sample in samples_of_toy(9)]
    found = simulate(fmu, 0.1, samples)
    expected = flat(toy, told_by_machine(toy, toy.memory0([25.5, 20.5]), samples))
    np.testing.assert_array_equal(bits(found), bits(expected))


def test_names_units_and_starts_are_those_of_the_plant(toy_unit: Any) -> None:
    """Whatever characters they have. Mutant: text of XML that is not escaped."""
    _, fmu = toy_unit
    assert fmu.inputs == ("v*/", "level 1", "level 2")
    assert fmu.parameters == ("h_1_guess", "h_2_guess")
    faults = ("φ_hat", "φ_lower", "φ_upper")
    assert fmu.outputs[-4:] == (*faults, "status")
    description = fmpy.read_model_description(str(fmu.path))
    found = {v.name: v for v in description.modelVariables}
    assert found["φ_hat"].unit == "V" and found["level 1"].unit == "cm"
    assert {name: float(v.start) for name, v in found.items() if v.start} == {
        "v*/": 4.0,
        "level 1": 25.5,
        "level 2": 20.5,
        "h_1_guess": 25.5,
        "h_2_guess": 20.5,
    }
    assert {v.variability for v in found.values()} == {"discrete", "fixed"}
    assert description.defaultExperiment.stepSize == "0.5"


def test_names_that_fall_together_are_told_apart(make_toy: Any, tmp_path: Path) -> None:
    """Inputs keep theirs. Mutant: one number for all."""
    toy = make_toy()
    toy.model.output_names = ("status", 'h<"&')
    toy.model.output_units = ('<"&', "a  b")
    toy.model.name = 'a<b>&"c'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
        fmu = ob.generate_fmu(toy, tmp_path / "x.fmu", vectors=100)
    assert validate_fmu(str(fmu.path)) == []
    assert fmu.inputs == ("v*/", "status", 'h<"&') and fmu.outputs[-1] == "status_2"
    assert set(fmu.inputs) <= references(fmu).keys()
    assert fmu.platform is None and fmu.build is None
    description = fmpy.read_model_description(str(fmu.path))
    assert [unit.name for unit in description.unitDefinitions] == ['<"&', "V", "a  b", "cm"]
    assert not any(name.startswith("binaries") for name in zipfile.ZipFile(fmu.path).namelist())


def test_the_same_unit_has_the_same_bytes_and_no_other_has_its_guid(
    toy_unit: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mutants: a GUID of the plant alone; the time of day in the archive."""
    toy, fmu = toy_unit
    again = ob.generate_fmu(toy, tmp_path / "again.fmu", vectors=100)
    assert again.path.read_bytes() == fmu.path.read_bytes()
    assert {entry.date_time for entry in zipfile.ZipFile(fmu.path).infolist()} == {
        (1980, 1, 1, 0, 0, 0)
    }
    monkeypatch.setattr("obsynth.codegen.project.find_compiler", lambda: None)
    path = tmp_path / "x.fmu"
    one = ob.generate_fmu(toy, path, vectors=100, guess=[25.5, 21.0])
    monkeypatch.setitem(toy.record, "design", 2)
    two = ob.generate_fmu(toy, path, vectors=100, overwrite=True)
    assert len({fmu.guid, one.guid, two.guid}) == 3


def test_a_file_is_replaced_when_the_new_one_is_complete(
    toy_unit: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Mutant: written in place."""
    toy, fmu = toy_unit
    path = tmp_path / "x.fmu"
    shutil.copy(fmu.path, path)
    with pytest.raises(CodegenError, match="overwrite=True"):
        ob.generate_fmu(toy, path)
    with pytest.raises(CodegenError, match=r"ends with \.fmu"):
        ob.generate_fmu(toy, tmp_path / "x.zip")
    with pytest.raises(CodegenError, match="no folder"):
        ob.generate_fmu(toy, tmp_path / "no" / "x.fmu")
    compiler = find_compiler()
    assert compiler is not None
    monkeypatch.setenv("CC", f"{compiler[0]} -ffast-math")
    with pytest.raises(BuildError, match="remove the checks for NaN"):
        ob.generate_fmu(toy, path, vectors=100, overwrite=True)
    assert path.read_bytes() == fmu.path.read_bytes()
    path.write_text("mine")
    with pytest.raises(CodegenError, match="no FMU"):
        ob.generate_fmu(toy, path, overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["x.fmu"]


def test_instances_are_apart_and_their_states_are_copies(toy_unit: Any, tmp_path: Path) -> None:
    """Reset, states kept, restored, stored as bytes and read into another instance.

    Mutants: a state that is shared between instances; a reset that keeps the memory; bytes of
    another unit that are taken.
    """
    toy, fmu = toy_unit
    vr = references(fmu)
    ins, outs = ([vr[name] for name in names] for names in (fmu.inputs, fmu.outputs[:-1]))
    one, two = (slave(fmu, tmp_path, name) for name in ("one", "two"))
    other = samples_of_toy(9, seed=1)

    def stepped(unit: Any, k: int, sample: Any) -> Any:
        unit.setReal(ins, np.concatenate(sample).tolist())
        unit.doStep(0.5 * k, 0.5)
        return [*unit.getReal(outs), *unit.getInteger([vr["status"]])]

    first, second = begin(one), begin(two)
    start = toy.memory0([25.5, 20.5])
    for k, (a, b) in enumerate(zip(samples_of_toy(9), other, strict=True)):
        found = stepped(first, k, a), stepped(second, k, b)
        if k == 5:
            kept = first.getFMUState()
            stored = first.serializeFMUState(kept)
    for row, given in zip(found, (samples_of_toy(9), other), strict=True):
        expected = flat(toy, told_by_machine(toy, start, given))[-1]
        np.testing.assert_array_equal(bits(row), bits(expected))
    first.setFMUState(kept)
    second.setFMUState(second.deSerializeFMUstate(stored))
    expected = flat(toy, told_by_machine(toy, start, [*samples_of_toy(9)[:6], *other[6:]]))[-1]
    for unit in (first, second):
        for k in (6, 7, 8):
            row = stepped(unit, k, other[k])
        np.testing.assert_array_equal(bits(row), bits(expected))
    first.freeFMUState(kept)
    first.reset()
    assert first.getInteger([vr["status"]]) == [1]
    begin(one)
    for k, sample in enumerate(other):
        row = stepped(first, k, sample)
    np.testing.assert_array_equal(bits(row), bits(found[1]))
    with pytest.raises(fmpy.fmi1.FMICallException):
        first.deSerializeFMUstate(b"x" + stored[1:])
    assert "no state of two_tanks" in one.said[-1]
    with pytest.raises(Exception, match="instantiate"):
        slave(replace(fmu, guid="{another}"), tmp_path)
    for unit in (first, second):
        unit.terminate()
        unit.freeInstance()


def test_steps_take_the_sample_time_or_multiples_of_it(toy_unit: Any, tmp_path: Path) -> None:
    """Readings belong to the first sample of a step; what fits no step is refused and logged.

    Mutants: a reading repeated at later samples; a step of another length taken.
    """
    toy, fmu = toy_unit
    vr = references(fmu)
    one = slave(fmu, tmp_path)
    with pytest.raises(fmpy.fmi1.FMICallException):
        one.unit.doStep(0.0, 0.5)
    assert "not initialised" in one.said[-1]
    unit = begin(one)
    given = samples_of_toy(4)
    missing = np.full(2, np.nan)
    base = 1e9 + 0.25  # rounding of times is no other step
    for k, (u, y) in zip((0, 1, 4, 5), given, strict=True):
        unit.setReal([vr[name] for name in fmu.inputs], [*u, *y])
        for t, h in ((0.5 * k, 0.4), (0.5 * k, 0.0), (0.5 * k, -0.5), (0.5 * k + 0.5, 0.5)):
            if k:
                with pytest.raises(fmpy.fmi1.FMICallException):
                    unit.doStep(base + t, h)
                assert "fmi2DoStep" in one.said[-1]
        unit.doStep(base + 0.5 * k, (1.5 if k == 1 else 0.5) * (1 + 1e-8))
    found = unit.getReal([vr[name] for name in fmu.outputs[:-1]])
    samples = [given[0], given[1], (given[1][0], missing), (given[1][0], missing), *given[2:]]
    expected = flat(toy, told_by_machine(toy, toy.memory0([25.5, 20.5]), samples))[-1]
    np.testing.assert_array_equal(bits(found), bits(expected[:-1]))
    for call, reference in ((unit.getReal, "status"), (unit.getInteger, "v*/")):
        with pytest.raises(fmpy.fmi1.FMICallException):
            call([vr[reference]])
    for name in ("h_1_hat", "h_1_guess"):
        with pytest.raises(fmpy.fmi1.FMICallException):
            unit.setReal([vr[name]], [1.0])
    assert "fixed once" in one.said[-1]


@pytest.mark.parametrize("precision", ["double", "single"])
def test_the_first_memory_follows_the_parameters(
    precision: str, make_toy: Any, make_single: Any, tmp_path: Path
) -> None:
    """As copies, middles and sums, in C as in Python; ranges that are none are refused.

    In single precision ends of ranges are rounded outwards, middles to the nearest number.
    Mutants: a term of a sum left out; the ends of a range exchanged; no check of the limits; ends
    rounded to the nearest, or a number too far; the largest number of double in single.
    """
    toy = make_single() if precision == "single" else make_toy()
    toy.model.boxes["f"] = [(-2.0, 2.0)]

    def memory0(guess: Any, x_range: Any = None, f_range: Any = None) -> Any:
        x = np.asarray(guess, dtype=float)
        box = outward(np.array(toy.model.boxes["x"] if x_range is None else x_range), precision)
        f = np.zeros((1, 2)) if f_range is None else np.asarray(f_range)
        z = np.array([[1.0, 0.25], [0.5, 0.0]]) @ x
        middle = REALS[precision].type(f.mean())
        return np.array([z[1], 1.0, box[0, 0], middle, 1.0 + z[0], box[1, 1]])

    toy.memory0 = memory0
    start = start_of(toy)
    assert start.guesses == 2
    assert [p.name for p in start.parameters[-2:]] == ["φ_first_lower", "φ_first_upper"]
    assert [rule for _, rule in start.rules] == [
        "0.5 * v[0]",
        "v[2]" if precision == "double" else "outward(v[2], -INFINITY)",
        "0.5 * (v[6] + v[7])",
        "1.0 + 1.0 * v[0] + 0.25 * v[1]",
        "v[5]" if precision == "double" else "outward(v[5], INFINITY)",
    ]
    if find_compiler() is None:
        return
    fmu = ob.generate_fmu(toy, tmp_path / "x.fmu", vectors=100)
    assert validate_fmu(str(fmu.path)) == []
    given = {"h_1_guess": 17.0, "h_2_guess": 9.0, "h_1_first_lower": 3.0, "h_2_first_upper": 39.1}
    given |= {"φ_first_lower": -1.1, "φ_first_upper": 2.0}
    memory = memory0([17, 9], [[3, 50], [1, 39.1]], [[-1.1, 2]])
    samples = samples_of_toy(5)
    found = simulate(fmu, 0.5, samples, start_values=given)
    expected = flat(toy, told_by_machine(toy, memory, samples))
    np.testing.assert_array_equal(bits(found), bits(expected))
    vr = references(fmu)
    for name, value, word in (
        ("h_1_guess", np.nan, "number from"),
        ("h_1_guess", 2.0 * LIMITS[precision].finite, "number from"),
        ("h_1_first_lower", 0.5, "number from"),
        ("h_1_first_upper", 0.5, "number from"),
        ("φ_first_upper", -1.0, "lies above"),
    ):
        one = slave(fmu, tmp_path)
        one.unit.setReal([vr[name]], [value])
        with pytest.raises(fmpy.fmi1.FMICallException):
            begin(one)
        assert word in one.said[-1]


def test_a_design_for_single_precision_has_the_parameters_of_one_for_double() -> None:
    """Mutant: ends of ranges as copies alone, which a memory of single precision does not hold."""
    entry = METHODS["interval_observer"]
    single: Any = replace(entry.method, precision="single")
    names = [
        [p.name for p in start_of(observer).parameters]
        for observer in (observer_of("interval_observer"), single.design(entry.plant()))
    ]
    assert len(names[0]) == 8
    assert names[0] == names[1]


def test_a_memory_that_depends_in_another_way_has_no_parameters(make_toy: Any) -> None:
    """Nor has one whose start is no number. Mutants: sums compared with one draw, or with none."""
    toy = make_toy()
    first = toy.memory0
    for bent in (lambda x: np.maximum(x, 20.0), lambda x: np.abs(x - 20.0)):
        toy.memory0 = lambda guess, bent=bent, **boxes: first(bent(np.asarray(guess)))
        assert start_of(toy).parameters == ()
    toy.memory0 = lambda guess, **boxes: first([1.0, 2.0])
    assert start_of(toy).parameters == ()
    toy.memory0 = lambda guess, x_range=None, f_range=None: first(
        [1.0, 50.0 if x_range is None else x_range[0][1]]
    )
    assert [p.upper for p in start_of(toy).parameters] == [50.0, 50.0, 40.0, 40.0]
    toy.model.boxes["x"] = [(1.0, 50.0), (1.0, np.inf)]
    assert start_of(toy).parameters == ()
    toy.memory0 = lambda guess, x_range=None, f_range=None: first(np.asarray(guess) ** 2)
    np.testing.assert_array_equal(start_of(toy, [2.0, 3.0]).memory, first([4.0, 9.0]))


@pytest.mark.long
@needs_compiler
@pytest.mark.parametrize("name", [name for name in METHODS if "." not in name])
def test_every_method_is_the_virtual_machine(name: str, tmp_path: Path) -> None:
    """Detectors with a window where there are any, begun from parameters that were changed."""
    observer: Any = observer_of(name)
    if METHODS[name].detects:
        observer = ob.FaultDetector(observer, window=None if name == "filter_bank" else 3)
    model, run, start = observer.model, run_of(name), start_of(observer)
    rng = np.random.default_rng(0)
    told = {"guess": METHODS[name].scenario().guess}
    given = dict(zip((f"{s.name}_guess" for s in model.x), told["guess"], strict=True))
    for kind in "xf":
        signals = getattr(model, kind)
        if {f"{s.name}_first_lower" for s in signals} & {p.name for p in start.parameters}:
            low, high = np.clip(model.box(kind), -1e3, 1e3).T
            told[f"{kind}_range"] = box = np.sort(rng.uniform(low, high, (2, len(low))), axis=0).T
            for s, pair in zip(signals, box.tolist(), strict=True):
                given |= {f"{s.name}_first_lower": pair[0], f"{s.name}_first_upper": pair[1]}
    given = {p.name: float(given[p.name]) for p in start.parameters}
    memory = start.memory.copy()
    for i, rule in start.rules:
        memory[i] = eval(rule, {"v": [*given.values()]})
    np.testing.assert_allclose(memory, observer.memory0(**told), rtol=1e-13, atol=1e-13)
    fmu = ob.generate_fmu(observer, tmp_path / "x.fmu", vectors=100)
    assert validate_fmu(str(fmu.path)) == []
    y = run.y[:60].copy()
    y[rng.random(y.shape) < 0.1] = np.nan
    measured = [i for i, s in enumerate(model.rho) if s.measured]
    columns = [run.u[:60], y] + ([run.rho[:60, measured]] if measured else [])
    samples = list(zip(*columns, strict=True))
    expected = flat(observer, told_by_machine(observer, memory, samples))
    found = simulate(fmu, float(model.Ts), samples, start_values=given)
    np.testing.assert_array_equal(bits(found), bits(expected))


@pytest.mark.long
@needs_compiler
def test_the_documented_way_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Python and shell of docs/fmu.md; sources that FMPy compiles are equal, too."""
    monkeypatch.chdir(tmp_path)
    blocks = (ROOT / "docs/fmu.md").read_text().split("```")[1::2]
    (_, python), (_, shell) = (block.split("\n", 1) for block in blocks)
    exec(compile(python, "docs/fmu.md", "exec"), {})
    lines = [*shell.strip().splitlines(), "fmpy compile tank.fmu"]
    lines.append(lines[1].replace("out.csv", "again.csv"))
    for line in lines:
        _, *arguments = line.split()
        done = subprocess.run([sys.executable, "-m", "fmpy", *arguments], capture_output=True)
        assert done.returncode == 0, done.stdout + done.stderr
    assert Path("again.csv").read_text() == Path("out.csv").read_text()
    found = np.genfromtxt("out.csv", delimiter=",", names=True)
    assert found["status"][1:].tolist() == [32.0 if k == 10 else 0.0 for k in range(40)]
    assert (found["h_lower"] <= found["h_hat"]).all()
