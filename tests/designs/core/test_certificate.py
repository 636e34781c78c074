"""Certificates: what they require, and which claims of a file are those that are proved."""

from typing import Any

import pytest

from obsynth.designs.core.certificate import Certificate, Claim
from obsynth.designs.core.errors import CertificateError

FIRST = Claim("lmi", "it decays", True, 0.5, "Cholesky")
SECOND = Claim("model", "it is the plant's", True, float("inf"), "equality")
FAILED = Claim("bounds", "it is inside", False, -0.25, "intervals")
TOLD = FIRST.to_record()


def certificate(*claims: Claim) -> Certificate:
    stand_in: Any = None
    return Certificate(claims, stand_in, stand_in)


def test_one_claim_without_a_proof_spoils_a_certificate():
    sound = certificate(FIRST, SECOND)
    assert sound.valid and sound.require() is sound
    assert sound.margin == 0.5
    spoilt = certificate(FIRST, FAILED, SECOND)
    assert not spoilt.valid
    assert spoilt.margin == -0.25
    with pytest.raises(CertificateError, match="it is inside: NOT PROVED") as caught:
        spoilt.require()
    assert caught.value.failed == (FAILED,)


@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"margin": 0.5 * 1.009}, True),
        ({"proof": "another processor's"}, True),
        ({"margin": 0.5 * 1.02}, False),
        ({"margin": -0.5}, False),
        ({"margin": None}, False),
        ({"margin": 1}, False),
        ({"margin": "0.5"}, False),
        ({"name": "model"}, False),
        ({"statement": "it decays at once"}, False),
        ({"holds": False}, False),
        ({"proof": 1}, False),
        ({"more": "by hand"}, False),
        ({"proof": ...}, False),
        ({"margin": ...}, False),
    ],
)
def test_a_claim_is_told_word_for_word(change, same):
    """A margin to 1 %, and how it was proved apart. Mutants: a key more, a key that is missing."""
    entry = {k: v for k, v in {**TOLD, **change}.items() if v is not ...}
    assert FIRST.is_told_by(entry) == same
    listed, sound = [entry], certificate(FIRST, SECOND)
    if same:
        assert sound.agreeing_with(listed, "full") is sound
    else:
        with pytest.raises(CertificateError, match="not what is proved"):
            sound.agreeing_with(listed, "full")


def test_margins_that_are_not_finite_are_told_as_none():
    assert SECOND.is_told_by(SECOND.to_record())
    assert not SECOND.is_told_by({**SECOND.to_record(), "margin": 1.0})


def test_lists_of_claims_contradict_nothing_or_are_refused():
    """What "lmi" does not prove is left to a full check. Mutants: names not compared, or twice."""
    sound = certificate(FIRST, SECOND)
    for level in ("lmi", "full"):
        assert sound.agreeing_with(None, level) is sound
        assert sound.agreeing_with([], level) is sound
        for listed in ([TOLD, TOLD], "claims", ["lmi"], {"lmi": TOLD}, [{}, TOLD, {}]):
            with pytest.raises(CertificateError):
                sound.agreeing_with(listed, level)
    unknown = [{**TOLD, "name": "covers"}]
    assert sound.agreeing_with(unknown, "lmi") is sound
    with pytest.raises(CertificateError, match="no claim of that name"):
        sound.agreeing_with(unknown, "full")
