"""Run-time monitors, storage and proofs of the interval observer, and its C code."""

import copy
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matrices import lpv

import obsynth as ob
from obsynth.codegen import find_compiler
from obsynth.derive import DerivationError
from obsynth.designs import STATUS
from obsynth.designs.interval.claims import claims
from obsynth.designs.interval.decoupling import shaped
from obsynth.designs.interval.record import IntervalDesign

BOX = np.tile([0.5, 1.5], (3, 1))


def call(observer, memory, u, y):
    return [np.array(o).ravel() for o in observer.step(memory, u, y)]


# -- run time ---------------------------------------------------------------------------------


def test_memory_of_zeros_is_not_initialised(designs):
    observer = designs["d1"]
    memory = np.zeros(observer.step.numel_in(0))
    out = call(observer, memory, [0.0], [1.0, 1.0])
    assert np.array_equal(out[0], memory)
    assert int(out[7][0]) & STATUS["not_initialised"]
    assert np.all(np.isinf(out[3])) and np.all(np.isinf(out[6]))


def test_the_fault_is_known_one_sample_later(designs):
    observer = designs["d1"]
    assert observer.fault_delay == 1
    memory = observer.memory0(np.ones(3), x_range=BOX)
    first = call(observer, memory, [3.5], [1.0, 1.0])
    assert int(first[7][0]) == STATUS["fault_not_valid"]
    assert (first[5], first[6]) == (-1.0, 1.0)  # no more than is declared
    second = call(observer, first[0], [0.0], [3.1, -1.15])
    assert int(second[7][0]) == 0
    assert second[5] <= 1.0 <= second[6]


@pytest.mark.parametrize("cuts", [None, ()])
@pytest.mark.parametrize("missing", [np.nan, np.inf, -np.inf])
def test_a_missing_sample(missing, cuts, example):
    """Nothing comes of the reading, or input, that is missing, and sets go on without it."""
    observer = ob.IntervalObserver(cuts=cuts, horizon=100).design(example)
    run = ob.simulate(example, observer, ob.scenarios.interval_example(seed=1))
    memory = observer.memory0(np.ones(3), x_range=BOX)
    for k in range(60):
        y, u = run.y[k].copy(), run.u[k].copy()
        if k == 20:
            y[1] = missing
        if k == 40:
            u[0] = missing
        out = call(observer, memory, u, y)
        memory, status = out[0], int(out[7][0])
        assert np.isfinite(memory).all()
        assert bool(status & STATUS["measurement_left_out"]) == (k == 20)
        assert bool(status & STATUS["non_finite_input"]) == (k == 40)
        assert not status & STATUS["void"]
        assert np.all(out[3] <= run.x[k]) and np.all(run.x[k] <= out[4])
        if k == 20:
            assert np.isfinite(out[1]).all()
            assert np.abs(out[1] - run.x[k]).max() < 0.5 or cuts == ()
        # the share of the fault of an instant without all readings is not known
        own = (0, 20, 21, 41) if cuts == () else (0, 41)
        assert bool(status & STATUS["fault_not_valid"]) == (k in own)
        if k:
            assert out[5] <= run.f[k - 1] <= out[6]


def test_a_missing_sample_without_a_box():
    """A state without a declared range is unbounded until a reading bounds it."""
    p = ob.Plant("no box")
    x = p.states("x1:3")
    (w,) = p.disturbances("w", bound=0.1)
    p.dynamics([x[0] / 2 + x[1] / 4, x[1] / 2 + w], Ts=1)
    p.outputs([x[0]])
    observer = ob.IntervalObserver().design(p)
    memory = observer.memory0([0, 0], x_range=[[-1, 1]] * 2)
    assert int(call(observer, memory, [], [0.1])[7][0]) == 0
    gap = call(observer, call(observer, memory, [], [0.1])[0], [], [np.nan])
    assert int(gap[7][0]) == STATUS["measurement_left_out"]
    assert gap[3] == pytest.approx([0.05 - 0.25, -0.6]) and gap[4] == pytest.approx([0.3, 0.6])
    void = call(observer, gap[0], [], [5.0])
    assert int(void[7][0]) == STATUS["void"] and np.isinf(void[3]).all() and np.isinf(void[4]).all()
    first = call(observer, void[0], [], [0.1])
    assert int(first[7][0]) == STATUS["recovering"]
    assert first[3][0] == pytest.approx(0.1) and np.isinf([first[3][1], first[4][1]]).all()


