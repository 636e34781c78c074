"""Leave a folder whole or not at all, and never over someone else's files."""

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from obsynth.evaluate.errors import ReportError

MANIFEST = "run.json"
_KIND = "obsynth run"


@contextmanager
def complete_folder(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a new folder to write to; it takes the target's place when all went well.

    A manifest lists what was written, so that a later run may replace exactly
    that. If the block raises, or is interrupted, the target stays as it was.
    """
    target = check_target(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    new = target.with_name(f".{target.name}.new-{token}")
    old = target.with_name(f".{target.name}.old-{token}")
    new.mkdir()
    try:
        yield new
        files = sorted(p.relative_to(new).as_posix() for p in new.rglob("*") if p.is_file())
        manifest = json.dumps({"kind": _KIND, "files": files}, indent=1)
        (new / MANIFEST).write_text(manifest + "\n", encoding="utf-8")
        check_target(target)
        if target.exists():
            target.rename(old)
        try:
            new.rename(target)
        except BaseException:
            if old.exists():
                old.rename(target)
            raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def check_target(folder: str | os.PathLike[str]) -> Path:
    """Return the folder's full path, or refuse one that holds something else."""
    target = Path(folder).expanduser().resolve()
    if target.is_file():
        raise ReportError(f"{target} is a file; name a folder.", folder=str(target))
    if not target.exists() or not any(target.iterdir()):
        return target
    present = {p.relative_to(target).as_posix() for p in target.rglob("*") if p.is_file()}
    foreign = sorted(present - _written(target))
    if foreign:
        shown = ", ".join(foreign[:5]) + (", ..." if len(foreign) > 5 else "")
        raise ReportError(
            f"{target} holds files that obsynth run did not write ({shown}); name another folder.",
            folder=str(target),
            files=tuple(foreign),
        )
    return target


def _written(target: Path) -> set[str]:
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return set()
    if not isinstance(manifest, dict) or manifest.get("kind") != _KIND:
        return set()
    return {MANIFEST, *(str(name) for name in manifest.get("files", ()))}
