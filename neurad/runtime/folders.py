"""Folders that belong to one process while it runs, and that appear as a whole or not at all.

A folder that is written beside its place and then moved there is called ``.NAME.xxxxxxxx.part`` until then. A process
that is killed leaves it behind; whoever writes to the same place next removes it. A lock on the folder, which ends with
the process that holds it, tells the dead from the living.
"""

import errno
import os
import re
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.runtime.files import PART, make_folder, reason, writing

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "run.lock"
"""File in a folder that is taken; it says by whom."""
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_REPLACED = "replaced"  # what was at the place, for the moment between two moves


@contextmanager
def written_beside(out: Path, check: Callable[[], None]) -> Iterator[Path]:
    """A new folder beside ``out``; it takes its place at the end of the block, and is removed if the block fails.

    Args:
        out: where it is going to be; the folder that it is in exists.
        check: refuses, at the end, what has come there meanwhile and is not to be replaced.

    Raises:
        InputError: a file cannot be written: no room on the disk, no permission; or what ``check`` raises.
    """
    place = place_of(out)
    with writing(out, "--out"):
        remove_dead(place)
        stage = new_stage(place)
    lock = _lock(stage)
    try:
        mask = os.umask(0)
        os.umask(mask)
        stage.chmod(0o777 & ~mask)
        try:
            yield stage
        except InputError as error:
            raise InputError(str(error).replace(str(stage), str(place))) from error
        except OSError as error:
            where = str(error.filename or place).replace(str(stage), str(place))
            raise InputError(f"--out {where}: {reason(error)}") from error
        check()
        with writing(out, "--out"):
            _move(stage, place)
    finally:
        shutil.rmtree(stage, ignore_errors=True)
        _unlock(lock)


def place_of(out: Path) -> Path:
    """Where the folder is going to be: what a link points to is written, not the link."""
    with writing(out, "--out"):
        return Path(os.path.realpath(out))


def new_stage(place: Path) -> Path:
    """A new, empty folder beside the place of another, which belongs to this process until it is locked or moved."""
    return Path(tempfile.mkdtemp(prefix=f".{place.name}.", suffix=PART, dir=place.parent))


def remove_dead(place: Path) -> None:
    """Remove what killed processes that wrote to this place left; put back what one of them had just moved away."""
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
    if fcntl is None:
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
    old = new_stage(place)
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


class FolderLock:
    """Takes a folder, made if it is not there; the system gives it back when the process ends, however that happens.

    Raises:
        InputError: another process has it, or nothing can be written there.
    """

    def __init__(self, folder: Path) -> None:
        self.path = make_folder(folder) / LOCK
        self._file: Any = None
        if fcntl is None:
            return
        while self._file is None:
            with writing(self.path):
                file = open(self.path, "a+b", buffering=0)  # noqa: SIM115
            try:
                fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                file.seek(0)
                owner = file.read(200).decode(errors="replace").strip()
                file.close()
                if error.errno not in _TAKEN:  # a file system without locks
                    return
                raise InputError(
                    f"run folder {folder}: a training run is writing into it ({owner or 'another process'}); wait "
                    "until it has ended, or start a run of its own folder"
                ) from error
            # Its last owner may have removed the file between these two calls: then the lock is of no file.
            if _is_at(file.fileno(), self.path):
                self._file = file
            else:
                file.close()
        with suppress(OSError):  # a full disk; what counts is the lock
            self._file.truncate(0)
            self._file.write(f"process {os.getpid()} on {socket.gethostname()}\n".encode())

    def release(self) -> None:
        """Give the folder back; removed while it is still locked, so that nobody can hold a file that is gone."""
        if self._file is not None:
            with suppress(OSError):
                self.path.unlink()
            self._file.close()
            self._file = None


def _is_at(handle: int, path: Path) -> bool:
    """Whether an open file is the one that ``path`` names."""
    try:
        return os.path.samestat(os.fstat(handle), os.stat(path))
    except OSError:
        return False
