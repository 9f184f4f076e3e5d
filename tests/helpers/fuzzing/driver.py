"""Draws recipes, has a worker carry them out, and lists what it finds, each kind once."""

import json
import math
import os
import shutil
import signal
import time
from collections import Counter
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from unittest.mock import patch

import hypothesis
from hypothesis import HealthCheck, Phase

from helpers.fuzzing.worker import main

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
        self.process: BaseProcess | None = None
        self.count = 0

    def carry_out(self, recipe: dict, keep: bool = False) -> dict:
        """How a case ended: ``end``, its ``folder``, which stays of findings and those to ``keep``, and for a finding
        ``where`` and ``text``.
        """
        self.count += 1
        folder = self.scratch.resolve() / f"case{self.count}"
        folder.mkdir()
        if self.process is None or not self.process.is_alive():
            self._start()
        self.pipe.send(({**recipe, "run": self.run}, folder))
        answer = self._answer(HANG) or self._end(folder)
        if answer["end"] in FINE and not keep:
            shutil.rmtree(folder, ignore_errors=True)
        return {**answer, "folder": folder}

    def _start(self) -> None:
        spawn = get_context("spawn")
        self.pipe, theirs = spawn.Pipe()
        own = {"OMP_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": "", "PYTHONFAULTHANDLER": "1", "HOME": str(self.scratch)}
        with patch.dict(os.environ, own):
            self.process = spawn.Process(target=main, args=(self.mode, theirs))
            self.process.start()
        theirs.close()
        assert self._answer(START), "the worker does not start"

    def _answer(self, seconds: float) -> dict | None:
        """What the worker sends next; None if it ended or took too long."""
        with suppress(EOFError, ConnectionError):
            return self.pipe.recv() if self.pipe.poll(seconds) else None

    def _end(self, folder: Path) -> dict:
        self.process.join(1)  # one that has crashed is ending
        code = self.process.exitcode
        self.close()
        printed = (folder / "stderr").read_text(errors="replace")[-6000:] if (folder / "stderr").exists() else ""
        if code is None:
            return {"end": "hang", "where": f"over {HANG:g} s", "text": printed}
        own = [line.strip() for line in printed.splitlines() if "/neurad/" in line and " in " in line]
        return {"end": "crash", "where": f"exit code {code}: {own[0] if own else ''}", "text": printed}

    def close(self) -> None:
        if self.process is not None:
            with suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.join()
            self.pipe.close()
            self.process = None


def explored(strategy, worker: Worker, count: int, seed: int, seconds: float | None) -> Counter:
    """How many of ``count`` cases of a strategy, or as many as so many ``seconds`` allow, ended in which way.

    The seconds are counted from the end of the first case on: a worker's first one compiles and imports. Findings do
    not end it; each kind is listed once, with a folder that has the files of its first case.

    Raises:
        AssertionError: there are findings.
    """
    ends, findings, first_ended = Counter(), {}, math.inf

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
            findings.setdefault(f"{answer['end']}: {answer['where']}", []).append((recipe, answer))

    one()
    texts = []
    for kind, found in sorted(findings.items()):
        recipe, answer = found[0]
        last = "".join(f"    {line}\n" for line in answer["text"].splitlines()[-12:])
        texts.append(
            f"{kind} ({len(found)} times)\n  recipe: {json.dumps(recipe)}\n  files: {answer['folder']}\n{last}"
        )
    assert not texts, "\n".join(texts)
    return ends
