"""What every method of tests/methods.py owes; a new method enters a line there and meets it all."""

import copy
import json
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from methods import METHODS, observer_of, run_of, simulated
from obsynth.codegen import find_compiler
from obsynth.designs.core.certificate import Certificate, Claim
from obsynth.designs.core.errors import CertificateError, DetectorError
from obsynth.designs.core.files import CLAIMS
from obsynth.designs.core.method import CONTRACTS, VERSION
from obsynth.designs.core.observer import STATUS, STEP_OUTPUTS
from obsynth.designs.detection.observed import core_of

ALONE = """
import importlib, sys
sys.modules["clarabel"] = sys.modules["cvxpy"] = None
import obsynth as ob
for module, path in zip(sys.argv[1::2], sys.argv[2::2]):
    importlib.import_module(module)
    certificate = ob.load(path).certificate.check()
    print(path, len(certificate.claims), certificate.valid)
"""


@pytest.fixture(params=METHODS)
def name(request):
    return request.param


@pytest.fixture
def entry(name):
    return METHODS[name]


@pytest.fixture
def observer(name):
    return observer_of(name)


def contract_of(observer):
    return CONTRACTS[observer.method]


def read(observer, record):
    return contract_of(observer).record.from_record(record)


def guess(observer):
    nominal = [signal.nominal for signal in observer.model.x]
    middle = observer.model.box("x").mean(axis=1)
    return np.array([m if v is None else float(v) for v, m in zip(nominal, middle, strict=True)])


def held(observer, y=None):
    """Nominal inputs, and measurements of the guess."""
    model = observer.model
    u = np.array([0.0 if s.nominal is None else float(s.nominal) for s in model.u])
    rho = [s for s in model.rho if s.measured]
    theta = (
        [np.array([0.5 * (s.lower + s.upper) for s in rho])] if observer.step.n_in() == 4 else []
    )
    zeros = [np.zeros(len(model.names(kind))) for kind in ("d", "f", "w", "p")]
    if y is None:
        y = np.array(
            model.function()(
                guess(observer), u, *zeros, theta[0] if theta else np.zeros(len(model.rho))
            )[1]
        )
    return [u, np.asarray(y, dtype=float).ravel(), *theta]


def outputs(observer, memory, given):
    values = observer.step(memory, *given)
    return dict(zip(STEP_OUTPUTS, (np.array(v).ravel() for v in values), strict=True))


def test_the_table_holds_every_method():
    assert {entry.method.CONTRACT.name for entry in METHODS.values()} == set(CONTRACTS)
    names = [name.partition(".")[0] for name in METHODS]
    assert [entry.method.CONTRACT.name for entry in METHODS.values()] == names


# -- design and refusals -----------------------------------------------------------------------


def test_the_precision_is_an_option_that_a_design_stores(entry, observer):
    """Mutants: another word passes."""
    design = observer.certificate.design
    assert observer.precision == design.precision == "double"
    assert contract_of(observer).guard(design).precision == "double"
    with pytest.raises(ob.ObsynthError, match=r"precision is 'half'"):
        replace(entry.method, precision="half")
    record = json.loads(json.dumps(observer.record))
    record["options"]["precision"] = "half"
    with pytest.raises(CertificateError, match="'double', 'single'"):
        contract_of(observer).certify(read(observer, record), "lmi")
    assert replace(entry.method, precision="single").precision == "single"


def test_a_design_has_a_checked_certificate(entry, monkeypatch):
    required = []
    original = Certificate.require

    def counted(self):
        required.append(self)
        return original(self)

    monkeypatch.setattr(Certificate, "require", counted)
    observer = entry.method.design(entry.plant())
    assert observer.certificate in required
    assert observer.certificate.valid and len(observer.certificate.claims) >= 2
    assert all(claim.statement and claim.proof for claim in observer.certificate)
    assert observer.guarantee.claims and observer.guarantee.assumptions
    names = [claim.name for claim in observer.certificate]
    assert len(set(names)) == len(names)


def test_an_unproved_claim_stops_the_design(entry, monkeypatch):
    """Mutant: one claim that does not hold."""
    original = Certificate.__init__

    def doubtful(self, claims, design, contract):
        false = Claim("mutant", "is true", False, -1.0, "none")
        original(self, (*claims, false), design, contract)

    monkeypatch.setattr(Certificate, "__init__", doubtful)
    with pytest.raises(ob.CertificateError, match="is true"):
        entry.method.design(entry.plant())


def test_a_plant_outside_the_class_is_refused_by_its_names(entry):
    plant = entry.outside()
    with pytest.raises(ob.StructureError) as refusal:
        entry.method.design(plant)
    kinds = ("x", "u", "d", "f", "w", "p", "rho")
    names = [plant.name, *plant.output_names, *(n for kind in kinds for n in plant.names(kind))]
    assert any(name in str(refusal.value) for name in names)


