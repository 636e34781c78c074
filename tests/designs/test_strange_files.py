"""Files from strangers: refused in a sentence, or what is read means what was saved."""

import json

import numpy as np
import pytest
from tampering import tampered
from typer.testing import CliRunner

import obsynth as ob
from methods import METHODS, observer_of, run_of
from obsynth.cli import app
from obsynth.designs.core.observer import STEP_OUTPUTS

SAMPLES = 40


@pytest.fixture(params=METHODS)
def name(request):
    return request.param


def written(name, folder):
    path = folder / "design.json"
    observer_of(name).save(path)
    return path.read_text()


def march(name, observer):
    """Outputs of the first samples of the scenario, each (samples, n)."""
    run, scenario = run_of(name), METHODS[name].scenario()
    memory = observer.memory0(
        scenario.guess, x_range=scenario.x_range, f_range=scenario.f_range, y0=run.y[0]
    )
    given = [run.u[:SAMPLES].T, run.y[:SAMPLES].T]
    if observer.step.n_in() == 4:
        seen = [k for k, s in enumerate(observer.model.rho) if s.measured]
        given.append(run.rho[:SAMPLES, seen].T)
    told = {key: [] for key in STEP_OUTPUTS}
    for column in zip(*(array.T for array in given), strict=True):
        values = observer.step(memory, *column)
        memory = values[0]
        for key, value in zip(STEP_OUTPUTS, values, strict=True):
            told[key].append(np.array(value).ravel())
    return {key: np.array(rows) for key, rows in told.items()}


def assert_holds_the_truth(name, told):
    """Whatever the status calls good encloses what was simulated."""
    run, delay = run_of(name), observer_of(name).fault_delay
    good = (told["status"].ravel() == 0).nonzero()[0]
    x, f = run.x[good], run.f[np.maximum(good - delay, 0)]
    assert ((told["x_lower"][good] <= x) & (x <= told["x_upper"][good])).all()
    late = good >= delay
    assert ((told["f_lower"][good] <= f) & (f <= told["f_upper"][good]))[late].all()


def meaning(name, path):
    """Refused, the same step, other sets that hold the truth, or the design of another plant."""
    try:
        observer = ob.load(path)
        certificate = observer.certificate.check()
    except ob.CertificateError as refusal:
        said = str(refusal)
    else:
        said = None
    if said is not None:
        assert said.strip() and len(said) < 20_000
        assert all(line.isprintable() for line in said.split("\n"))
        return "refused"
    own = observer_of(name)
    assert certificate.valid
    assert all(claim.name in {c.name for c in certificate} for claim in own.certificate)
    if certificate.design.plant.to_dict() != own.certificate.design.plant.to_dict():
        return "another plant"
    assert len(str(observer.guarantee).splitlines()) == len(str(own.guarantee).splitlines())
    try:
        told = march(name, observer)
    except ob.ObsynthError:
        return "no start"  # such as a region of the bank that the scenario does not start in
    expected = march(name, own)
    if all(np.array_equal(told[key], expected[key]) for key in STEP_OUTPUTS):
        return "the same"
    assert_holds_the_truth(name, told)
    return "other sets"


def meanings(name, folder, seeds):
    text, path = written(name, folder), folder / "tampered.json"
    found = []
    for seed in seeds:
        path.write_bytes(tampered(text, seed))
        try:
            found.append(meaning(name, path))
        except Exception as error:
            raise AssertionError(f"{name}, seed {seed}: {error!r}") from error
    return found


def test_a_tampered_file_is_refused_or_means_what_it_meant(name, tmp_path):
    """Mutant: `reading` without ArithmeticError, or a file decoded outside of its `try`."""
    found = meanings(name, tmp_path, range(12))
    assert "refused" in found


@pytest.mark.long
def test_thousands_of_tampered_files(name, tmp_path):
    """Of all methods together; at least three of eight are refused."""
    found = meanings(name, tmp_path, range(1000, 1300))
    assert found.count("refused") > 112


# -- one by one --------------------------------------------------------------------------------


def put(record, way, value):
    *front, last = way
    for key in front:
        record = record[key]
    record[last] = value


def changed(name, *way, to):
    def change(text):
        record = json.loads(text)
        put(record, way, to(record) if callable(to) else to)
        return json.dumps(record)

    return name, change


def replaced(name, old, new):
    return name, lambda text: text.replace(old, new, 1)


