"""Leave a folder whole or not at all, and never over someone else's files."""

import json
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from obsynth.codegen.errors import FolderError

MANIFEST = "manifest.json"


@contextmanager
def complete_folder(
    folder: str | os.PathLike[str],
    kind: str,
    *,
    overwrite: bool = True,
    built: tuple[str, ...] = (),
) -> Iterator[Path]:
    """Give a new folder to write to; it takes the target's place when all went well.

    A manifest lists what was written, so that a later call may replace exactly that.
    """
    target = check_target(folder, kind, overwrite=overwrite, built=built)
    target.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    new = target.with_name(f".{target.name}.new-{token}")
    old = target.with_name(f".{target.name}.old-{token}")
    new.mkdir()
    try:
        yield new
        if not (new / MANIFEST).exists():
            manifest = json.dumps({"kind": kind, "files": sorted(_files(new))}, indent=1)
            (new / MANIFEST).write_text(manifest + "\n", encoding="utf-8")
        # Something may have come into the target in the meantime.
        check_target(target, kind, overwrite=overwrite, built=built)
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


def check_target(
    folder: str | os.PathLike[str],
    kind: str,
    *,
    overwrite: bool = True,
    built: tuple[str, ...] = (),
) -> Path:
    """Return the folder's full path, or refuse one that is not free.

    Free are new and empty folders and, with `overwrite`, what an earlier call of this kind
    left; files whose paths begin with `built` are made from those and go with them.
    """
    target = Path(folder).expanduser().resolve()
    if target.exists() and not target.is_dir():
        raise FolderError(f"{target} is a file; name a folder", folder=str(target))
    if not target.exists() or not any(target.iterdir()):
        return target
    ours = _listed(target, kind)
    if ours is None:
        foreign, word = sorted(path.name for path in target.iterdir()), f" and is no {kind}"
    else:
        foreign, word = sorted(_files(target) - ours), ""
        foreign = [path for path in foreign if not path.startswith(built)]
    if foreign:
        shown = ", ".join(foreign[:5]) + (", ..." if len(foreign) > 5 else "")
        raise FolderError(
            f"{target} holds files that obsynth did not write ({shown}){word}; name another"
            " folder, or move them elsewhere",
            folder=str(target),
            files=tuple(foreign),
        )
    if not overwrite:
        raise FolderError(
            f"{target} holds an {kind} already; say overwrite=True to replace it",
            folder=str(target),
        )
    return target


def _files(folder: Path) -> set[str]:
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()}


def _listed(target: Path, kind: str) -> set[str] | None:
    """Return the files that a manifest lists; None where there is no manifest of this kind."""
    try:
        manifest = json.loads((target / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    if not isinstance(manifest, dict) or manifest.get("kind") != kind:
        return None
    return {MANIFEST, *map(str, manifest.get("files", ()))}