def test_a_plant_without_equations_is_told_that_before_anything_else(entry):
    plant = ob.Plant("pump")
    (x,) = plant.states("x", range=(0, 1))
    plant.outputs([x])
    with pytest.raises(ob.PlantError, match="'pump' has no dynamics yet"):
        entry.method.design(plant)


def test_an_option_that_is_not_one_is_refused_by_its_name(entry):
    if entry.option is None:
        pytest.skip("no options")
    ((name, value),) = entry.option.items()
    with pytest.raises(ob.ObsynthError, match=f"^{name} is {value!r}; ") as refusal:
        replace(entry.method, **entry.option)
    assert refusal.value.option == name


def test_given_gains_are_proved_and_wrong_ones_named(entry, observer):
    if not entry.gains:
        pytest.skip("no gains")
    gains = {name: np.array(observer.gains[name]) for name in entry.gains}
    given = entry.method.analyse(entry.plant(), gains)
    assert given.certificate.valid and given.method == observer.method
    for name in entry.gains:
        np.testing.assert_allclose(given.gains[name], gains[name], rtol=1e-12, atol=1e-15)
    last = entry.gains[-1]
    for wrong in (gains[last][:, :-1], np.full_like(gains[last], np.nan)):
        with pytest.raises(ob.ObsynthError, match=last):
            entry.method.analyse(entry.plant(), {**gains, last: wrong})


# -- the file ----------------------------------------------------------------------------------


def test_every_file_is_proved_again_in_another_process_without_a_solver(tmp_path):
    arguments = []
    for name, entry in METHODS.items():
        path = tmp_path / f"{name}.json"
        observer_of(name).save(path)
        assert all(claim["holds"] for claim in json.loads(path.read_text())["claims"])
        arguments += [entry.module, str(path)]
    command = [sys.executable, "-c", ALONE, *arguments]
    tests = str(Path(__file__).parents[1])
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join((tests, os.environ.get("PYTHONPATH", ""))),
        },
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [(line[0], line[2]) for line in lines] == [(path, "True") for path in arguments[1::2]]
    for line, name in zip(lines, METHODS, strict=True):
        assert int(line[1]) == len(observer_of(name).certificate.claims)


def test_a_record_is_read_as_it_was_written(observer):
    again = contract_of(observer).to_record(read(observer, observer.record))
    texts = [
        json.dumps(record, allow_nan=False, sort_keys=True) for record in (again, observer.record)
    ]
    assert texts[0] == texts[1]


def test_claims_in_the_file_are_not_believed(entry, observer, tmp_path):
    path = tmp_path / "design.json"
    observer.save(path)
    stored = json.loads(path.read_text())
    (*way, last), factor, falls = entry.spoilt
    place = stored
    for key in way:
        place = place[key]
    place[last] *= factor
    assert all(claim["holds"] for claim in stored[CLAIMS])
    path.write_text(json.dumps(stored))
    with pytest.raises(ob.CertificateError) as refusal:
        ob.load(path)
    assert falls in {claim.name for claim in refusal.value.failed}


def leaves(value, way=()):
    """Ways to the arrays in a record; the plant, the options and words for people apart."""
    if isinstance(value, dict):
        for key, entry in value.items():
            if key not in ("plant", "options", "labels"):
                yield from leaves(entry, (*way, key))
    elif isinstance(value, list) and value and np.asarray(value, dtype=object).ndim:
        yield way


def proved(observer, record):
    return contract_of(observer).certify(read(observer, record), "full").require()


def put(record, way, change):
    record = copy.deepcopy(dict(record))
    place = record
    for key in way[:-1]:
        place = place[key]
    place[way[-1]] = change(place[way[-1]])
    return record


def test_what_does_not_fit_a_record_is_refused_as_a_certificate_error(observer):
    record = json.loads(json.dumps(observer.record))
    places = list(leaves(record))
    assert len(places) >= 5
    for way in places:
        for change in (lambda _: None, lambda _: "text", lambda v: [*v, *v, *v]):
            with pytest.raises(ob.CertificateError):
                proved(observer, put(record, way, change))
    for name in set(record) - {"format", "version", "method"}:
        missing = {key: value for key, value in record.items() if key != name}
        with pytest.raises(ob.CertificateError, match="cannot be read"):
            read(observer, missing)


def test_headers_of_others_are_refused_in_a_sentence(observer, tmp_path):
    path = tmp_path / "design.json"
    for change, said in (
        ({"version": VERSION - 1}, f"version {VERSION - 1} .* reads version {VERSION}"),
        ({"format": "letter"}, "no design"),
        ({"method": "none"}, "'none' is not known; known are"),
    ):
        path.write_text(json.dumps({**observer.record, **change}))
        with pytest.raises(ob.CertificateError, match=said):
            ob.load(path)


