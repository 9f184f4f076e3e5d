"""The process that carries out recipes: ``python -m helpers.fuzzing.worker (reading | whole)``.

It reads one JSON text a line from stdin and answers each with one on the file descriptor that stdout was. What is
printed meanwhile goes to the case's folder. Cases are carried out one after the other; where they are of ``reading``,
commands end before they run.
"""

import faulthandler
import json
import os
import resource
import sys
import time
import traceback
from pathlib import Path

from helpers.fuzzing import RUN
from helpers.fuzzing.cases import READ, WHOLE, end_before_they_run, judge_end

MEMORY = 10 << 30
"""Bytes of address space: what asks for more is told no, as on a small machine."""


def main(mode: str) -> None:
    """Answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from neurad import cli

    cli._prepare()
    if mode == "reading":
        end_before_they_run()
    cases, environment = READ if mode == "reading" else WHOLE, dict(os.environ)
    print(json.dumps({"end": "ready"}), file=answers, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        folder = Path(job["folder"])
        _redirect(folder)
        os.chdir(folder)
        os.environ.clear()  # of what a case has left there
        os.environ.update({**environment, RUN: job["run"]})
        answer = _judged(cases[job["recipe"]["kind"]], job["recipe"], folder)
        if (folder / "executed").exists():  # what code in configs and checkpoints would make
            answer = {"end": "executed", "where": job["recipe"]["kind"], "text": ""}
        os.chdir("/")
        print(json.dumps(answer), file=answers, flush=True)


def _redirect(folder: Path) -> None:
    """What is printed from here on goes to the files ``stdout`` and ``stderr`` of the folder."""
    _flush()
    for number, name in ((1, "stdout"), (2, "stderr")):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, number)
        os.close(descriptor)
    faulthandler.enable(2)


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()


def _judged(function, recipe: dict, folder: Path) -> dict:
    """Carry out a case and say how it ended."""
    begin = time.monotonic()
    try:
        code = _attempted(function, recipe, folder)
        answer = judge_end(code, folder)
    except AssertionError as error:
        answer = {"end": "silent", "where": str(error), "text": str(error)}
    return {**answer, "seconds": time.monotonic() - begin}


def _attempted(function, recipe: dict, folder: Path) -> int:
    """The exit code of a program that does this; what it says is printed."""
    from neurad.core.errors import InputError

    code: object = 0
    try:
        function(recipe, folder)
    except InputError as error:
        code = 2
        print(f"neurad: error: {' '.join(str(error).split())}", file=sys.stderr)
    except SystemExit as leaving:
        code = leaving.code
    except AssertionError:
        raise
    except BaseException:
        code = 1
        traceback.print_exc()
    _flush()
    return code if isinstance(code, int) else int(code is not None)


if __name__ == "__main__":
    main(sys.argv[1])
