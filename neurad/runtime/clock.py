"""Seconds since the process started, and those of its processors, without the time that does not count as training."""

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_imported = time.monotonic()


def _age_at_import() -> float:
    """Seconds that this process had run before this module was imported; 0 where the system does not report it."""
    try:
        # Field 22 of /proc/self/stat, counted after the parenthesised name: start time in ticks since boot.
        ticks = int(Path("/proc/self/stat").read_text().rsplit(")", 1)[1].split()[19])
        age = time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    except (OSError, AttributeError, ValueError, IndexError):
        return 0.0
    # A sandbox may count boot time from elsewhere: an age of minutes at import is not believed.
    return age if 0.0 <= age < 300.0 else 0.0


def _processor() -> tuple[float, float]:
    """Seconds that threads of this process have run, and that they were ready to run while a processor was taken; the
    second is 0 where the system does not report it.
    """
    waited = 0
    with suppress(OSError):
        for task in Path("/proc/self/task").iterdir():
            with suppress(OSError, IndexError, ValueError):  # the thread has just ended
                waited += int((task / "schedstat").read_text().split()[1])
    return time.process_time(), waited / 1e9


_start = _imported - _age_at_import()
_excluded = 0.0
_excluded_since: float | None = None
_processor_start = _processor_excluded = (0.0, 0.0)
_processor_since: tuple[float, float] | None = None
_held = False


def restart() -> None:
    """Count from now on: a run that was started from within Python has not begun with its process."""
    global _start, _excluded, _processor_start, _processor_excluded, _held
    _start, _excluded, _held = time.monotonic(), 0.0, False
    _processor_start, _processor_excluded = _processor(), (0.0, 0.0)


def hold() -> None:
    """Let all counts be 0 until :func:`restart`."""
    global _held
    _held = True


def training_seconds() -> float:
    """Seconds since the process (or the last :func:`restart`) began, without what ran under :func:`excluded`, where the
    count stands still.
    """
    now = time.monotonic() if _excluded_since is None else _excluded_since
    return 0.0 if _held else now - _start - _excluded


def processor_seconds() -> tuple[float, float]:
    """Seconds of all threads in the same time: those in which they ran, and those in which they were ready to run, but
    a processor was taken, as a rule by other programs (0 where the system does not report it).
    """
    if _held:
        return 0.0, 0.0
    now = _processor() if _processor_since is None else _processor_since
    counts = zip(now, _processor_start, _processor_excluded, strict=True)
    # The waiting of threads that have ended is not known any more.
    used, waited = (max(end - start - excluded, 0.0) for end, start, excluded in counts)
    return used, waited


@contextmanager
def excluded() -> Iterator[None]:
    """Leave the time spent in this block out of :func:`training_seconds` and :func:`processor_seconds`, as evaluation
    is. Blocks do not nest.
    """
    global _excluded, _excluded_since, _processor_excluded, _processor_since
    _excluded_since = begin = time.monotonic()
    _processor_since = used, waited = _processor()
    try:
        yield
    finally:
        after, (sum_used, sum_waited) = _processor(), _processor_excluded
        _processor_excluded = sum_used + after[0] - used, sum_waited + after[1] - waited
        _excluded += time.monotonic() - begin
        _excluded_since = _processor_since = None
