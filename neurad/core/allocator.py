"""How the C library hands out memory."""

from __future__ import annotations

import ctypes
import os

KEPT = 512 << 20
"""Bytes of freed memory that stay with the process."""
MAPPED = 32 << 20
"""Arrays from so many bytes on are mapped one by one and given back when freed; the most that glibc accepts."""
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of malloc.h


def keep_freed_memory() -> None:
    """Let glibc keep freed arrays for the next ones of their kind, which every step of a fit asks for again.

    It gives memory back too soon by itself: then the system clears every page anew, in a step of 16384 samples 12 % of
    the time. What the user has set in ``MALLOC_...`` variables stays; other C libraries are left alone.
    """
    if any(name.startswith("MALLOC_") for name in os.environ) or "GLIBC_TUNABLES" in os.environ:
        return
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # not glibc
        return
    mallopt(_TRIM_THRESHOLD, KEPT)
    mallopt(_MMAP_THRESHOLD, MAPPED)
