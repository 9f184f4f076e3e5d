"""``neurad`` as a process of its own: one run's memory, time and failure are then that run's alone.

This module imports nothing heavy. On Linux a process inherits the peak memory of the one that starts it, so whoever
measures children has to stay small until the last of them has ended.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError

NEURAD = [sys.executable, "-P", "-m", "neurad"]
"""The command; ``-P`` keeps files of the working folder from taking the place of modules."""

_PRINT_CONFIGS = """
import contextlib, io, json, sys
import yaml
from neurad.cli import main
trees = []
for arguments in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        main(["fit", *arguments, "--print_config"])
    if not out.getvalue():
        raise SystemExit(2)
    trees.append(yaml.safe_load(out.getvalue()))
json.dump(trees, sys.stdout, default=str)
"""


@dataclass(frozen=True)
class Ended:
    """What became of a child."""

    code: int
    """Exit code; negative for a signal."""
    seconds: float
    """Wall-clock seconds from start to end, everything included."""
    peak_memory_mib: float | None
    """Largest resident memory; None where the system does not tell."""
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
    return Ended(code, time.monotonic() - begin, peak, "" if code == 0 else _reason(code, log))


def _wait(process: subprocess.Popen[bytes]) -> tuple[int, float | None]:
    """Exit code and peak resident memory in MiB of this very child (``RUSAGE_CHILDREN`` would mix all of them)."""
    if not hasattr(os, "wait4"):
        return process.wait(), None
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10
    return process.returncode, usage.ru_maxrss / unit


def _reason(code: int, log: Path) -> str:
    """The last thing that a failed child said, in one line."""
    if code < 0:
        return f"killed by signal {-code}"
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    said = next((line for line in reversed(lines) if line.startswith("neurad: error: ")), lines[-1] if lines else "")
    return said.removeprefix("neurad: error: ") or f"exit code {code}"


def resolved_configs(fits: Sequence[Sequence[str]]) -> list[Mapping[str, Any]]:
    """What ``neurad fit ARGUMENTS --print_config`` prints for every entry of ``fits``, from one child.

    Raises:
        InputError: the first complaint, in the words of ``neurad fit``.
    """
    command = [sys.executable, "-P", "-c", _PRINT_CONFIGS, json.dumps([list(fit) for fit in fits])]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        said = [line for line in done.stderr.splitlines() if line.startswith("neurad: error: ")]
        raise InputError(said[-1].removeprefix("neurad: error: ") if said else done.stderr.strip().splitlines()[-1])
    trees: list[Mapping[str, Any]] = json.loads(done.stdout)
    return trees
