"""What every method owes: a checked certificate, a file that proves it again, the step."""

import functools
import json
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.core.certificate import Certificate
from obsynth.designs.core.observer import STEP_OUTPUTS


def tank():
    return ob.plants.quadruple_tank().discretise("euler", Ts=1.0)


REGION = ob.Ellipsoid([0.2, 0.2, 0.2, 0.1, 0.1, 0.1], [10, 10, 10, 0, 0, 0])
METHODS = {
    "bounded_error_uio": (ob.BoundedErrorUIO(gamma=0.005), tank),
    "hinf_uio": (ob.HinfUIO(method="polytopic"), ob.plants.hinf_example),
    "interval_observer": (ob.IntervalObserver(), ob.plants.interval_example),
    "qpv_observer": (ob.QPVObserver(region=REGION, eta=0.2), ob.plants.qpv_example),
    "set_adaptive_observer": (ob.SetAdaptiveObserver(), ob.plants.three_tanks),
    "the bank": (ob.SetAdaptiveObserver(robust=True), ob.plants.three_tanks),
}
ALONE = """
import sys
sys.modules["clarabel"] = sys.modules["cvxpy"] = None
import obsynth as ob
for path in sys.argv[1:]:
    certificate = ob.load(path).certificate.check()
    print(path, len(certificate.claims), certificate.valid)
"""


@functools.cache
def observer_of(name):
    method, plant = METHODS[name]
    return method.design(plant())


@pytest.fixture(params=METHODS)
def name(request):
    return request.param


@pytest.fixture
def observer(name):
    return observer_of(name)


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


def test_a_design_has_a_checked_certificate(name, monkeypatch):
    method, plant = METHODS[name]
    required = []
    original = Certificate.require

    def counted(self):
        required.append(self)
        return original(self)

    monkeypatch.setattr(Certificate, "require", counted)
    observer = method.design(plant())
    assert observer.certificate in required
    assert observer.certificate.valid and len(observer.certificate.claims) >= 2
    assert all(claim.statement and claim.proof for claim in observer.certificate)
    assert observer.guarantee.claims and observer.guarantee.assumptions


def test_an_unproved_claim_stops_the_design(name, monkeypatch):
    """Mutant: one claim that does not hold."""
    from obsynth.designs.core.certificate import Claim

    method, plant = METHODS[name]
    original = Certificate.__init__

    def doubtful(self, claims, record):
        original(self, (*claims, Claim("mutant", "is true", False, -1.0, "none")), record)

    monkeypatch.setattr(Certificate, "__init__", doubtful)
    with pytest.raises(ob.CertificateError, match="is true"):
        method.design(plant())


def test_every_file_is_proved_again_in_another_process_without_a_solver(tmp_path):
    paths = []
    for name in METHODS:
        paths.append(str(tmp_path / f"{name.replace(' ', '_')}.json"))
        observer_of(name).save(paths[-1])
        assert all(
            claim["holds"] for claim in json.loads((tmp_path / paths[-1]).read_text())["claims"]
        )
    command = [sys.executable, "-c", ALONE, *paths]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert [(line[0], line[2]) for line in lines] == [(path, "True") for path in paths]
    for line, name in zip(lines, METHODS, strict=True):
        assert int(line[1]) >= len(observer_of(name).certificate.claims)


def test_the_step_keeps_the_contract(observer):
    model, step = observer.model, observer.step
    measured = [s for s in model.rho if s.measured]
    names = ["memory", "u", "y", "theta"]
    assert step.name_in() == names[: step.n_in()] and step.name_out() == list(STEP_OUTPUTS)
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


def test_a_missing_measurement_is_told_and_survived(observer):
    given = held(observer)
    memory = observer.memory0(guess(observer), y0=given[1])
    for _ in range(3):
        memory = outputs(observer, memory, given)["memory"]
    for bad in (np.nan, np.inf):
        y = given[1].copy()
        y[0] = bad
        told = outputs(observer, memory, held(observer, y))
        assert int(told["status"][0]) & 2
        assert np.isfinite(told["xhat"]).all() and np.isfinite(told["fhat"]).all()
        after = outputs(observer, told["memory"], given)
        assert np.isfinite(after["xhat"]).all() and np.isfinite(after["fhat"]).all()
        assert not int(after["status"][0]) & 2
        assert (after["x_lower"] <= after["x_upper"]).all()


def test_an_observer_pickles(observer):
    again = pickle.loads(pickle.dumps(observer))
    given = held(observer)
    memory = observer.memory0(guess(observer), y0=given[1])
    np.testing.assert_array_equal(again.memory0(guess(observer), y0=given[1]), memory)
    for _ in range(3):
        expected, told = outputs(observer, memory, given), outputs(again, memory, given)
        for name in STEP_OUTPUTS:
            np.testing.assert_array_equal(told[name], expected[name])
        memory = expected["memory"]
    assert again.record == observer.record
    assert str(again.guarantee) == str(observer.guarantee)
    np.testing.assert_equal(dict(again.gains), dict(observer.gains))
