"""Opening files that others wrote: the one place where whatever can go wrong with that becomes one sentence.

Every reader goes through here. A path is looked at before it is opened, as a named pipe or a device would be waited for
or read without end; what a library raises or prints about a broken file is caught around its call.
"""

import errno
import json
import os
import re
import stat
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.core.suggest import did_you_mean

TEXT_LIMIT = 256 << 20
"""Bytes of a text file. A camera file has about 1 kB a photograph; parsed, text takes some ten times its size."""
TEXT_MESH_LIMIT = 2 << 30
"""Bytes of a mesh as text, some ten million triangles; larger ones are binary."""
_LISTED = 2_000  # names of a folder that one is looked for among
_SHOWN = 160  # characters of a path or value in a sentence

_KINDS = {
    stat.S_ISDIR: "it is a folder",
    stat.S_ISFIFO: "it is a named pipe",
    stat.S_ISCHR: "it is a device",
    stat.S_ISBLK: "it is a device",
    stat.S_ISSOCK: "it is a socket",
}
_ERRORS = {
    errno.ELOOP: "its symbolic links lead in a circle",
    errno.ENAMETOOLONG: "its name is longer than the file system allows",
    errno.EACCES: "there is no permission to read it",
    errno.EPERM: "there is no permission to read it",
    errno.EMFILE: "too many files are open",
    errno.EISDIR: "it is a folder, not a file",
}