def test_an_impossible_measurement_is_reported(designs):
    observer = designs["d1"]
    memory = observer.memory0(np.ones(3), x_range=BOX)
    out = call(observer, memory, [3.5], [1.0, 9.0])
    assert int(out[7][0]) & STATUS["void"]
    assert np.array_equal(np.column_stack([out[3], out[4]]), observer.model.box("x"))
    fine = call(observer, memory, [3.5], [1.0, 1.4])
    assert not int(fine[7][0]) & STATUS["void"]


def test_the_box_is_watched_where_the_matrices_rest_on_it():
    p = ob.Plant("pendulum-like")
    x = p.states("x1:3", range=[(-1, 1), (-2, 2)])
    (f,) = p.faults("f")
    w = p.disturbances("w1:3", bound=0.001)
    p.dynamics([x[0] / 2 + f, x[1] / 4 + x[0] * x[1] / 8 + w[0]], Ts=1)
    p.outputs([x[0] + w[1]])
    observer = ob.IntervalObserver().design(p)
    assert any("x1 in [-1, 1]" in a and "bit 8" in a for a in observer.guarantee.assumptions)
    memory = observer.memory0([0, 0], x_range=[[-0.5, 0.5]] * 2)
    assert int(call(observer, memory, [], [0.2])[7][0]) == STATUS["fault_not_valid"]
    assert int(call(observer, memory, [], [1.2])[7][0]) & STATUS["void"]


def test_no_bit_for_a_box_on_which_nothing_rests(designs):
    memory = designs["d1"].memory0(np.full(3, 50.0), x_range=[[49, 51]] * 3)
    out = call(designs["d1"], memory, [0.0], [50.0, 50.0])
    assert int(out[7][0]) == STATUS["fault_not_valid"]
    assert not any("x1 in [" in text for text in designs["d1"].guarantee.assumptions)


def test_memory0_says_what_is_wrong(designs):
    with pytest.raises(ob.ObsynthError, match="guess has to be 3"):
        designs["d1"].memory0([1.0])
    with pytest.raises(ob.ObsynthError, match="lower <= upper"):
        designs["d1"].memory0(np.ones(3), x_range=[[1, 0]] * 3)


def test_no_numbers_are_no_zeros():
    """Mutant: an empty gain taken for one of zeros."""
    assert shaped([], (0, 3), "L").shape == (0, 3)
    with pytest.raises(ob.ObsynthError, match=r"L has to be finite with shape \(2, 1\)"):
        shaped([], (2, 1), "L")


# -- proofs and storage -----------------------------------------------------------------------


@pytest.mark.parametrize("case", ["b2", "c2", "d0", "d1"])
def test_every_claim_is_proved_from_the_record(case, designs):
    certificate = designs[case].certificate.check()
    names = {claim.name for claim in certificate}
    assert {"decoupling", "stability", "rounding", "model", "vertices"} <= names
    assert ("nonnegative" in names) == (case in ("b2", "c2"))


def test_a_transformation_with_a_negative_entry_is_no_proof(designs):
    """One coordinate turned around turns signs of R; mutant: the claim holds whatever R is."""
    design = IntervalDesign.from_record(designs["c2"].certificate.record)
    P = design.P.copy()
    P[0] *= -1.0
    turned = replace(design, P=P)
    assert turned.least_entry < 0.0 <= design.least_entry + 1e-9
    claim = next(claim for claim in claims(turned) if claim.name == "nonnegative")
    assert not claim.holds


def test_a_stored_design_is_read_as_it_was(two_faults, tmp_path):
    observer = ob.IntervalObserver().design(two_faults)
    path = tmp_path / "two.json"
    observer.save(path)
    again = ob.load(path)
    assert again.half_widths.tolist() == observer.half_widths.tolist()
    assert again.step.serialize() == observer.step.serialize()
    assert again.certificate.check().valid