# -- the step ----------------------------------------------------------------------------------


def test_the_step_keeps_the_contract(observer):
    model, step = observer.model, observer.step
    measured = [s for s in model.rho if s.measured]
    names = ["memory", "u", "y", "theta"]
    assert step.name_in() == names[: step.n_in()] and step.name_out() == list(STEP_OUTPUTS)
    memory, given = observer.memory0(guess(observer)), held(observer)
    many = step.mapaccum(3)(memory, *(np.tile(part[:, None], 3) for part in given))
    for k in range(3):
        told = outputs(observer, memory, given)
        for name, all_of_them in zip(STEP_OUTPUTS, many, strict=True):
            np.testing.assert_array_equal(np.array(all_of_them)[:, k], told[name])
        memory = told["memory_next"]
    n, n_f, m = len(model.x), len(model.f), len(model.output_names)
    size = max(part.stop for part in observer.memory_layout.values())
    assert [step.numel_in(i) for i in range(3)] == [size, len(model.u), m]
    if step.n_in() == 4:
        assert step.numel_in(3) == len(measured) > 0
    assert [step.numel_out(i) for i in range(8)] == [size, n, n_f, n, n, n_f, n_f, 1]
    assert observer.fault_delay in (0, 1)
    assert observer.half_widths is None or observer.half_widths.shape == (n + n_f,)
    assert model.Ts is not None
    assert isinstance(step, ca.Function)


def test_zeros_are_a_memory_that_nobody_initialised(observer):
    zeros = np.zeros(observer.step.numel_in(0))
    told = outputs(observer, zeros, held(observer))
    assert int(told["status"][0]) & 1
    begun = outputs(observer, observer.memory0(guess(observer)), held(observer))
    assert not int(begun["status"][0]) & 1


@pytest.mark.parametrize("word", ["guess", "x_range", "f_range", "y0"])
def test_what_starts_it_is_checked_by_its_name(observer, word):
    """Mutant: y0 passed on as it is given."""
    model = observer.model
    box, n_f, m = model.box("x"), len(model.f), len(model.output_names)
    x_box = np.where(np.isfinite(box), box, [-1.0, 1.0])
    fits = {"guess": guess(observer), "x_range": x_box, "f_range": [[0, 0]] * n_f, "y0": [0.0] * m}
    observer.memory0(guess(observer), y0=[np.nan] * m)
    array = np.asarray(fits[word], dtype=float)
    wrong = [[*array, *array, [0.0, 1.0] if array.ndim == 2 else 0.0], "text", 1j, {}, [[[1.0]]]]
    if array.size:
        wrong += [array.astype(str), array.astype(complex), array.astype(bool)]
    if array.size and word != "y0":
        wrong += [array + np.nan, array + np.inf]
    for value in wrong:
        with pytest.raises(ob.ObsynthError, match=f"^{word} has to be ") as refusal:
            observer.memory0(**{**fits, word: value})
        assert refusal.value.option == word
    with pytest.raises(ob.ObsynthError, match=r"guess, x_range, f_range, y0.* no 'x_rang'"):
        observer.memory0(guess(observer), x_rang=x_box)


def test_a_missing_measurement_is_told_and_survived(observer):
    given = held(observer)
    memory = observer.memory0(guess(observer), y0=given[1])
    for _ in range(3):
        memory = outputs(observer, memory, given)["memory_next"]
    for bad in (np.nan, np.inf):
        y = given[1].copy()
        y[0] = bad
        told = outputs(observer, memory, held(observer, y))
        assert int(told["status"][0]) & (2 | 8 | 32) == 32
        assert np.isfinite(told["xhat"]).all() and np.isfinite(told["fhat"]).all()
        after = outputs(observer, told["memory_next"], given)
        assert np.isfinite(after["xhat"]).all() and np.isfinite(after["fhat"]).all()
        assert not int(after["status"][0]) & (2 | 8 | 32)
        assert (after["x_lower"] <= after["x_upper"]).all()


def test_a_missing_input_begins_the_sets_anew(observer):
    given = held(observer)
    if not given[0].size:
        pytest.skip("no inputs")
    memory = observer.memory0(guess(observer), y0=given[1])
    for _ in range(3):
        memory = outputs(observer, memory, given)["memory_next"]
    told = outputs(observer, memory, [np.full_like(given[0], np.nan), *given[1:]])
    assert int(told["status"][0]) & (2 | 8) == 2
    assert told["memory_next"][observer.memory_layout["age"]] == 0
    after = outputs(observer, told["memory_next"], given)
    assert not int(after["status"][0]) & (2 | 8)
    assert (after["x_lower"] <= after["x_upper"]).all()


