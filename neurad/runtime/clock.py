"""Seconds since the process started, with and without the time that does not count as training."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_imported = time.monotonic()


def _age_at_import() -> float:
    """Seconds that this process had run before this module was imported; 0 where the system does not report it."""
    try:
        import os

        # Field 22 of /proc/self/stat, counted after the parenthesised name: start time in ticks since boot.
        ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return 0.0
    # A sandbox may count boot time from elsewhere: an age of minutes at import is not believed.
    return age if 0.0 <= age < 300.0 else 0.0


_start = _imported - _age_at_import()
_excluded = 0.0
_excluded_since: float | None = None


def restart() -> None:
    """Count from now on: a run that was started from within Python has not begun with its process."""
    global _start, _excluded
    _start, _excluded = time.monotonic(), 0.0


def training_seconds() -> float:
    """Seconds since the process (or the last :func:`restart`) began, without what ran under :func:`excluded`, where the
    count stands still.
    """
    now = time.monotonic() if _excluded_since is None else _excluded_since
    return now - _start - _excluded


@contextmanager
def excluded() -> Iterator[None]:
    """Leave the time spent in this block out of :func:`training_seconds`, as evaluation is. Blocks do not nest."""
    global _excluded, _excluded_since
    _excluded_since = begin = time.monotonic()
    try:
        yield
    finally:
        _excluded += time.monotonic() - begin
        _excluded_since = None
