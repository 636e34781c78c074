"""Designs as JSON files: written whole or not at all, proved again when read."""

from __future__ import annotations

import importlib
import json
import math
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from obsynth.designs.core.errors import CertificateError

if TYPE_CHECKING:
    from obsynth.designs.core.certificate import Claim
    from obsynth.designs.core.observer import Observer


FORMAT = "obsynth design"
VERSION = 1
CLAIMS = "claims"

_METHODS = {
    "bounded_error_uio": "obsynth.designs.bounded_error.assembly",
    "hinf_uio": "obsynth.designs.hinf.assembly",
    "interval_observer": "obsynth.designs.interval.assembly",
    "qpv_observer": "obsynth.designs.qpv.assembly",
    "set_adaptive_observer": "obsynth.designs.set_adaptive.assembly",
}


def method_module(record: Mapping[str, Any]) -> str:
    """Return the module that proves and assembles designs of the record's method."""
    if record.get("format") != FORMAT:
        raise CertificateError(
            f"this is no design: its format is {record.get('format')!r}, not {FORMAT!r}"
        )
    if record.get("version") != VERSION:
        raise CertificateError(
            f"the design has version {record.get('version')!r}; this obsynth reads {VERSION}"
        )
    method = record.get("method")
    if method not in _METHODS:
        raise CertificateError(f"method {method!r} is not known; known are {sorted(_METHODS)}")
    return _METHODS[str(method)]


def save(observer: Observer, path: str | os.PathLike[str]) -> None:
    """Write the record of an observer; an existing file is replaced only when complete.

    The claims stand in the file too, for people to read; `load` proves them again and never
    believes them.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    """
    target = Path(path)
    claims = [_claim(claim) for claim in observer.certificate]
    text = json.dumps({**observer.record, CLAIMS: claims}, indent=1, allow_nan=False) + "\n"
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
        os.chmod(name, 0o644)
        os.replace(name, target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def _claim(claim: Claim) -> dict[str, Any]:
    margin = claim.margin if math.isfinite(claim.margin) else None
    return {**asdict(claim), "margin": margin}


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
    module = importlib.import_module(method_module(record))
    observer: Observer = module.assemble(record, level="lmi")
    return observer
