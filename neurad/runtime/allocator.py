"""How memory is handed out and taken back."""

import ctypes
import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager

MAX_FREE_BYTES = 512 << 20
"""Bytes of freed memory that stay with the process."""
MIN_MAPPED_BYTES = 32 << 20
"""Arrays from so many bytes on are mapped one by one and given back when freed; the most that glibc accepts."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h


def keep_freed_memory() -> None:
    """Let glibc keep freed arrays for the next ones of their size: every step of a fit allocates the same again.

    It gives memory back too soon by itself: then the system clears every page anew, in a step of 16384 samples 12 % of
    the time. What the user has set in ``MALLOC_...`` variables stays; other C libraries are left alone.
    """
    if any(name.startswith("MALLOC_") for name in os.environ) or "GLIBC_TUNABLES" in os.environ:
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # not glibc
        return
    mallopt(_TRIM_THRESHOLD, MAX_FREE_BYTES)
    mallopt(_MMAP_THRESHOLD, MIN_MAPPED_BYTES)


@contextmanager
def imports_kept() -> Iterator[None]:
    """Let what is imported inside the block stay for good, and keep the garbage collector out of it.

    The libraries of a fit are 650 thousand objects; collecting among them takes 0.7 of the 3 seconds in
    which they are imported. For the start of a process: whatever exists by then is never collected.
    """
    with uncollected():
        try:
            yield
        finally:
            gc.freeze()


@contextmanager
def uncollected() -> Iterator[None]:
    """Keep the garbage collector out of the block: it looks again and again at what is made there."""
    if not gc.isenabled():  # the user's own choice, or a block around this one
        yield
        return
    gc.disable()
    try:
        yield
    finally:
        gc.enable()
