"""A folder that appears as a whole or not at all: it is written beside its place and then moved there."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neurad.core.errors import InputError
from neurad.runtime.files import PART, check_folder, reason

MANIFEST = "room.json"
"""The file by which an exported folder is recognised."""


def check_out(out: Path, overwrite: bool) -> None:
    """Check that a folder may be written, before any work is done.

    Raises:
        InputError: something is there that is not to be replaced, or its parent is no folder that can be written to.
    """
    if out.is_symlink() or (out.exists() and not out.is_dir()):
        raise InputError(f"--out: {out} is there and no folder")
    parent = out.absolute().parent
    if not parent.is_dir():
        raise InputError(f"--out: there is no folder {parent}")
    check_folder(parent, "--out")
    if out.is_dir() and any(out.iterdir()):
        if not overwrite:
            raise InputError(f"--out: {out} is there already; add --overwrite to replace it")
        if not (out / MANIFEST).is_file():
            raise InputError(f"--out: {out} is no folder of an earlier export, so --overwrite does not replace it")


@contextmanager
def written_beside(out: Path) -> Iterator[Path]:
    """A new folder beside ``out``; it takes its place at the end of the block, and is removed if the block fails.

    Raises:
        InputError: a file cannot be written: no room on the disk, no permission.
    """
    place = out.absolute()
    try:
        stage = Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=PART, dir=place.parent))
    except OSError as error:
        raise InputError(f"--out {place.parent}: {reason(error)}") from error
    try:
        stage.chmod(0o777 & ~_umask())
        try:
            yield stage
        except InputError as error:
            raise InputError(str(error).replace(str(stage), str(place))) from error
        except OSError as error:
            where = str(error.filename or place).replace(str(stage), str(place))
            raise InputError(f"--out {where}: {reason(error)}") from error
        _move(stage, place)
    finally:
        shutil.rmtree(stage, ignore_errors=True)


def _move(stage: Path, place: Path) -> None:
    """Put ``stage`` at ``place``; what was there disappears only when it is."""
    if not place.exists():
        os.replace(stage, place)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=".old", dir=place.parent))
    os.replace(place, old / "room")
    try:
        os.replace(stage, place)
    except OSError:
        os.replace(old / "room", place)
        raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
