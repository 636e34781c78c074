"""What coordinates of their own claim and store, and what the option takes.

Mutants: a claim that speaks of A - L C in place of D, of outputs in place of all states, a factor
by its sign in an indicator.
"""

import copy

import numpy as np
import pytest
from adaptive_runs import CASES, behind_a_filter, near, of

import obsynth as ob
from obsynth.designs.core.errors import SolverTrouble
from obsynth.designs.set_adaptive.indicators import Indicators, fault_indicators
from obsynth.designs.set_adaptive.method import SetAdaptiveObserver
from obsynth.designs.set_adaptive.record import SetDesign


@pytest.fixture(scope="module")
def lag():
    return of("lag")[0]


# -- claims, files, code -----------------------------------------------------------------


def changed(record, way, value):
    record = copy.deepcopy(dict(record))
    place = record
    for key in way[:-1]:
        place = place[key]
    place[way[-1]] = value(place[way[-1]])
    return record


@pytest.mark.parametrize(
    ("way", "value", "falls"),
    [
        (("coordinates", "D", 0, 1), lambda d: -1e-9, "metzler"),
        (("coordinates", "D", 0, 0), lambda d: 0.5 * d, "decay"),
        (("coordinates", "D", 2, 2), lambda d: 1e6 * d, "transition"),
        (("coordinates", "rate", 1, 1), lambda r: 0.99 * r, "speed"),
        (("coordinates", "rate", 2, 0), lambda r: 0.99 * r, "speed"),
        (("coordinates", "input_rate", 2, 0), lambda r: 0.99 * r, "speed"),
        (("alpha",), lambda a: 1.001 * a, "decay"),
        (("alpha",), lambda a: 0.0, "decay"),
        (("alpha_step",), lambda a: -a, "decay_step"),
        (("p", 2), lambda p: 0.0, "decay"),
        (("w_radius", 1), lambda r: 0.99 * r, "boxes"),
        (("Gamma", 0), lambda g: 0.0, "law"),
        (("alpha_step",), lambda a: 1.001 * a, "decay_step"),
        (("C", 0, 0), lambda c: -c, "signs"),
    ],
)
def test_a_spoilt_record_is_not_proved(lag, certify, way, value, falls):
    failed = {c.name for c in certify(changed(lag.record, way, value), "full") if not c.holds}
    assert falls in failed


def test_coordinates_without_an_inverse_are_no_design(lag, certify):
    with pytest.raises(ob.CertificateError, match="no inverse"):
        certify(changed(lag.record, ("coordinates", "S", 1), lambda row: [0.0, 0.0, 0.0]))
    with pytest.raises(ob.CertificateError, match="S has shape"):
        certify(changed(lag.record, ("coordinates", "S"), lambda rows: rows[:2]))


def test_without_its_coordinates_a_design_is_none_of_its_plant(lag, certify):
    """Mutant: the plant's own coordinates need no states that are not negative."""
    certificate = certify({**lag.record, "coordinates": None}, "full")
    assert {"signs", "derivation"} <= {c.name for c in certificate if not c.holds}


def test_claims_file_and_code(lag, tmp_path):
    names = [claim.name for claim in lag.certificate.check()]
    assert names == [
        "signs", "boxes", "metzler", "decay", "decay_step", "coordinates", "transition", "law",
        "model", "bounds", "speed",
    ]  # fmt: skip
    lag.save(tmp_path / "design.json")
    loaded = ob.load(tmp_path / "design.json")
    assert loaded.certificate.check().valid
    memory = lag.memory0([0.1, 0.0, 0.2], x_range=[(0, 0.2), (-0.1, 0.1), (0, 0.4)])
    for k in range(5):
        pair = [one.step(memory, [0.1], [0.1 + 0.001 * k]) for one in (lag, loaded)]
        assert all(np.array_equal(np.array(a), np.array(b)) for a, b in zip(*pair, strict=True))
        memory = pair[0][0]
    assert isinstance(lag.certificate.design, SetDesign)


def test_generated_c_equals_the_step(tmp_path):
    project = ob.generate_c(of("oscillator")[0], tmp_path / "c", vectors=200)
    if project.comparison is None:
        pytest.skip("no C compiler")
    assert project.comparison.vectors == 200


def test_a_given_gain_has_its_own_modes(lag):
    """L is the plant's: with S or with "auto" the same gain gives the same D."""
    L, S = lag.gains["L"], lag.gains["S"]
    options = dict(CASES["lag"][1])
    for coordinates in ("auto", S):
        again = SetAdaptiveObserver(coordinates=coordinates, **options).analyse(
            behind_a_filter(), {"L": L}
        )
        assert again.certificate.valid
        found = np.sort(np.diag(again.record["coordinates"]["D"]))
        assert found == pytest.approx(np.sort(np.diag(lag.record["coordinates"]["D"])), rel=1e-6)
    with pytest.raises(ob.InfeasibleDesign, match="no real modes"):
        SetAdaptiveObserver(coordinates="auto", **options).analyse(
            behind_a_filter(), {"L": np.zeros((3, 1))}
        )


