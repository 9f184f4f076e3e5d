"""``neurad`` as a child process, so that memory, time and failures of one run are measured apart from others.

This module imports nothing heavy: on Linux a child inherits the peak memory of its parent, so a process that measures
children has to stay small until the last of them has ended.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

NEURAD = [sys.executable, "-P", "-m", "neurad"]
"""The command; ``-P`` keeps files of the working folder from taking the place of modules."""
PATIENCE = 60.0
"""Seconds that a child has to save its work when this process is to end."""


@dataclass(frozen=True)
class Ended:
    """How a child process ended."""

    code: int
    """Exit code; negative for a signal."""
    seconds: float
    """Wall-clock seconds from start to end, everything included."""
    peak_memory_mib: float | None
    """Largest resident memory; None where the system does not report it."""
    processor_seconds: float | None
    """Seconds that all its threads ran; None where the system does not report it."""
    message: str
    """One sentence on why it failed; empty if it did not."""


def run_neurad(arguments: Sequence[str], log: Path) -> Ended:
    """Run ``neurad ARGUMENTS`` to its end; a file in a folder that exists, ``log``, gets everything it prints. Ctrl-C
    and signals that end this process end the child, which may save its last iteration, before it.
    """
    begin = time.monotonic()
    with log.open("wb") as file, signals_raise():
        process = subprocess.Popen([*NEURAD, *arguments], stdout=file, stderr=subprocess.STDOUT)
        try:
            code, peak, used = _wait(process)
        except BaseException:
            _end(process)
            raise
    return Ended(code, time.monotonic() - begin, peak, used, "" if code == 0 else failure(code, log))


@contextmanager
def signals_raise() -> Iterator[None]:
    """Let SIGTERM and, of a terminal that is gone, SIGHUP raise SystemExit inside the block where they would end this
    process at once: its children would go on without it.
    """
    found = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    alone = threading.current_thread() is threading.main_thread()
    before = {number: signal.signal(number, lambda number, _: sys.exit(128 + number)) for number in found
              if alone and signal.getsignal(number) is signal.SIG_DFL}  # fmt: skip
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a child: it saves its last iteration, unless that takes too long or another signal comes."""
    process.terminate()
    try:
        process.wait(PATIENCE)
    except BaseException as error:
        process.kill()
        process.wait()
        if not isinstance(error, subprocess.TimeoutExpired):
            raise


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, float | None, float | None]:
    """Exit code, peak resident memory in MiB and processor seconds of this child; ``RUSAGE_CHILDREN`` is of all."""
    if not hasattr(os, "wait4"):
        return process.wait(), None, None
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return process.returncode, usage.ru_maxrss / unit, usage.ru_utime + usage.ru_stime


def failure(code: int, log: Path) -> str:
    """Why a child failed, in one line, by its exit code (negative for a signal) and what it printed."""
    if code < 0:
        return f"killed by signal {-code}"
    return last_message(log.read_text(errors="replace")) or f"exit code {code}"


def last_message(printed: str) -> str:
    """The last error of neurad in what a child printed, otherwise its last line."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("neurad: error: ")]
    return (errors or lines or [""])[-1].removeprefix("neurad: error: ")
