"""Files that neurad writes: whole or not at all, and every failure in one sentence.

Whoever writes goes through here. A file is written beside its place, under its name and :data:`PART`, and moved there
when it is complete: a kill or a full disk leaves the old one, and no other disk is needed. Imports nothing heavy.
"""

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from neurad.core.errors import InputError

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

PART = ".part"
"""Ends the names of files that are being written."""

_NO_LINKS = (errno.EPERM, errno.ENOTSUP, errno.ENOSYS)
_REASONS = {
    errno.ENOSPC: "no space is left on its disk; free some, or write elsewhere",
    errno.EDQUOT: "your quota on its disk is used up; free some space, or write elsewhere",
    errno.EFBIG: "it grows over the largest size that a file may have here (ulimit -f); raise that limit",
    errno.EROFS: "its disk is read-only; write elsewhere",
    errno.EACCES: "you have no permission for it; write elsewhere, or change its permissions",
    errno.EPERM: "you have no permission for it; write elsewhere, or change its permissions",
    errno.EISDIR: "it is a folder, but a file is needed; give another name",
    errno.EEXIST: "it is a file, but a folder is needed; give another name",
    errno.ENOTDIR: "a part of its path is a file, but a folder is needed; give another name",
    errno.ENAMETOOLONG: "its name is too long; give a shorter one",
    errno.ELOOP: "its path goes in a circle of symbolic links; give another name",
    errno.ENXIO: "it is a pipe that nobody reads; give the name of a file",
    errno.EIO: "its disk fails to read or write; check the disk",
    errno.EMFILE: "too many files are open (ulimit -n); raise that limit",
    errno.EPIPE: "whoever read it has ended",
}


def reason(error: OSError) -> str:
    """What is wrong and what to do, without the file's name."""
    return _REASONS.get(error.errno or 0) or str(error.strerror or error)


@contextmanager
def writing(path: str | os.PathLike[str], option: str = "") -> Iterator[None]:
    """Turn a failure to write into one sentence.

    Args:
        option: that named it, such as ``--out``; begins the sentence.

    Raises:
        InputError: the system refused.
    """
    try:
        yield
    except (OSError, ValueError) as error:
        if isinstance(error, ValueError) and "null" not in str(error):  # of a path; all others are not about files
            raise
        why = reason(error) if isinstance(error, OSError) else "no file can have this name; give another one"
        raise InputError(f"{option} {os.fspath(path)}: {why}".lstrip()) from error


@contextmanager
def replacing(path: str | os.PathLike[str], option: str = "") -> Iterator[Path]:
    """A path beside ``path`` to write to; at the end it takes the place of ``path``, complete and on the disk.

    Devices and pipes are no files that could be replaced: they get the content at the end.

    Args:
        path: what is written; its folder exists. What a symbolic link points to is replaced, not the link.
        option: begins the sentence, see :func:`writing`.

    Raises:
        InputError: the system refused; ``path`` is as it was.
    """
    with writing(path, option):
        place = Path(os.path.realpath(path))
        if _is_special(place):
            with tempfile.TemporaryDirectory() as folder:
                part = Path(folder) / "part"
                yield part
                with _open_special(place) as handle:
                    write_all(handle, part.read_bytes())
            return
        if place.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        part = place.with_name(place.name + PART)
        try:
            yield part
            synchronise(part)
            os.replace(part, place)
        finally:
            with suppress(OSError):
                part.unlink()


def synchronise(path: Path) -> None:
    """Wait until a file is on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file in UTF-8, line ends as they are.

    Raises:
        InputError: the system refused; ``path`` is as it was.
    """
    with replacing(path) as part:
        part.write_bytes(text.encode(errors="backslashreplace"))


def append(path: str | os.PathLike[str], data: bytes) -> None:
    """Add bytes to the end of a file: all of them or, where the system refuses, none."""
    with writing(path), open(path, "ab", buffering=0) as file:
        before = file.tell()
        try:
            write_all(file.fileno(), data)
        except OSError:
            with suppress(OSError):
                file.truncate(before)
            raise


