"""A folder that belongs to one process while that process runs."""

import errno
import os
import socket
from contextlib import suppress
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.runtime.files import make_folder, writing

NAME = "run.lock"
"""File in a folder that is taken; it says by whom."""
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


def fcntl_module() -> Any:
    """The module with :func:`flock`; None where the system has none."""
    try:
        import fcntl
    except ImportError:  # Windows
        return None
    return fcntl


class FolderLock:
    """Takes a folder, made if it is not there; the system gives it back when the process ends, however that happens.

    Raises:
        InputError: another process has it, or nothing can be written there.
    """

    def __init__(self, folder: Path) -> None:
        self.path = make_folder(folder) / NAME
        self._file: Any = None
        fcntl = fcntl_module()
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
