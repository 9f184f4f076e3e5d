"""How much memory there is, asked before much of it is taken."""

import os
from contextlib import suppress
from pathlib import Path

from neurad.core.errors import InputError
from neurad.runtime.progress import say

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

_LARGE = 1 << 30  # bytes from which on it is said what is taken
_said: set[str] = set()
_SYSTEM, _GROUP = Path("/proc/meminfo"), Path("/sys/fs/cgroup")
_PROCESS = Path("/proc/self/statm")


def free_memory() -> int | None:
    """Bytes that this process can still get, of the machine or of the group of processes it is in; None if unknown."""
    free: list[int] = []
    with suppress(OSError):
        lines = _SYSTEM.read_text().splitlines()
        free += [int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")]
    with suppress(OSError):
        most, used = ((_GROUP / name).read_text().strip() for name in ("memory.max", "memory.current"))
        free += [int(most) - int(used)] if most.isdecimal() and used.isdecimal() else []
    with suppress(OSError):
        limit = None if resource is None else resource.getrlimit(resource.RLIMIT_AS)[0]  # of ``ulimit -v``
        if limit is not None and limit != resource.RLIM_INFINITY:
            used_pages = int(_PROCESS.read_text().split()[0])
            free.append(max(limit - used_pages * resource.getpagesize(), 0))
    return min(free, default=None)


def resident_memory() -> int:
    """Bytes that this process has in memory; 0 where the system does not say."""
    try:
        pages = int(_PROCESS.read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def reserve(what: str, needed: int, kept: int) -> None:
    """Say what a large file takes, before it is read.

    Args:
        what: file and size, the beginning of the sentence.
        needed: bytes while it is read.
        kept: bytes of these that stay taken.

    Raises:
        InputError: the machine does not have them.
    """
    if needed < _LARGE:
        return
    free = free_memory()
    if free is not None and needed > free:
        raise InputError(f"{what}: reading it takes {needed / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free")
    if what not in _said:  # of photographs that are read again and again, once
        _said.add(what)
        say(f"{what}: it takes {kept / 1e9:.3g} GB of memory")