def test_an_impossible_reading_is_void_and_forgotten(entry, observer):
    """Nothing of what came before a void instant enters the sets that follow it.

    Mutants: the older copy not reset; status 64 left out.
    """
    given = held(observer)
    memories = []
    for moved in (0.0, 0.05):
        box = observer.model.box("x")
        other = np.clip(guess(observer) + moved * (box[:, 1] - guess(observer)), *box.T)
        near = box + np.outer(moved * np.diff(box)[:, 0], [1, 0])
        x_range = near if np.isfinite(near).all() else None
        memory = observer.memory0(other, x_range=x_range, y0=given[1])
        for _ in range(3):
            memory = outputs(observer, memory, given)["memory_next"]
        memories.append(memory)
    y = given[1] + 1e20
    told = [outputs(observer, memory, held(observer, y)) for memory in memories]
    impossible = int(told[0]["status"][0])
    if not impossible & 8:
        pytest.skip("every reading is possible")
    contractor = observer.certificate.contract.guard(observer.certificate.design).contractor
    bounded = np.isfinite(contractor.shown(contractor.domain)).any()
    assert bool(impossible & 32) == bounded
    assert not np.array_equal(memories[0], memories[1])
    layout = observer.memory_layout
    for one in told:
        x_box = observer.model.box("x")
        np.testing.assert_array_equal(one["x_lower"], x_box[:, 0])
        np.testing.assert_array_equal(one["x_upper"], x_box[:, 1])
        assert one["memory_next"][layout["age"]] == 0
        assert one["memory_next"][layout["begin"]] == one["memory_next"][layout["begin_2"]] == 1
    shared = contract_of(observer).guard(observer.certificate.design).shared
    kept = np.ones(len(memories[0]), dtype=bool)
    for part in shared:
        kept[layout[part]] = False
    follow = [one["memory_next"] for one in told]
    recovery = entry.method.recovery
    for k in range(recovery + 2):
        after = [outputs(observer, memory, given) for memory in follow]
        if not shared:
            for bound in ("x_lower", "x_upper", "f_lower", "f_upper"):
                np.testing.assert_array_equal(after[0][bound], after[1][bound])
        assert bool(int(after[0]["status"][0]) & 64) == (k < recovery)
        follow = [one["memory_next"] for one in after]


def test_an_observer_pickles(observer):
    again = pickle.loads(pickle.dumps(observer))
    given = held(observer)
    memory = observer.memory0(guess(observer), y0=given[1])
    np.testing.assert_array_equal(again.memory0(guess(observer), y0=given[1]), memory)
    for _ in range(3):
        expected, told = outputs(observer, memory, given), outputs(again, memory, given)
        for name in STEP_OUTPUTS:
            np.testing.assert_array_equal(told[name], expected[name])
        memory = expected["memory_next"]
    assert again.record == observer.record
    assert str(again.guarantee) == str(observer.guarantee)
    np.testing.assert_equal(dict(again.gains), dict(observer.gains))


# -- what is built on it -----------------------------------------------------------------------


def test_sets_hold_what_they_carry_the_index_of(name, observer):
    """Mutant: the sets of one sample read as those of the next."""
    run = run_of(name)
    assert run.outside == ()
    good = run.status == 0
    assert good.sum() > 0.5 * good.size
    inside = (run.x_lower <= run.x) & (run.x <= run.x_upper)
    assert inside[good].all()
    error = np.abs(run.xhat[1:] - run.x[1:]).sum()
    assert error < np.abs(run.xhat[1:] - run.x[:-1]).sum()
    assert set(run.coverage.values()) <= {1.0}


def test_a_detector_stands_on_it_or_says_why_not(entry, name, observer):
    if not entry.detects:
        with pytest.raises(DetectorError, match="fault"):
            ob.FaultDetector(observer)
        return
    m = None if core_of(observer).mean_fault else 5
    detector = ob.FaultDetector(observer, window=m)
    run = simulated(entry, detector)
    told = detector.detect(run)
    np.testing.assert_array_equal(told.alarm, run.alarm)
    np.testing.assert_array_equal(run.x_upper, run_of(name).x_upper)
    assert not any(told.false_alarms.values())
    if m is not None:
        valid = (run.mean_status & STATUS["fault_not_valid"]) == 0
        before = np.cumsum(np.vstack([0 * run.f[:1], run.f]), axis=0)
        mean = (before[m:-1] - before[: -m - 1]) / m
        inside = (run.mean_lower[m:] <= mean + 1e-9) & (mean - 1e-9 <= run.mean_upper[m:])
        assert valid.any() and inside[valid[m:]].all()


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_its_c_is_equal_to_the_last_bit(observer, tmp_path):
    # of long steps the tape's C, which compiles in half the time, has the same bits
    writer = "tape" if observer.step.n_instructions() > 5_000 else "casadi"
    project = ob.generate_c(observer, tmp_path / "project", backend=writer, vectors=300)
    assert project.comparison is not None
    assert project.comparison.vectors == 300
