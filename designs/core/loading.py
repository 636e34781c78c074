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
from obsynth.designs.core.record import reading, shown


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
    record = _read_json(source)
    told = record.pop(CLAIMS, None)
    contract = contract_of(record)
    design = contract.record.from_record(record)
    with reading():
        certificate = contract.certify(design, "lmi").require()
        return certificate.stored_as(record, told).observer()


def _read_json(source: Path) -> dict[str, Any]:
    """Read a table; a key that stands twice, NaN and what is no JSON are refused."""
    data = source.read_bytes()

    def table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise CertificateError(f"{source.name} has the key {shown(repr(twice))} twice")
        return found

    def constant(word: str) -> None:
        raise CertificateError(f"the stored design in {source.name} holds {word}: not finite")

    try:
        text = data.decode("utf-8")
        record = json.loads(text, object_pairs_hook=table, parse_constant=constant)
    except (ValueError, RecursionError) as error:
        if isinstance(error, CertificateError):
            raise
        raise CertificateError(f"{source.name} is not JSON: {shown(str(error))}") from error
    if not isinstance(record, dict):
        raise CertificateError(f"{source.name} holds no design")
    return record


def contract_of(record: Mapping[str, Any]) -> Contract[Any]:
    """Return the contract of a record's method, or refuse its header."""
    if record.get("format") != FORMAT:
        raise CertificateError(
            f"this is no design: its format is {shown(repr(record.get('format')))}, not {FORMAT!r}"
        )
    version, method = record.get("version"), record.get("method")
    if type(version) is not int or version != VERSION:
        raise CertificateError(
            f"the design has version {shown(repr(version))} and this obsynth reads version "
            f"{VERSION}: design it again"
        )
    if not isinstance(method, str) or method not in CONTRACTS:
        raise CertificateError(
            f"method {shown(repr(method))} is not known; known are {sorted(CONTRACTS)}"
        )
    return CONTRACTS[method]
