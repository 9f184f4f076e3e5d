"""Draws recipes, has a worker carry them out, and lists what it finds, each kind once."""

import json
import math
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import hypothesis
from hypothesis import HealthCheck, Phase

FINE = ("done", "sentence")
HANG = 60.0
"""Seconds that no case may take."""
START = 180.0
"""Seconds that a worker may take to import everything; a machine may be busy."""


class Worker:
    """A process that carries out cases; a new one takes its place when it has crashed or hangs.

    Args:
        mode: 'reading' or 'whole', see :mod:`helpers.fuzzing.worker`.
        scratch: folder for the cases' folders.
    """

    def __init__(self, mode: str, scratch: Path) -> None:
        self.mode, self.scratch, self.run = mode, scratch, ""  # the folder of a finished run, of which checkpoints are
        self.process: subprocess.Popen | None = None
        self.count = 0

    def carry_out(self, recipe: dict, keep: Path | None = None) -> dict:
        """How a case ended: ``end``, and for a finding ``where`` and ``text``; its folder stays if it is ``keep``."""
        self.count += 1
        folder = keep or self.scratch / f"case{self.count}"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        process = self._running()
        job = {"recipe": {**recipe, "run": self.run}, "folder": str(folder.resolve())}
        process.stdin.write((json.dumps(job) + "\n").encode())
        process.stdin.flush()
        answer = self._answer(HANG) or self._end(folder)
        if keep is None:
            shutil.rmtree(folder, ignore_errors=True)
        return answer

    def _running(self) -> subprocess.Popen:
        if self.process is None or self.process.poll() is not None:
            environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
            environment |= {"CUDA_VISIBLE_DEVICES": "", "PYTHONFAULTHANDLER": "1", "HOME": str(self.scratch)}
            log = (self.scratch / f"{self.mode}.log").open("wb")
            self.process = subprocess.Popen(
                [sys.executable, "-m", "helpers.fuzzing.worker", self.mode],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, env=environment, start_new_session=True,
            )  # fmt: skip
            if self._answer(START) is None:
                self.close()
                raise AssertionError("the worker does not start: " + (self.scratch / f"{self.mode}.log").read_text())
        return self.process

    def _answer(self, seconds: float) -> dict | None:
        """The worker's next line; None if it ended or took too long."""
        ready, _, _ = select.select([self.process.stdout], [], [], seconds)
        line = self.process.stdout.readline() if ready else b""
        return json.loads(line) if line.endswith(b"\n") else None

    def _end(self, folder: Path) -> dict:
        """Why there was no answer."""
        try:
            code = self.process.wait(timeout=1)  # one that has crashed is ending
        except subprocess.TimeoutExpired:
            code = None
        self.close()
        printed = (folder / "stderr").read_text(errors="replace")[-6000:] if (folder / "stderr").exists() else ""
        if code is None:
            return {"end": "hang", "where": f"over {HANG:g} s", "text": printed}
        own = [line.strip() for line in printed.splitlines() if "/neurad/" in line and " in " in line]
        return {"end": "crash", "where": f"exit code {code}: {own[0] if own else ''}", "text": printed}

    def close(self) -> None:
        """End the worker and all that it started."""
        if self.process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self.process.stdin.close()
            self.process.stdout.close()
            self.process = None


def explored(strategy, worker: Worker, count: int, seed: int, seconds: float | None, out: Path) -> Counter:
    """How many of ``count`` cases of a strategy, or as many as so many ``seconds`` allow, ended in which way.

    The seconds are counted from the end of the first case on: a worker's first one compiles and imports. Findings do
    not end it; each kind is listed once, with a folder that has the files of its first case.

    Raises:
        AssertionError: there are findings.
    """
    ends, findings, counts, first_ended = Counter(), {}, Counter(), math.inf

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count, database=None, deadline=None, phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip
    @hypothesis.given(strategy)
    def one(recipe):
        nonlocal first_ended
        if seconds is not None and time.monotonic() - first_ended > seconds:
            return
        answer = worker.carry_out(recipe)
        first_ended = min(first_ended, time.monotonic())
        ends[answer["end"]] += 1
        if answer["end"] not in FINE:
            kind = f"{answer['end']}: {answer['where']}"
            findings.setdefault(kind, (recipe, answer["text"]))
            counts[kind] += 1

    one()
    texts = []
    for number, (kind, (recipe, text)) in enumerate(sorted(findings.items())):
        folder = out / f"finding{number}"
        if not kind.startswith("hang"):
            worker.carry_out(recipe, keep=folder)
        last = "".join(f"    {line}\n" for line in text.splitlines()[-12:])
        texts.append(f"{kind} ({counts[kind]} times)\n  recipe: {json.dumps(recipe)}\n  files: {folder}\n{last}")
    assert not texts, "\n".join(texts)
    return ends
