"""Put a project in its place: whole or not at all, and never over someone else's files."""

from __future__ import annotations

import json
import os
import secrets
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

from obsynth.codegen.errors import CodegenError

KIND = "obsynth C project"
MANIFEST = "manifest.json"
_BUILD = "build"

Result = TypeVar("Result")


def place(
    folder: str | os.PathLike[str],
    files: Mapping[str, str],
    overwrite: bool,
    check: Callable[[Path], Result],
) -> tuple[Path, Result]:
    """Write files to a folder beside the target, check them there, move the folder into place."""
    target = Path(folder).expanduser().resolve()
    _check_target(target, overwrite)
    target.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    new = target.with_name(f".{target.name}.new-{token}")
    old = target.with_name(f".{target.name}.old-{token}")
    new.mkdir()
    try:
        for path, text in files.items():
            file = new / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8", newline="\n")
        result = check(new)
        # Something may have come into the target while the check ran.
        _check_target(target, overwrite)
        _swap(new, target, old)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return target, result


def _swap(new: Path, target: Path, old: Path) -> None:
    if target.exists():
        target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            old.rename(target)
            raise
        shutil.rmtree(old)
    else:
        new.rename(target)


def _check_target(target: Path, overwrite: bool) -> None:
    if not target.exists():
        return
    if not target.is_dir():
        raise CodegenError(f"{target} is a file; name a folder for the project", folder=str(target))
    if not any(target.iterdir()):
        return
    ours = _files_of(target)
    if ours is None:
        raise CodegenError(
            f"{target} holds files and is no project of obsynth; name another folder",
            folder=str(target),
        )
    if not overwrite:
        raise CodegenError(
            f"{target} holds a project already; say overwrite=True to replace it",
            folder=str(target),
        )
    present = {p.relative_to(target).as_posix() for p in target.rglob("*") if not p.is_dir()}
    foreign = sorted(p for p in present - ours if not p.startswith(f"{_BUILD}/"))
    if foreign:
        shown = ", ".join(foreign[:5]) + (", ..." if len(foreign) > 5 else "")
        raise CodegenError(
            f"{target} holds files that obsynth did not write ({shown}); move them elsewhere"
            " before the project is replaced",
            folder=str(target),
            files=tuple(foreign),
        )


def _files_of(target: Path) -> set[str] | None:
    """Return the files that a manifest lists; None where there is no manifest of ours."""
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(manifest, dict) or manifest.get("kind") != KIND:
        return None
    listed = manifest.get("files")
    return {MANIFEST, *listed} if isinstance(listed, dict) else None
