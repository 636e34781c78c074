"""Designs as JSON files, written whole or not at all."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from obsynth.designs.core.observer import Observer


CLAIMS = "claims"


def save(observer: Observer, path: str | os.PathLike[str]) -> None:
    """Write the record of an observer; an existing file is replaced only when complete.

    The claims stand in the file too, for people to read; `load` proves them again and refuses a
    file that lists others.

    Raises
    ------
    FileNotFoundError
        If the folder does not exist.
    """
    write_whole(Path(path), stored_text(observer))


def stored_text(observer: Observer) -> str:
    """Return what the file of an observer holds."""
    claims = [claim.to_record() for claim in observer.certificate]
    return json.dumps({**observer.record, CLAIMS: claims}, indent=1, allow_nan=False) + "\n"


def write_whole(target: Path, text: str) -> None:
    """Write a text; an existing file is replaced only when it is complete."""
    with replaced(target) as beside:
        beside.write_text(text, encoding="utf-8")


@contextmanager
def replaced(target: Path) -> Iterator[Path]:
    """Give a file to write beside the target, renamed in the end: no reader meets half a file."""
    handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    os.close(handle)
    try:
        yield Path(name)
        os.chmod(name, 0o644)
        os.replace(name, target)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