def shown(value: object) -> str:
    """A path or value for a sentence: what does not print is escaped, and the middle of what is long is left out."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(value))
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN // 2]}...{text[-_SHOWN // 2 :]}"


def listed(names: Iterable[object], most: int = 8) -> str:
    """Names for a sentence: the first of them, and how many others there are, two or more."""
    every = [shown(name) for name in names]
    if len(every) <= most + 1:
        return ", ".join(every)
    return f"{', '.join(every[:most])} and {len(every) - most} others"


def failure(path: object, error: Exception) -> InputError:
    """The sentence about a path that an operation of the system has failed for."""
    if isinstance(error, UnicodeError):
        return InputError(f"{shown(path)}: its name has characters that no file name can have")
    if isinstance(error, MemoryError):
        return InputError(f"{shown(path)}: there is not enough memory to read it")
    if isinstance(error, OSError) and error.errno in _ERRORS:
        return InputError(f"{shown(path)}: {_ERRORS[error.errno]}")
    if isinstance(error, OSError) and error.strerror:
        return InputError(f"{shown(path)}: it cannot be read ({error.strerror.lower()})")
    if isinstance(error, ValueError) and "\0" in str(path):
        return InputError(f"{shown(path)}: its name has a NUL character")
    return InputError(f"{shown(path)}: it cannot be read")


def exists(path: str | Path) -> bool:
    """Whether there is anything at a path, for files that may be missing.

    Raises:
        InputError: that cannot be found out: no such name is possible, links lead in a circle, no permission.
    """
    try:
        os.stat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    except (OSError, ValueError) as error:
        raise failure(path, error) from error
    return True


def regular_file(path: str | Path, missing: str = "there is no such file") -> Path:
    """The path, if it leads to a file of bytes that can be read: no folder, pipe, device or socket; ``missing`` is what
    to say if nothing is there.
    """
    if not exists(path):
        raise InputError(f"{shown(path)}: {missing}{similar(path)}")
    try:
        mode = os.stat(path).st_mode
    except OSError as error:
        raise failure(path, error) from error
    if not stat.S_ISREG(mode):
        kind = next((words for test, words in _KINDS.items() if test(mode)), "it is something else")
        raise InputError(f"{shown(path)}: {kind}, not a file")
    if not os.access(path, os.R_OK):
        raise InputError(f"{shown(path)}: {_ERRORS[errno.EACCES]}")
    return Path(path)


def beside(path: Path) -> list[str]:
    """Names in the folder that a path would be in; none where that cannot be read."""
    try:
        return sorted(os.listdir(path.parent))[:_LISTED]
    except (OSError, ValueError):
        return []


@lru_cache(maxsize=64)
def _by_case(folder: str, changed: int) -> dict[str, list[str]]:
    """Names in a folder by what is alike in upper and lower case; anew whenever the folder has changed."""
    found: dict[str, list[str]] = {}
    for name in sorted(os.listdir(folder)):
        found.setdefault(name.casefold(), []).append(name)
    return found


def in_other_case(path: Path) -> Path | None:
    """The path that differs from one that leads nowhere in upper and lower case alone; None where there is none.

    Raises:
        InputError: there are several.
    """
    known, missing = path, list[str]()
    while not exists(known) and known.name:
        missing.append(known.name)
        known = known.parent
    for name in reversed(missing):
        try:
            alike = _by_case(str(known), os.stat(known).st_mtime_ns).get(name.casefold(), [])
        except OSError:
            return None
        if len(alike) > 1:
            raise InputError(
                f"{shown(known / name)}: it is missing, and {' and '.join(map(shown, alike))} differ from it in upper "
                "and lower case alone"
            )
        if not alike:
            return None
        known /= alike[0]
    return known


def similar(path: str | Path) -> str:
    """The end of a sentence about a path that leads nowhere: the name beside it that was probably meant, or nothing.

    Names that differ in their digits alone are others of a series and not meant.
    """
    path = Path(path)
    names = beside(path)
    letters = re.sub(r"\d", "", path.name)
    return did_you_mean(path.name, [name for name in names if re.sub(r"\d", "", name) != letters])


def expanded(path: str | os.PathLike[str], option: str) -> Path:
    """A path in which ``~`` stands for the home folder; ``option`` begins the sentence if nobody has it."""
    try:
        return Path(path).expanduser()
    except RuntimeError as error:
        raise InputError(f"{option} {shown(path)}: {str(error).rstrip('.')}") from error


def folder(path: str | Path, option: str) -> Path:
    """The absolute path of a folder; ``~`` stands for the home folder.

    Raises:
        InputError: there is no such folder.
    """
    try:
        found = Path(path).expanduser().resolve()
        if found.is_dir():
            return found
        if found.exists():
            raise InputError(f"{option}: {shown(path)} is a file; name the folder that it is in")
    except RuntimeError as error:  # of pathlib: no such user, links in a circle
        raise InputError(f"{option}: {shown(path)}: {str(error).rstrip('.')}") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{option}: {failure(path, error)}") from error
    raise InputError(f"{option}: there is no folder {shown(path)}{similar(path)}")


def read_bytes(path: str | Path, limit: int | None = None, missing: str = "there is no such file") -> bytes:
    """The bytes of a file, ``limit`` of them at most; ``missing`` is what to say if there is none.

    Raises:
        InputError: it cannot be read or is too large.
    """
    file = regular_file(path, missing)
    try:
        with file.open("rb") as stream:
            if limit is None or os.fstat(stream.fileno()).st_size <= limit:
                return stream.read()
    except (OSError, MemoryError) as error:
        raise failure(path, error) from error
    raise InputError(f"{shown(path)}: it has more than {limit >> 20} MB, which no file of its kind needs")


def read_text(path: str | Path, missing: str = "there is no such file") -> str:
    """The text of a file in UTF-8, with or without a byte order mark; line ends are kept.

    Raises:
        InputError: it cannot be read, is too large or is no such text.
    """
    data = read_bytes(path, TEXT_LIMIT, missing)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{shown(path)}: it is not text in UTF-8 (byte {error.start} is {data[error.start]})"
        ) from error


def read_json(path: str | Path, missing: str = "there is no such file") -> Any:
    """What a JSON file describes.

    Raises:
        InputError: it cannot be read, is not JSON, nests deeper than Python can follow, or an object has a key twice.
    """
    return parse_json(read_text(path, missing), path)


def parse_json(text: str, path: str | Path) -> Any:
    """What JSON describes that stands in a file."""
    try:
        return json.loads(text, object_pairs_hook=lambda pairs: _once(pairs, path))
    except RecursionError as error:
        raise InputError(f"{shown(path)}: it is nested too deeply") from error
    except ValueError as error:
        reason = str(error).partition(";")[0]  # advice to programmers follows
        raise InputError(f"{shown(path)}: it is not valid JSON ({shown(reason)})") from error


def _once(pairs: list[tuple[str, Any]], path: str | Path) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        twice = next(key for i, (key, _) in enumerate(pairs) if key in {k for k, _ in pairs[:i]})
        raise InputError(f"{shown(path)}: an object in it has the key {shown(twice)!r} twice")
    return found


@contextmanager
def native(path: str | Path, said: str | Callable[[Exception], str]) -> Iterator[None]:
    """Around the call of a library that reads a file: what it raises becomes a sentence, ``said`` without the path or
    made by it of the error; what it prints or warns of is discarded.
    """
    try:
        with quiet(), warnings.catch_warnings(action="ignore"):
            yield
    except InputError:
        raise
    except MemoryError as error:
        raise failure(path, error) from error
    except Exception as error:  # libraries raise what they like about broken bytes
        raise InputError(f"{shown(path)}: {said if isinstance(said, str) else said(error)}") from error


_NOISE = (b"EXR_ERR", b"Warning: Exception raised reading")
_captured = threading.RLock()


@contextmanager
def quiet() -> Iterator[None]:
    """Discard what a library prints by itself about broken files: what it raises says the same.

    stdout and stderr belong to the whole process: what other threads print in between is printed afterwards.
    """
    with _captured:
        sinks = [sink for sink in (_redirected(1), _redirected(2)) if sink is not None]
        try:
            yield
        finally:
            for descriptor, kept, sink in sinks:
                os.dup2(kept, descriptor)
                if threading.current_thread() is not threading.main_thread():
                    _replay(sink, descriptor)
                os.close(kept)
                os.close(sink)


def _redirected(descriptor: int) -> tuple[int, int, int] | None:
    """Send a stream into memory: its descriptor, a copy of where it went, and where it goes. None if it is closed."""
    try:
        kept = os.dup(descriptor)
    except OSError:
        return None
    sink = os.memfd_create("printed") if hasattr(os, "memfd_create") else os.open(os.devnull, os.O_RDWR)
    os.dup2(sink, descriptor)
    return descriptor, kept, sink


def _replay(sink: int, descriptor: int) -> None:
    """Print what was captured, but the libraries' own lines."""
    os.lseek(sink, 0, os.SEEK_SET)
    while block := os.read(sink, 1 << 20):
        text = b"".join(line for line in block.splitlines(keepends=True) if not any(n in line for n in _NOISE))
        if text:
            os.write(descriptor, text)