@pytest.mark.long
def test_a_stored_design_is_proved_in_another_process(designs, tmp_path):
    path = tmp_path / "d1.json"
    designs["d1"].save(path)
    code = (
        "import sys, obsynth as ob\n"
        "certificate = ob.load(sys.argv[1]).certificate.check()\n"
        "print(certificate.valid, len(certificate.claims))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["True", "5"]


def narrower_width(record):
    record["width"][0] *= 0.99


def narrower_error(record):
    record["error"][1] *= 0.9


def other_gain(record):
    record["L"][0][0] = 3.0


def narrower_range(record):
    record["model"]["family"]["ranges"][0][1] = 0.9


def smaller_entry(record):
    record["model"]["family"]["constant"][1][0] = -0.89


def other_fault(record):
    record["model"]["F"][0][0] = "-2"


def other_output(record):
    record["model"]["C"][1][2] = "2"


TAMPERED = [
    narrower_width,
    narrower_error,
    other_gain,
    narrower_range,
    smaller_entry,
    other_fault,
    other_output,
]


@pytest.mark.parametrize("change", TAMPERED)
def test_a_record_that_was_changed_is_not_proved(change, designs):
    record = copy.deepcopy(dict(designs["d1"].record))
    change(record)
    contract = ob.IntervalObserver.CONTRACT
    assert not contract.certify(contract.record.from_record(record)).valid
    assert contract.certify(contract.record.from_record(designs["d1"].record)).valid


def wrong_shape(record):
    record["P"] = [[1.0]]


def missing(record):
    del record["transformation"]["H"]


def not_finite(record):
    record["model"]["family"]["constant"][0][0] = float("nan")


def unknown_bound(record):
    record["bound"] = "box"


def singular(record):
    record["P"] = [[1.0, 1.0], [1.0, 1.0]]


def no_fault_in_R0(record):
    record["transformation"]["R0"] = [[0.0]]


def unbounded_noise(record):
    record["model"]["plant"]["signals"][-1].update(lower=None, upper=None)


@pytest.mark.parametrize(
    "change",
    [
        wrong_shape,
        missing,
        not_finite,
        unknown_bound,
        singular,
        no_fault_in_R0,
        unbounded_noise,
    ],
)
def test_a_record_that_cannot_be_read(change, designs, tmp_path):
    record = json.loads(json.dumps(designs["d1"].record))
    change(record)
    path = tmp_path / "broken.json"
    path.write_text(json.dumps(record))
    with pytest.raises(ob.CertificateError, match="stored design"):
        ob.load(path)


@pytest.mark.long
def test_analyse_proves_what_given_gains_guarantee(example, designs):
    method = ob.IntervalObserver(cuts=(), horizon=10**9)
    observer = method.analyse(example, {"L": [[0.4], [-1.0]]})
    assert observer.half_widths == pytest.approx(designs["d1"].half_widths, rel=1e-12)
    wider = method.analyse(example, {"L": [[0.6], [-1.0]]})
    assert wider.half_widths[1] > observer.half_widths[1] * 1.01
    column = method.analyse(example, {"L": [0.4, -1.0]})
    assert np.array_equal(column.half_widths, observer.half_widths)
    with pytest.raises(ob.ObsynthError, match="needs L"):
        ob.IntervalObserver().analyse(example, {"P": np.eye(2)})


def test_given_gains_where_nothing_is_left_to_estimate():
    plant = lpv([[0.5]], [[1]], [[1]])
    observer = ob.IntervalObserver().design(plant)
    given = ob.IntervalObserver().analyse(plant, {"L": np.zeros((0, 0))})
    assert np.array_equal(given.half_widths, observer.half_widths)


def test_equal_options_are_equal_and_can_be_hashed():
    one = ob.IntervalObserver(gains=(np.eye(2), [1, 2]), H=np.eye(3), prefer="x1")
    two = ob.IntervalObserver(gains=([[1, 0], [0, 1]], [[1], [2]]), H=np.eye(3), prefer=["x1"])
    assert one == two and hash(one) == hash(two)
    assert one != ob.IntervalObserver(gains=(np.eye(2), [1, 3]), H=np.eye(3), prefer="x1")


def test_equations_outside_the_class_are_no_certificate(designs):
    record = copy.deepcopy(dict(designs["d1"].record))
    record["model"]["plant"]["outputs"][0]["expression"] += " + u"
    contract = ob.IntervalObserver.CONTRACT
    certificate = contract.certify(contract.record.from_record(record))
    assert not certificate["derivation"].holds
    assert "y = C x + W2 w" in certificate["derivation"].proof


@pytest.mark.long
def test_searched_gains(example, designs, two_faults):
    searched = ob.IntervalObserver(gains="search").design(example)
    # nothing is better than P = I on the example
    limits = [o.performance["core_half_widths"] for o in (searched, designs["d1"])]
    assert limits[0] == pytest.approx(limits[1], rel=1e-3)
    programme = ob.IntervalObserver().design(two_faults)
    searched = ob.IntervalObserver(gains="search").design(two_faults)
    assert searched.certificate.valid
    assert searched.half_widths.sum() < 0.95 * programme.half_widths.sum()


def test_sylvester_gains(example):
    observer = ob.IntervalObserver(gains="sylvester").design(example)
    assert observer.certificate.valid
    off = observer.gains["R"] - np.diag(np.diag(observer.gains["R"]))
    assert np.abs(off).max() < 1e-9
    with pytest.raises(ob.InfeasibleDesign, match="eigenvalue in common"):
        ob.IntervalObserver(gains="sylvester", R=np.diag([0.0, 0.2])).design(
            lpv([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1], [0], [0]], [[1, 0, 0], [0, 0, 1]])
        )


