"""What is stored is what is proved: certificates from files, mutants of records, C code."""

import json

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.filter_bank.method import FilterBank
from obsynth.designs.set_adaptive.indicators import fault_indicators, monitors
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver

REGION = [(0.2, 0.9), (0.0, 0.4), (0.1, 0.6)]


@pytest.fixture(scope="module")
def bank(tanks):
    return FilterBank(Ts=0.01, region=REGION).design(tanks)


@pytest.fixture(params=["adaptive", "bank"])
def either(request, cooperative, bank):
    return cooperative if request.param == "adaptive" else bank


def test_claims(cooperative, bank):
    names = [claim.name for claim in cooperative.certificate.check()]
    assert names == [
        "signs", "boxes", "metzler", "decay", "decay_step", "transition", "law",
        "model", "bounds", "speed",
    ]  # fmt: skip
    assert [claim.name for claim in bank.certificate.check()] == [
        "falling", "filters", "monotone", "structure",
    ]  # fmt: skip
    # the exact margins are decided by rational arithmetic
    assert cooperative.certificate["decay"].margin > 0.0
    assert len(cooperative.certificate.check("lmi").claims) == 7


def test_a_loaded_observer_is_the_same_function(either, tmp_path):
    path = tmp_path / "observer.json"
    either.save(path)
    loaded = ob.load(path)
    memory = either.memory0([0.5, 0.1, 0.3])
    rng = np.random.default_rng(6)
    for _ in range(20):
        u, y = rng.uniform(0, 1e-4, 2), np.array([0.5, 0.1]) + rng.uniform(-4e-3, 4e-3, 2)
        expected, found = either.step(memory, u, y), loaded.step(memory, u, y)
        for a, b in zip(expected, found, strict=True):
            assert np.array(a).tolist() == np.array(b).tolist()
        assert np.array(either.ode(memory, u, y)).tolist() == (
            np.array(loaded.ode(memory, u, y)).tolist()
        )
        memory = expected[0]


def spoiled(record, name):
    record = json.loads(json.dumps(record))
    if name == "gain":
        record["L"][2][0] = 0.0153
    elif name == "gain without effect":
        record["L"] = (0.01 * np.eye(3, 2)).tolist()
    elif name == "decay":
        record["alpha"] *= 1.0 + 1e-9
    elif name == "decay of the step":
        record["alpha_step"] *= 1.001
    elif name == "vector":
        record["p"][0] *= -1.0
    elif name == "upper bound":
        record["A_upper"][1][2] *= 0.999
    elif name == "lower bound":
        record["A_lower_box"][0][2] *= 1.01
    elif name == "formula":
        text = record["bounds"]["upper"]["A"][0][2]
        record["bounds"]["upper"]["A"][0][2] = f"(999/1000)*({text})"
    elif name == "swapped":
        bounds = record["bounds"]
        bounds["lower"], bounds["upper"] = bounds["upper"], bounds["lower"]
    elif name == "noise":
        record["w_radius"][0] *= 0.999
    elif name == "speed":
        record["rate"][0][1] *= 0.99
    elif name == "input":
        record["G"][0][0] *= 1.0 + 1e-12
    elif name == "step":
        record["Ts"] = 300.0
    elif name == "Gamma":
        record["Gamma"][1] = -0.01
    return record


@pytest.mark.parametrize(
    ("name", "claim"),
    [
        ("gain", "metzler"),
        ("gain without effect", "decay"),
        ("decay", "decay"),
        ("decay of the step", "decay_step"),
        ("vector", "decay"),
        ("upper bound", "bounds"),
        ("lower bound", "bounds"),
        ("formula", "bounds"),
        ("swapped", "bounds"),
        ("noise", "boxes"),
        ("speed", "speed"),
        ("input", "model"),
        ("step", "transition"),
        ("Gamma", "law"),
    ],
)
def test_a_spoiled_record_is_not_proved(cooperative, certify, name, claim):
    certificate = certify(spoiled(cooperative.record, name), "full")
    failed = [c.name for c in certificate if not c.holds]
    assert claim in failed


@pytest.mark.parametrize("name", ["sign", "gain", "noise", "region", "rate"])
def test_a_spoiled_bank_is_not_proved(bank, certify, name):
    record = json.loads(json.dumps(bank.record))
    if name == "sign":
        record["signs"]["x"][0][2] = -1
    elif name == "gain":
        record["gain"][0] *= 1.0001
    elif name == "noise":
        record["noise"][1][1] *= 0.999
    elif name == "region":
        # an equation of another plant: the last level feeds itself
        record["plant"]["dynamics"][2] += " + x3"
    else:
        record["filters"][0] = -0.1
    assert not certify(record, "full").valid


@pytest.mark.parametrize("key", ["L", "bounds", "Ts", "fault_outputs"])
def test_an_incomplete_record_is_refused(cooperative, certify, key):
    record = {name: value for name, value in cooperative.record.items() if name != key}
    with pytest.raises(ob.CertificateError, match="cannot be read"):
        certify(record)