def write_all(handle: int, data: bytes | memoryview) -> None:
    """Write all of ``data``: a disk that fills up takes a part of it before it refuses the rest."""
    rest = memoryview(data)
    while len(rest):
        rest = rest[os.write(handle, rest) :]


def make_folder(path: str | os.PathLike[str], option: str = "") -> Path:
    """Create a folder and those above it, unless it is there."""
    with writing(path, option):
        Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


def check_folder(path: str | os.PathLike[str], option: str = "") -> None:
    """Find out before long work whether a folder, which need not exist, can be written into; leaves nothing behind."""
    with writing(path, option):
        place = Path(os.path.realpath(path))
        while not place.exists():
            if place == place.parent:
                break
            _check_name(place)
            place = place.parent
        if not place.is_dir():
            # Of the folder itself, or of one above it.
            code = errno.EEXIST if place == Path(os.path.realpath(path)) else errno.ENOTDIR
            raise OSError(code, os.strerror(code))
        handle, probe = tempfile.mkstemp(prefix=".neurad-", suffix=PART, dir=place)
        try:
            write_all(handle, b"\0")
        finally:
            os.close(handle)
            os.unlink(probe)


def check_file(path: str | os.PathLike[str], option: str = "") -> None:
    """Find out before long work whether a file can be written, without changing it."""
    with writing(path, option):
        place = Path(os.path.realpath(path))
        if _is_special(place):
            with _open_special(place) as handle:
                if stat.S_ISCHR(place.stat().st_mode) and not os.isatty(handle):
                    write_all(handle, b"\n")  # a device such as /dev/full opens and then refuses
            return
        if place.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        _check_name(place)
    check_folder(place.parent, option)


def remove_parts(folder: Path) -> None:
    """Remove what killed processes were writing into a folder. Nobody else may be writing there."""
    for part in folder.glob(f"*{PART}"):
        with suppress(OSError):
            part.unlink()


def check_space(folder: Path, size: int, count: int, what: str) -> None:
    """Find out before long work whether the disk of a folder has room.

    Args:
        folder: where files will be written.
        size: bytes of the largest file.
        count: how many of that size are to be there at once, besides what is there now.
        what: these files are, in words.

    Raises:
        InputError: it has not, or the limit of a file's size is too small.
    """
    place = folder
    while not place.exists() and place != place.parent:
        place = place.parent
    limit = -1 if resource is None else resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    if 0 <= limit < size:  # no limit is -1, or as large as it can be
        raise InputError(
            f"{folder}: {what} need files of {size / 1e6:.3g} MB, but the largest that a file may have here is "
            f"{limit / 1e6:.3g} MB (ulimit -f); raise that limit"
        )
    if hasattr(os, "statvfs"):
        disk = os.statvfs(place)
        free = disk.f_bavail * disk.f_frsize
        if disk.f_blocks and free < count * size:  # some network file systems do not know
            raise InputError(
                f"{folder}: {what} need {count * size / 1e6:.3g} MB, but its disk has {free / 1e6:.3g} MB left; free "
                "some, or write elsewhere"
            )


def _check_name(path: Path) -> None:
    """Refuse a name that the file system would, its part's included; ``exists`` calls such a path missing."""
    with suppress(FileNotFoundError, NotADirectoryError):  # the second is found again, at the folder that is none
        os.lstat(path.with_name(path.name + PART) if path.name else path)


def _is_special(path: Path) -> bool:
    """Whether there is something at ``path`` that is neither a file nor a folder."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISDIR(mode))


@contextmanager
def _open_special(path: Path) -> Iterator[int]:
    """The handle of a device or a pipe; without waiting for somebody to read it."""
    handle = os.open(path, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    try:
        os.set_blocking(handle, True)
        yield handle
    finally:
        os.close(handle)


def place(source: Path, target: Path, copy: bool) -> None:
    """Put a file at ``target``, whose folder is made: a link to the original, or a copy. Disks that know no links get
    copies.

    Raises:
        OSError: it cannot be written or read.
    """
    target.parent.mkdir(exist_ok=True)
    if not copy:
        try:
            os.symlink(source.resolve(), target)
            return
        except OSError as error:
            if error.errno not in _NO_LINKS:
                raise
    shutil.copyfile(source, target)
