"""Stored designs of the bounded-error observer: proved from the file, refused when spoilt."""

import json
import subprocess
import sys

import numpy as np
import pytest

import obsynth as ob
from obsynth.designs.bounded_error.record import UioDesign

# M_min and M_max as printed in section 6 of the paper.
PRINTED_RANGES = {"m11": (0.0026, 0.0065), "m22": (0.0008, 0.0033)}
PRINTED_M13 = (-0.0144, 0.0039)


CONTRACT = ob.BoundedErrorUIO.CONTRACT


def certified(record, level):
    return CONTRACT.certify(UioDesign.from_record(record), level).observer()


def spoilt(observer, change):
    record = json.loads(json.dumps(observer.record))
    change(record)
    return record


def shrink_P_inverse(record):
    record["bound"]["inverse_diagonal"][0] *= 1 - 1e-9


def larger_gamma(record):
    record["bound"]["gamma"][0] *= 2.0


def other_gain(record):
    record["K"][0][0] += 0.02


def flipped_gain(record):
    record["F"][1][1] = -record["F"][1][1]


def more_noise_than_allowed(record):
    record["bound"]["weights"][0][0] *= 1.001


def smaller_noise_box(record):
    record["w_radius"][0] *= 0.99


def slower_faults(record):
    record["rate"][0] *= 0.5


def tilted_P(record):
    record["bound"]["P"][0][0][3] *= 1.5
    record["bound"]["P"][0][3][0] *= 1.5


def other_decoupling(record):
    record["E"][2][2] = -0.999


def smaller_allowance(record):
    record["rounding"] = [value * 0.5 for value in record["rounding"]]


SPOILS = [
    (smaller_allowance, "rounding"),
    (shrink_P_inverse, "half_widths"),
    (larger_gamma, "lmi"),
    (other_gain, "lmi"),
    (flipped_gain, "lmi"),
    (more_noise_than_allowed, "weights"),
    (smaller_noise_box, "boxes"),
    (slower_faults, "boxes"),
    (tilted_P, "lmi"),
    (other_decoupling, "decoupling"),
]


@pytest.mark.parametrize(("change", "claim"), SPOILS, ids=[c.__name__ for c, _ in SPOILS])
def test_a_spoilt_design_is_refused(base, change, claim):
    with pytest.raises(ob.CertificateError) as refusal:
        certified(spoilt(base, change), "lmi")
    assert claim in {failed.name for failed in refusal.value.failed}


def printed_bounds(record):
    record["family"]["ranges"][2] = [-PRINTED_M13[1], -PRINTED_M13[0]]


def other_dynamics(record):
    plant = record["plant"]["continuous"]
    text = json.dumps(plant["dynamics"])
    assert "a3" in text
    plant["dynamics"] = json.loads(text.replace("a3", "a4"))


def larger_domain(record):
    for signal in record["plant"]["continuous"]["signals"]:
        if signal["name"] == "h3":
            signal["lower"] = 4.0


@pytest.mark.parametrize("change", [printed_bounds, other_dynamics, larger_domain])
def test_the_full_check_derives_the_bounds_again(base, change):
    record = spoilt(base, change)
    with pytest.raises(ob.CertificateError) as refusal:
        certified(record, "full")
    names = {failed.name for failed in refusal.value.failed}
    assert names & {"jacobian", "model"}


@pytest.mark.parametrize("factor", [1 - 1e-9, 0.9])
def test_a_peak_bound_that_is_too_tight_is_refused(given_peak, factor):
    def tighter(record):
        record["bound"]["b"] = [value * factor for value in record["bound"]["b"]]

    contract = given_peak.certificate.contract
    design = contract.record.from_record(spoilt(given_peak, tighter))
    with pytest.raises(ob.CertificateError, match="not certified"):
        contract.certify(design, "lmi").require()


def test_save_load_and_prove_from_the_file_alone(base, given_peak, tmp_path):
    for name, observer in (("base", base), ("peak", given_peak)):
        path = tmp_path / f"{name}.json"
        observer.save(path)
        again = ob.load(path)
        assert again.record == json.loads(json.dumps(observer.record))
        np.testing.assert_array_equal(again.half_widths, observer.half_widths)
        checked = again.certificate.check()
        assert checked.valid
        assert {"model", "jacobian"} <= {claim.name for claim in checked}
        memory = observer.memory0([125, 165, 25, 35])
        for out, other in zip(
            observer.step(memory, [10, 10], [128, 168, 30]),
            again.step(memory, [10, 10], [128, 168, 30]),
            strict=True,
        ):
            np.testing.assert_array_equal(np.array(out), np.array(other))


ALONE = """
import sys
sys.modules["clarabel"] = sys.modules["cvxpy"] = None
import obsynth as ob
for claim in ob.load(sys.argv[1]).certificate.check():
    print(claim)
"""


@pytest.mark.long
def test_the_file_is_checked_in_another_process_without_a_solver(base, given_peak, tmp_path):
    for name, observer in (("base", base), ("peak", given_peak)):
        path = tmp_path / f"{name}.json"
        observer.save(path)
        told = json.loads(path.read_text())["claims"]
        assert all(claim["holds"] and claim["proof"] for claim in told)
        command = [sys.executable, "-c", ALONE, str(path)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        assert done.stdout.count(": proved (margin") > len(told) - 1


def test_stored_claims_are_not_believed(base, tmp_path):
    path = tmp_path / "base.json"
    base.save(path)
    record = json.loads(path.read_text())
    record["K"][0][0] += 1.0
    path.write_text(json.dumps(record))
    assert all(claim["holds"] for claim in record["claims"])
    with pytest.raises(ob.CertificateError, match="not certified"):
        ob.load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("not json", "not JSON"),
        ("[1, 2]", "no design"),
        ('{"format": "other"}', "no design"),
        ('{"format": "obsynth design", "version": 99}', "version"),
        ('{"format": "obsynth design", "version": 2, "method": "x"}', "not known"),
        (
            '{"format": "obsynth design", "version": 2, "method": "bounded_error_uio"}',
            "cannot be read",
        ),
    ],
)
def test_files_that_are_no_design(tmp_path, text, message):
    path = tmp_path / "design.json"
    path.write_text(text)
    with pytest.raises(ob.CertificateError, match=message):
        ob.load(path)


def test_a_matrix_of_the_wrong_shape_is_named(base):
    def cut(record):
        record["K"] = record["K"][:3]

    with pytest.raises(ob.CertificateError, match=r"K has shape \(3, 3\)"):
        certified(spoilt(base, cut), "lmi")


def test_saving_replaces_only_complete_files(base, tmp_path, monkeypatch):
    path = tmp_path / "design.json"
    path.write_text("kept")

    def fail(*args, **kwargs):
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        base.save(path)
    assert path.read_text() == "kept"
    assert [p.name for p in tmp_path.iterdir()] == ["design.json"]


def test_records_are_plain_json(base, given_peak):
    for observer in (base, given_peak):
        contract = observer.certificate.contract
        record = contract.to_record(contract.record.from_record(observer.record))
        assert json.loads(json.dumps(record, allow_nan=False)) == json.loads(
            json.dumps(observer.record)
        )


# -- the step --------------------------------------------------------------------------------
