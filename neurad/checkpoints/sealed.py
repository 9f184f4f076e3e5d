"""Zip files that carry a checksum of themselves, so that a single changed bit is found.

The checksum (SHA-256) is the archive's comment, at the very end of the file, and covers all bytes before it. Programs
that read zip files, torch among them, do not mind it, and it goes wherever the file is copied.
"""

import hashlib
import os
import struct
from pathlib import Path

from neurad.core.errors import InputError
from neurad.runtime.files import write_all

_MARK = b"neurad sha256 "
_DIGITS = 64
_CHUNK = 1 << 20


class Sealer:
    """Takes a zip file as it is written, from its first byte to its last, and adds the checksum.

    A writer in C++ may end the process over an exception in the middle, so the first refusal of the system is kept for
    :meth:`seal`.

    Args:
        handle: of the file, empty and open for writing.
    """

    def __init__(self, handle: int) -> None:
        self._handle = handle
        self._hash = hashlib.sha256()
        self._held = b""  # the last two bytes say how long the comment is
        self._error: OSError | None = None

    def write(self, data: bytes | memoryview) -> int:
        """Write the next bytes."""
        view = memoryview(data).cast("B")
        if len(view) < 2:
            view = memoryview(self._held + bytes(view))
        else:
            self._put(self._held)
        self._put(view[:-2])
        self._held = bytes(view[-2:])
        return len(data)

    def flush(self) -> None:
        """Nothing is kept back that could be written yet."""

    def seal(self) -> None:
        """Add the checksum.

        Raises:
            OSError: the system refused to write, here or before.
        """
        self._put(struct.pack("<H", len(_MARK) + _DIGITS) + _MARK)
        digest = self._hash.hexdigest().encode()
        self._put(digest)
        if self._error is not None:
            raise self._error

    def _put(self, data: bytes | memoryview) -> None:
        if self._error is None:
            try:
                write_all(self._handle, data)
            except OSError as error:
                self._error = error
            self._hash.update(data)


def check_seal(path: Path, name: str) -> None:
    """Compare a file with the checksum that it carries.

    Raises:
        InputError: it differs, or the file has none.
    """
    try:
        with path.open("rb", buffering=0) as file:
            left = os.fstat(file.fileno()).st_size - _DIGITS
            found, tail = hashlib.sha256(), b""
            while left > 0 and (chunk := file.read(min(left, _CHUNK))):
                found.update(chunk)
                left -= len(chunk)
                tail = (tail + chunk)[-len(_MARK) :]
            digest = file.read(_DIGITS)
    except OSError as error:
        raise InputError(f"{name}: it cannot be read ({error.strerror})") from error
    if tail != _MARK:
        raise InputError(
            f"{name}: it is not a readable checkpoint (it has no checksum at its end: it was cut short or changed)"
        )
    if digest != found.hexdigest().encode():
        raise InputError(f"{name}: it is damaged, its content does not agree with its checksum")
