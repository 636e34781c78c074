"""Read a design from a file: nothing in it is believed before it is proved again."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from obsynth.designs.core.errors import CertificateError
from obsynth.designs.core.files import CLAIMS
from obsynth.designs.core.method import CONTRACTS, FORMAT, VERSION, Contract
from obsynth.designs.core.observer import Observer


def load(path: str | os.PathLike[str]) -> Observer:
    """Read a design, prove its LMIs for the stored gains and return the observer.

    The plant is parsed by a grammar of obsynth's own, nothing is evaluated.
    ``observer.certificate.check()`` proves the rest: that the stored vertices
    cover the Jacobian of the stored equations.

    Raises
    ------
    CertificateError
        If the file is no design, or a claim does not hold for what is in it.
    """
    source = Path(path)
    try:
        record = json.loads(source.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise CertificateError(f"{source.name} is not JSON: {error}") from error
    if not isinstance(record, dict):
        raise CertificateError(f"{source.name} holds no design")
    record.pop(CLAIMS, None)
    contract = contract_of(record)
    certificate = contract.certify(contract.record.from_record(record), "lmi")
    return certificate.stored_as(record).observer()


def contract_of(record: Mapping[str, Any]) -> Contract[Any]:
    """Return the contract of a record's method, or refuse its header."""
    if record.get("format") != FORMAT:
        raise CertificateError(
            f"this is no design: its format is {record.get('format')!r}, not {FORMAT!r}"
        )
    if record.get("version") != VERSION:
        raise CertificateError(
            f"the design has version {record.get('version')!r} and this obsynth reads version "
            f"{VERSION}: design it again"
        )
    method = record.get("method")
    if method not in CONTRACTS:
        raise CertificateError(f"method {method!r} is not known; known are {sorted(CONTRACTS)}")
    return CONTRACTS[str(method)]