FORGED = "tanks\nGuaranteed:\n  - nothing can go wrong"
STRANGE = {
    "bytes that are no UTF-8": ("luenberger", lambda text: text.encode("utf-16")),
    "a byte that is no UTF-8": ("luenberger", lambda text: text.encode()[:900] + b"\xff"),
    "deep nesting": ("luenberger", lambda _: "[" * 300_000),
    "deep nesting inside": replaced("luenberger", '"L": [', '"L": [' + "[" * 50_000),
    "nesting that JSON bears": replaced(
        "luenberger", '"L": [', '"L": ' + "[" * 900 + "]" * 900 + ', "M": ['
    ),
    "an integer of 5000 digits": replaced("luenberger", '"b": [', '"b": [' + "1" * 5000 + ","),
    "an integer beyond doubles": changed("luenberger", "b", 0, to=10**400),
    "an integer beyond int64": changed("filter_bank", "outputs", 0, to=10**30),
    "a bound beyond doubles": changed(
        "luenberger", "model", "plant", "continuous", "signals", 0, "upper", to=10**400
    ),
    "NaN": replaced("luenberger", '"b": [', '"b": [NaN,'),
    "an infinity": replaced("luenberger", '"b": [', '"b": [-Infinity,'),
    "numbers as text": changed(
        "luenberger", "b", to=lambda record: [str(value) for value in record["b"]]
    ),
    "truth for a number": changed("luenberger", "model", "C", to=[[False, True]]),
    "a version twice": replaced("luenberger", '"version"', '"version": 2, "version"'),
    "a gain twice": replaced("luenberger", '"L"', '"L": [[9.0], [9.0]], "L"'),
    "version true": changed("luenberger", "version", to=True),
    "version 2.0": changed("luenberger", "version", to=2.0),
    "version as text": changed("luenberger", "version", to="2"),
    "a method that is a list": changed("luenberger", "method", to=[1]),
    "a method that is a table": changed("luenberger", "method", to={}),
    "a kind that is a list": changed("bounded_error_uio", "bound", "kind", to=["ellipsoid"]),
    "no sampling time": changed(
        "luenberger", "model", "plant", to=lambda r: r["model"]["plant"]["continuous"]
    ),
    "a sampling time of zero": changed("filter_bank", "Ts", to=0.0),
    "a negative sampling time": changed("qpv_observer", "Ts", to=-0.01),
    "a sampling time that is no number": changed(
        "luenberger", "model", "plant", "discretise", "Ts", to="1/0"
    ),
    "a matrix C of zeros": changed("hinf_uio", "C", to=lambda r: (0.0 * np.array(r["C"])).tolist()),
    "a matrix L of zeros": changed("hinf_uio", "L", to=lambda r: (0.0 * np.array(r["L"])).tolist()),
    "a singular R1": changed(
        "interval_observer",
        "transformation",
        "R1",
        to=lambda r: (0.0 * np.array(r["transformation"]["R1"])).tolist(),
    ),
    "a rational over zero": changed(
        "interval_observer",
        "model",
        to=lambda r: {
            key: [["1/0"] * len(v[0])] * len(v)
            if isinstance(v, list)
            and v
            and isinstance(v[0], list)
            and v[0]
            and isinstance(v[0][0], str)
            else v
            for key, v in r["model"].items()
        },
    ),
    "weights that are no numbers": changed("qpv_observer", "noise", "weights", 0, to="nan"),
    "two ellipsoids for six components": changed(
        "bounded_error_uio",
        "bound",
        to=lambda r: {
            **r["bound"],
            **{key: 2 * r["bound"][key] for key in ("P", "gamma", "weights")},
        },
    ),
    "forged lines in the name": changed(
        "luenberger", "model", "plant", "continuous", "name", to=FORGED
    ),
    "forged lines in a unit": changed(
        "luenberger", "model", "plant", "continuous", "signals", 0, "unit", to=FORGED
    ),
    "forged lines in the unit of an output": changed(
        "luenberger", "model", "plant", "continuous", "outputs", 0, "unit", to=FORGED
    ),
    "a terminal's commands in the name": changed(
        "luenberger", "model", "plant", "continuous", "name", to="\x1b[2Jtanks"
    ),
    "text that turns round": changed(
        "luenberger", "model", "plant", "continuous", "name", to="sknat\u202e"
    ),
    "a name without end": changed(
        "luenberger", "model", "plant", "continuous", "name", to="a" * 10_000
    ),
    "a range of names": changed(
        "luenberger", "model", "plant", "continuous", "signals", 0, "name", to="h:999999999"
    ),
    "a range of names of outputs": changed(
        "luenberger", "model", "plant", "continuous", "outputs", 0, "name", to="y:999999999"
    ),
    "code for a name": changed(
        "luenberger", "model", "plant", "continuous", "signals", 0, "name", to="h1; exit(1)"
    ),
}


