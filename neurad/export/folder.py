"""A folder that appears as a whole or not at all: it is written beside its place and then moved there.

While it is written it is called ``.NAME.xxxxxxxx.part``. A process that is killed leaves it behind; the next export to
the same place removes it. A lock on the folder, which ends with the process that holds it, tells the dead from the
living.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neurad.core.errors import InputError
from neurad.runtime.files import PART, reason, writing
from neurad.runtime.reading import read_json

MANIFEST = "room.json"
"""The file by which an exported folder is recognised."""
MARK = "base_color_for"
"""A key that it has."""
_REPLACED = "replaced"  # what was at the place, for the moment between two moves


def check_out(out: Path, overwrite: bool) -> None:
    """Check that a folder may be written, before any work is done, and remove what killed exports to it left.

    Raises:
        InputError: something is there that is not to be replaced, or its parent is no folder that can be written to.
    """
    place = _place(out)
    if place.exists() and not place.is_dir():
        raise InputError(f"--out: {out} is there and no folder")
    if not place.parent.is_dir():
        raise InputError(f"--out: there is no folder {place.parent}")
    if Path.cwd().is_relative_to(place):
        raise InputError(f"--out: {out} is the folder that you are in, or lies above it; give a new one")
    with writing(out, "--out"):
        _remove_dead(place)
        _new_stage(place).rmdir()
    _check_free(out, place, overwrite)


def _check_free(out: Path, place: Path, overwrite: bool) -> None:
    with writing(out, "--out"):
        occupied = place.exists() and (not place.is_dir() or any(place.iterdir()))
    if occupied and not overwrite:
        raise InputError(f"--out: {out} is there already; add --overwrite to replace it")
    if occupied and not _is_export(place):
        raise InputError(f"--out: {out} is no folder of an earlier export, so --overwrite does not replace it")


def check_sources(out: Path, sources: Iterable[str | Path]) -> None:
    """Check that the folder to be replaced holds nothing that the export reads: it would be gone afterwards.

    Args:
        out: folder to write.
        sources: files that are read, or linked to.

    Raises:
        InputError: it holds one of them.
    """
    place = _place(out)
    for source in sources:
        for file in (os.path.abspath(source), os.path.realpath(source)):
            if Path(file).is_relative_to(place):
                raise InputError(f"--out: {out} holds {source}, which the run needs; export to another folder")


@contextmanager
def written_beside(out: Path, overwrite: bool = True) -> Iterator[Path]:
    """A new folder beside ``out``; it takes its place at the end of the block, and is removed if the block fails.

    Args:
        out: where it is going to be.
        overwrite: replace an earlier export; nothing else is replaced, also what has come there meanwhile.

    Raises:
        InputError: a file cannot be written: no room on the disk, no permission; or something has come to ``out``.
    """
    place = _place(out)
    with writing(out, "--out"):
        _remove_dead(place)
        stage = _new_stage(place)
    lock = _lock(stage)
    try:
        stage.chmod(0o777 & ~_umask())
        try:
            yield stage
        except InputError as error:
            raise InputError(str(error).replace(str(stage), str(place))) from error
        except OSError as error:
            where = str(error.filename or place).replace(str(stage), str(place))
            raise InputError(f"--out {where}: {reason(error)}") from error
        _check_free(out, place, overwrite)
        with writing(out, "--out"):
            _move(stage, place)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        _unlock(lock)


def _place(out: Path) -> Path:
    """Where the folder is going to be: what a link points to is written, not the link."""
    with writing(out, "--out"):
        return Path(os.path.realpath(out))


def _is_export(place: Path) -> bool:
    try:
        notes = read_json(place / MANIFEST)
    except InputError:
        return False
    return isinstance(notes, dict) and MARK in notes


def _new_stage(place: Path) -> Path:
    return Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=PART, dir=place.parent))


def _remove_dead(place: Path) -> None:
    """Remove what killed exports to this place left; put back what one of them had just moved away."""
    name = re.compile(rf"\.{re.escape(place.name)}\.[a-z0-9_]{{8}}{re.escape(PART)}")
    for left in place.parent.iterdir():
        if name.fullmatch(left.name) is None or left.is_symlink() or not left.is_dir():
            continue
        if (lock := _lock(left)) is None:
            continue
        with suppress(OSError):
            if not place.exists() and (left / _REPLACED).is_dir():
                os.replace(left / _REPLACED, place)
        shutil.rmtree(left, ignore_errors=True)
        _unlock(lock)


def _lock(folder: Path) -> int | None:
    """Lock a folder as long as this process lives; None if another one has, or if it cannot be locked here."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(handle)
        return None
    return handle


def _unlock(handle: int | None) -> None:
    if handle is not None:
        os.close(handle)


def _move(stage: Path, place: Path) -> None:
    """Put ``stage`` at ``place``; what was there disappears only when it is."""
    if not place.exists():
        os.replace(stage, place)
        return
    old = _new_stage(place)
    lock = _lock(old)
    os.replace(place, old / _REPLACED)
    try:
        os.replace(stage, place)
    except BaseException:  # also Ctrl-C between the two moves
        if not place.exists():
            os.replace(old / _REPLACED, place)
        raise
    finally:
        shutil.rmtree(old, ignore_errors=True)
        _unlock(lock)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