def test_the_guarantee_names_its_assumptions(designs, two_faults):
    """What is cut with the range of a fault does not hold for all of its values."""
    text = str(designs["d1"].guarantee)
    for words in ("rho1 in [-1, 1]", "memory0", "f in [-1, 1]", "IEEE double", "bit 8"):
        assert words in text
    assert "for all values" not in text
    assert "x1, x2, x3 inside of declared ranges at the instants" in text
    assert "for all values of f, d" in str(ob.IntervalObserver().design(two_faults).guarantee)
    assert "interval_observer" in str(designs["d1"])


def test_a_rate_is_an_assumption_where_it_cuts():
    p = ob.Plant("slow")
    (x,) = p.states("x", range=(-1, 1))
    (f,) = p.faults("f", rate=0.25)
    (w,) = p.disturbances("w", bound=0.01)
    p.dynamics([x / 2 + f], Ts=1)
    p.outputs([x + w])
    said = "from call to call f by 0.25 at most"
    assert said in str(ob.IntervalObserver().design(p).guarantee)
    assert said not in str(ob.IntervalObserver(cuts=()).design(p).guarantee)


@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
@pytest.mark.parametrize(
    "options",
    [
        pytest.param(options, marks=pytest.mark.long)
        for options in ({}, {"bound": "paper", "precision": "single"})
    ],
)
def test_the_c_code_is_the_step(options, example, tmp_path):
    observer = ob.IntervalObserver(gains=(np.diag([1.0, -1]), [0.4, -1]), **options).design(example)
    project = ob.generate_c(observer, tmp_path / "c")
    assert project.comparison is not None
    assert project.comparison.vectors >= 1000
    assert "equal to the last bit" in str(project)


def test_a_form_that_is_only_true_to_many_digits_is_not_taken(monkeypatch):
    """Mutant: without the proof of the form the claims would still say that it is the plant."""
    import obsynth.designs.interval.model as module

    observer = ob.IntervalObserver().design(ob.plants.interval_example())
    derive = module.quasi_lpv

    def doubtful(plant, **options):
        form = derive(plant, **options)
        return replace(form, proof=replace(form.proof, methods=("", *form.proof.methods[1:])))

    monkeypatch.setattr(module, "quasi_lpv", doubtful)
    with pytest.raises(DerivationError, match="not proved to be the plant"):
        ob.IntervalObserver().design(ob.plants.interval_example())
    with pytest.raises(ob.CertificateError) as refusal:
        observer.certificate.check()
    assert {claim.name for claim in refusal.value.failed} == {"derivation"}


def test_a_search_where_the_faults_take_every_state_is_the_design_without_one():
    """Fault and unknown load enter both equations, so that no gain is left to search. Mutant: the
    starts sorted by what they predict, of an empty P."""
    plant = ob.plants.dc_motor().discretise("euler", Ts=0.01)
    searched, plain = (ob.IntervalObserver(gains=g).design(plant) for g in ("search", "lp"))
    assert searched.gains["P"].shape == (0, 0)
    np.testing.assert_array_equal(searched.half_widths, plain.half_widths)