def test_other_damage_is_refused(cooperative, bank, certify):
    for change in (
        {"L": [[1.0]]},
        {"fault_outputs": [0, 7]},
        {"fault_outputs": [0, -1]},
        {"law": "none"},
    ):
        with pytest.raises(ob.CertificateError):
            certify({**cooperative.record, **change})
    with pytest.raises(ob.CertificateError, match="scale has shape"):
        certify({**bank.record, "scale": [1.0]})
    with pytest.raises(ob.CertificateError, match="cannot be read"):
        certify({**bank.record, "outputs": [0, 9]})


def test_guarantees_name_what_they_rest_on(cooperative, bank, printed):
    text = str(cooperative.guarantee)
    for words in ("constant", "no false alarm", "x3 in [0.24, 0.36]", "held between", "v1 in"):
        assert words in text
    assert "exp(-0.1 age)" in str(bank.guarantee)
    assert "neither fault bounds nor state bounds" in str(printed.guarantee)
    assert "are zero" in str(printed.guarantee)


# -- C -------------------------------------------------------------------------------


LONG = pytest.mark.long
"""The contract of all methods compares fewer vectors of the same two every time."""


@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=LONG) for kind in ("adaptive", "bank", "printed")]
)
def test_generated_c_equals_the_step(cooperative, bank, printed, tmp_path, kind):
    observer = {"adaptive": cooperative, "bank": bank, "printed": printed}[kind]
    project = ob.generate_c(observer, tmp_path / "c", vectors=1000)
    if project.comparison is None:
        pytest.skip("no C compiler")
    assert project.comparison.vectors == 1000


# -- refusals ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"law": "averaged"}, "law is 'averaged'"),
        ({"form": "repaired"}, "form is"),
        ({"Gamma": 0.0}, "Gamma"),
        ({"Gamma": (0.1, -1.0)}, "Gamma"),
        ({"Gamma": np.array([0.1, np.nan])}, "Gamma"),
        ({"Gamma": "fast"}, "Gamma"),
        ({"filters": np.array([[0.1, 0.2]])}, "filters"),
        ({"gain_cap": np.inf}, "gain_cap"),
        ({"Ts": -0.1}, "Ts"),
        ({"window": 0.0}, "window"),
        ({"filters": ()}, "filters"),
        ({"filters": (0.1, -0.2)}, "filters"),
        ({"robust": True, "form": "printed"}, "bank"),
    ],
)
def test_options_out_of_range(options, words):
    with pytest.raises(ob.ObsynthError, match=words):
        SetAdaptiveObserver(**options)


def plant_with(change=None, **changes):
    """Two levels, the first measured; changed in one respect."""
    plant = ob.Plant("two levels")
    low = changes.get("low", 0.0)
    a, b = plant.states("a b", range=[(low, 2.0), (0.0, 2.0)])
    (u,) = plant.inputs("u", range=(0, 1))
    fault_range = None if change == "fault range" else (-0.1, 0.1)
    if change != "no fault":
        (f,) = plant.faults("f", **({} if fault_range is None else {"range": fault_range}))
    else:
        f = 0
    (v,) = plant.disturbances("v", **({} if change == "noise" else {"bound": 0.01}))
    d = plant.unknown_inputs("d")[0] if change == "unknown input" else 0
    factor = a if change == "varying" else 1
    coupling = 3 if change == "unstable" else 1
    plant.dynamics(
        [-2 * a + coupling * b + u + factor * f + d, a - (b if change != "unstable" else -b)]
    )
    outputs = {"sum": a + b + v, "falls": -a + v, "fault": a + f + v}
    plant.outputs([outputs.get(change, a + v)])
    return plant


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("unknown input", "unknown input d"),
        ("no fault", "declares no fault"),
        ("fault range", "fault f has no range"),
        ("noise", "disturbance v has no bound"),
        ("varying", r"B_f\[1,1\].*varies with a"),
        ("sum", "y1 does not show one state"),
        ("falls", "y1 falls with a"),
        ("fault", "f enters an output"),
    ],
)
def test_plants_outside_of_the_class_are_refused_by_name(change, words):
    with pytest.raises(ob.StructureError, match=words):
        SetAdaptiveObserver().design(plant_with(change))


def test_more_refusals(tanks):
    with pytest.raises(ob.StructureError, match=r"state a may be negative \(-1\)"):
        SetAdaptiveObserver(form="printed").design(plant_with(low=-1.0))
    with pytest.raises(ob.InfeasibleDesign, match="unmeasured states \\(b\\)"):
        SetAdaptiveObserver().design(plant_with("unstable"))
    with pytest.raises(ob.ObsynthError, match="Gamma has 3 numbers"):
        SetAdaptiveObserver(Gamma=(0.1, 0.1, 0.1)).design(tanks)
    with pytest.raises(ob.ObsynthError, match="needs L; it takes L"):
        SetAdaptiveObserver().analyse(tanks, {"K": np.eye(3, 2)})
    with pytest.raises(ob.ObsynthError, match="no gains"):
        SetAdaptiveObserver(robust=True).analyse(tanks, {"L": np.eye(3, 2)})
    with pytest.raises(ob.ObsynthError, match="too long"):
        SetAdaptiveObserver(Ts=100.0).design(tanks)
    discrete = ob.Plant("discrete")
    (x,) = discrete.states("x", range=(0, 1))
    discrete.dynamics([x / 2], Ts=1)
    discrete.outputs([x])
    with pytest.raises(ob.StructureError, match="discrete plant"):
        SetAdaptiveObserver().design(discrete)