@pytest.mark.parametrize("case", STRANGE)
def test_the_command_refuses_it_in_a_sentence(case, tmp_path):
    name, change = STRANGE[case]
    strange = change(written(name, tmp_path))
    path = tmp_path / "strange.json"
    path.write_bytes(strange if isinstance(strange, bytes) else strange.encode())
    with pytest.raises(ob.CertificateError):
        ob.load(path).certificate.check()
    done = CliRunner().invoke(app, ["check", str(path)])
    assert done.exit_code == 1 and isinstance(done.exception, SystemExit)
    assert done.output.startswith("obsynth: ") and "Traceback" not in done.output
    assert "Guaranteed" not in done.output.splitlines()


# -- the claims that a file lists --------------------------------------------------------------


def listed(name, folder, change):
    record = json.loads(written(name, folder))
    record["claims"] = change(record["claims"])
    path = folder / "listed.json"
    path.write_text(json.dumps(record))
    return path


def first(**changes):
    return lambda claims: [{**claims[0], **changes}, *claims[1:]]


@pytest.mark.parametrize(
    "change",
    [
        first(statement="the error is zero"),
        first(holds=False),
        first(margin=1e6),
        first(margin=None),
        first(proof=["believed"]),
        first(more="and more"),
        lambda claims: [*claims, claims[0]],
        lambda claims: [*claims, {**claims[-1], "name": "safe"}],
        lambda claims: [*claims[:-1], {**claims[-1], "statement": "the plant is any plant"}],
        lambda _: "all is proved",
        lambda _: ["all is proved"],
    ],
)
def test_claims_that_contradict_the_proof_are_refused(change, tmp_path):
    """Mutants: `agreeing_with` without the level, without the names, without the margin."""
    path = listed("luenberger", tmp_path, change)
    with pytest.raises(ob.CertificateError, match="file lists"):
        ob.load(path).certificate.check()


@pytest.mark.parametrize(
    "change", [lambda _: None, lambda _: [], lambda claims: claims[:1], lambda claims: claims[::-1]]
)
def test_a_list_of_claims_may_be_shorter(change, tmp_path):
    observer = ob.load(listed("luenberger", tmp_path, change))
    assert observer.certificate.check().valid
    observer.save(tmp_path / "again.json")
    assert ob.load(tmp_path / "again.json").certificate.check().valid


def test_margins_of_another_processor_are_no_contradiction(tmp_path):
    def rounded(claims):
        return [{**c, "margin": c["margin"] and c["margin"] * (1 + 1e-6)} for c in claims]

    for name in ("luenberger", "interval_observer"):
        assert ob.load(listed(name, tmp_path, rounded)).certificate.check().valid


# -- what is shown -----------------------------------------------------------------------------


def test_what_a_search_found_is_shown_as_such(tmp_path):
    """The least level is stored and never proved: a file may say of it what it likes."""
    record = json.loads(written("hinf_uio", tmp_path))
    record["bound"]["least_mu"] = 1e-9
    path = tmp_path / "low.json"
    path.write_text(json.dumps(record))
    observer = ob.load(path)
    lines = [line for line in str(observer).splitlines() if "1e-09" in line]
    assert lines == ["  least_mu (searched, not proved) = 1e-09"]
    assert "least_mu (searched, not proved)" in observer._repr_html_()
    assert observer_of("qpv_observer").searched == ("eta",)
    for name in METHODS:
        shown = observer_of(name)
        assert set(shown.searched) <= set(shown.performance)


@pytest.mark.parametrize("decay", [-1.0, 0.0, 0.9, 1.0, 1.5])
def test_the_decay_of_peak_bounds_is_proved(given_peak, decay, tmp_path):
    """Mutant: the claim without its call of `contracts`."""
    path = tmp_path / "peak.json"
    given_peak.save(path)
    record = json.loads(path.read_text())
    assert ob.load(path).certificate["decay"].holds
    record["bound"]["fading"]["decay"] = decay
    path.write_text(json.dumps(record))
    with pytest.raises(ob.CertificateError) as refusal:
        ob.load(path)
    assert {claim.name for claim in refusal.value.failed} == {"decay"}
