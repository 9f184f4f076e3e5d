"""``neurad`` as a child process, so that memory, time and failures of one run are measured apart from others.

This module imports nothing heavy: on Linux a child inherits the peak memory of its parent, so a process that measures
children has to stay small until the last of them has ended.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

NEURAD = [sys.executable, "-P", "-m", "neurad"]
"""The command; ``-P`` keeps files of the working folder from taking the place of modules."""


@dataclass(frozen=True)
class Ended:
    """How a child process ended."""

    code: int
    """Exit code; negative for a signal."""
    seconds: float
    """Wall-clock seconds from start to end, everything included."""
    peak_memory_mib: float | None
    """Largest resident memory; None where the system does not report it."""
    message: str
    """One sentence on why it failed; empty if it did not."""


def run_neurad(arguments: Sequence[str], log: Path) -> Ended:
    """Run ``neurad ARGUMENTS`` to its end.

    Args:
        arguments: the verb and what follows it.
        log: file that gets everything the child prints; its folder exists.
    """
    begin = time.monotonic()
    with log.open("wb") as file:
        process = subprocess.Popen([*NEURAD, *arguments], stdout=file, stderr=subprocess.STDOUT)
        try:
            code, peak = _wait(process)
        except KeyboardInterrupt:
            # The child got the same Ctrl-C and is saving its last iteration.
            _wait(process)
            raise
    return Ended(code, time.monotonic() - begin, peak, "" if code == 0 else failure(code, log))


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, float | None]:
    """Exit code and peak resident memory in MiB of this child alone (``RUSAGE_CHILDREN`` is the peak of all)."""
    if not hasattr(os, "wait4"):
        return process.wait(), None
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return process.returncode, usage.ru_maxrss / unit


def failure(code: int, log: Path) -> str:
    """Why a child failed, in one line.

    Args:
        code: its exit code; negative for a signal.
        log: file with what it printed.
    """
    if code < 0:
        return f"killed by signal {-code}"
    return last_message(log.read_text(errors="replace")) or f"exit code {code}"


def last_message(printed: str) -> str:
    """The last error of neurad in what a child printed, otherwise its last line."""
    lines = [line.strip() for line in printed.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("neurad: error: ")]
    return (errors or lines or [""])[-1].removeprefix("neurad: error: ")