def test_the_continuous_form_holds_the_state(lag):
    """Plant and observer integrated together; mutant: x of the drive without its ranges."""
    from scipy.integrate import solve_ivp

    f, box = behind_a_filter().function(), near(behind_a_filter(), 0.1)
    x0, fault, w = box[:, 0], [0.3], [0.003, -0.02]
    start = lag.memory0(box.mean(axis=1), x_range=box)

    def rates(t, z):
        x, u = z[:3], [0.5 * np.sin(t)]
        made = np.array(f(x, u, [], fault, w, [], [])[0]).ravel()
        return np.concatenate([made, np.array(lag.ode(z[3:], u, [x[0] + w[0]])).ravel()])

    found = solve_ivp(rates, (0, 3), np.concatenate([x0, start]), rtol=1e-8, atol=1e-10)
    memory, layout = found.y[3:], lag.memory_layout
    z = lag.gains["S"] @ found.y[:3]
    assert (memory[layout["xi_m"]] <= z + 1e-7).all()
    assert (z <= memory[layout["xi_M"]] + 1e-7).all()
    assert (memory[layout["theta_M"]] <= 0.3 + 1e-9).all()
    assert (memory[layout["theta_m"]] >= 0.3 - 1e-9).all()


# -- the option ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"coordinates": "modal"}, "coordinates"),
        ({"coordinates": [[1.0, np.nan], [0.0, 1.0]]}, "coordinates"),
        ({"coordinates": True}, "coordinates"),
        ({"coordinates": "auto", "robust": True}, "coordinates has no effect"),
        ({"coordinates": np.eye(2), "form": "printed"}, "coordinates has no effect"),
    ],
)
def test_options_without_effect_or_meaning_are_refused(options, words):
    with pytest.raises(ob.ObsynthError, match=words) as refusal:
        SetAdaptiveObserver(**options)
    assert refusal.value.option == "coordinates"


def test_coordinates_that_do_not_fit_the_plant_are_refused():
    for S, words in ((np.eye(2), r"shape \(2, 2\).*x, v, a"), (np.ones((3, 3)), "x, v, a apart")):
        with pytest.raises(ob.ObsynthError, match=words):
            SetAdaptiveObserver(coordinates=S).design(behind_a_filter())
    with pytest.raises(ob.ObsynthError, match="leave coordinates out"):
        SetAdaptiveObserver(coordinates="auto").problem(behind_a_filter(), 0.1)
    with pytest.raises(SolverTrouble, match="raise gain_cap"):
        SetAdaptiveObserver(coordinates="auto", gain_cap=0.01).design(behind_a_filter())


def test_what_has_a_design_of_its_own_is_left_in_its_coordinates(tanks, cooperative):
    observer = SetAdaptiveObserver(gain_cap=0.5, Ts=0.05, coordinates="auto").design(tanks)
    assert observer.record["coordinates"] is None
    assert observer.gains["L"].tolist() == cooperative.gains["L"].tolist()


def test_modes_that_no_output_shows_have_to_be_real_and_decay():
    plant = ob.Plant("hidden oscillation")
    a, b, c = plant.states("a b c", range=(-1, 1))
    (f,) = plant.faults("f", range=(-1, 1))
    plant.dynamics([-a + f, -b - 2 * c, 2 * b - c])
    plant.outputs([a])
    with pytest.raises(SolverTrouble, match="real and decay"):
        SetAdaptiveObserver(coordinates="auto").design(plant)
    quiet = ob.Plant("hidden decay")
    a, b = quiet.states("a b", range=(-1, 1))
    (f,) = quiet.faults("f", range=(-1, 1))
    quiet.dynamics([-a + f, a - 2 * b])
    quiet.outputs([a])
    observer = SetAdaptiveObserver(coordinates="auto", gain_cap=10.0).design(quiet)
    assert min(np.abs(np.diag(observer.record["coordinates"]["D"]) + 2.0)) < 1e-9


def test_indicators_see_what_the_bounds_of_z_show(lag):
    """Mutant: C S^-1 without its signs."""
    box = near(behind_a_filter(), 0.1)
    memory = lag.memory0([0.0, 0.0, 0.0], x_range=box)
    z = lag.gains["S"] @ np.array(np.meshgrid(*box)).reshape(3, -1)
    corners = np.array(np.meshgrid(*zip(z.min(axis=1), z.max(axis=1), strict=True)))
    shown = np.linalg.inv(lag.gains["S"])[0] @ corners.reshape(3, -1)
    for y, out in ((shown.max() - 0.01, False), (shown.min() + 0.01, False)):
        assert fault_indicators(lag, memory, [y]).s.any() == out
    for y in (shown.max() + 0.01, shown.min() - 0.01):
        found = fault_indicators(lag, memory, [y])
        assert found.s.all()
        assert found.z.all()


def test_one_output_or_fault_is_enough_for_an_alarm():
    """Mutant: all of them asked."""
    rows = np.array([[False, False], [True, False], [False, True], [True, True]])
    found = Indicators(rows, rows[::-1], rows)
    assert found.S.tolist() == found.Z.tolist() == [False, True, True, True]
    assert found.D.tolist() == [True, True, True, False]