def test_a_fault_that_no_output_shows():
    plant = ob.Plant("hidden fault")
    a, b = plant.states("a b", range=(0, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([-a, a - b + f])
    plant.outputs([a])
    with pytest.raises(ob.StructureError, match="show the fault f"):
        SetAdaptiveObserver().design(plant)


def test_a_discretisation_of_the_package_is_seen_through(tanks):
    observer = SetAdaptiveObserver(gain_cap=0.5).design(tanks.discretise("euler", 0.1))
    assert observer.model.continuous.Ts is None
    assert observer.model.Ts != 0.1


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"guess": [0.5, 0.1]}, "guess has to be 3"),
        ({"x_range": [(0.5, 0.4)] * 3}, "x_range"),
        ({"x_range": [(-0.1, 0.4)] * 3}, "below zero"),
        ({"f_range": [(0, 1)]}, "f_range has to be 2"),
    ],
)
def test_a_start_that_does_not_fit(cooperative, given, words):
    with pytest.raises(ob.ObsynthError, match=words):
        cooperative.memory0(**{"guess": [0.5, 0.1, 0.3], **given})


def test_the_bank_has_no_indicators_of_the_paper(bank):
    memory = bank.memory0([0.5, 0.1, 0.3])
    with pytest.raises(ob.ObsynthError, match="no indicators"):
        fault_indicators(bank, memory, [0.5, 0.1])
    with pytest.raises(ob.ObsynthError, match="no indicators"):
        monitors(bank, memory)
    with pytest.raises(ob.ObsynthError, match="outside of the region"):
        bank.memory0([0.5, 0.1, 0.3], x_range=[(0.91, 0.92), (0.1, 0.2), (0.2, 0.3)])


def test_a_split_is_its_plant(tanks, cooperative):
    method = SetAdaptiveObserver(gain_cap=0.5, Ts=0.05)
    again = method.design(ob.split(tanks))
    assert again.gains["L"].tolist() == cooperative.gains["L"].tolist()


def bilinear():
    plant = ob.Plant("bilinear")
    (a,) = plant.states("a", range=(0.2, 2))
    (u,) = plant.inputs("u", range=(0.5, 2), nominal=1)
    (f,) = plant.faults("f", range=(-0.2, 0.2))
    plant.dynamics([1 - u * a + f])
    plant.outputs([a])
    return plant


@pytest.mark.parametrize("method", [SetAdaptiveObserver, FilterBank])
def test_an_input_beyond_its_range_where_that_matters(method, cooperative):
    observer = method(Ts=0.05).design(bilinear())
    memory = observer.memory0([1.0])
    assert int(observer.step(memory, [1.5], [1.0])[7]) == 0
    beyond = observer.step(memory, [2.5], [1.0])
    assert int(beyond[7]) == 4  # of what follows: the sets of this instant hold
    assert int(observer.step(beyond[0], [1.0], [1.0])[7]) == 0
    # the tanks are affine in their flows, so that any flow is covered
    tank_memory = cooperative.memory0([0.5, 0.1, 0.3])
    assert int(cooperative.step(tank_memory, [0.1, 0.0], [0.5, 0.1])[7]) == 0


def test_a_scheduled_plant_reads_theta():
    plant = ob.Plant("valve")
    a, b = plant.states("a b", range=(0, 2))
    (u,) = plant.inputs("u", range=(0, 2))
    (opening,) = plant.scheduling("opening", range=(0.5, 1.5))
    plant.actuator_faults("f", of=u, range=(-0.2, 0.2))
    plant.dynamics([-opening * a + u, opening * a - 2 * b])
    plant.outputs([a])
    observer = SetAdaptiveObserver(gain_cap=0.5, Ts=0.05).design(plant)
    assert observer.step.name_in() == ["memory", "u", "y", "theta"]
    assert observer.ode.name_in() == ["memory", "u", "y", "theta"]
    F = observer.model.function()
    x, memory = np.array([1.0, 0.5]), observer.memory0([1.0, 0.5])
    for k in range(100):
        rho = [1.0 + 0.4 * np.sin(k / 7)]
        memory, _, _, low, high, f_low, f_high, status = observer.step(memory, [1.0], x[:1], rho)
        assert int(status) == 0
        assert (np.array(low).ravel() <= x + 1e-9).all()
        assert (x <= np.array(high).ravel() + 1e-9).all()
        assert float(f_low) <= 0.1 <= float(f_high)
        assert int(observer.step(memory, [1.0], x[:1], [1.6])[7]) == 4
        blind = observer.step(memory, [1.0], x[:1], [np.nan])
        assert int(blind[7]) == 2
        assert np.isfinite(np.array(blind[0])).all()
        x = np.array(F(x, [1.0], [], [0.1], [], [], rho)[0]).ravel()
