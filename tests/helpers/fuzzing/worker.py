"""The process that carries out recipes: ``python -m helpers.fuzzing.worker (in_process | forking)``.

It reads one JSON text a line from stdin and answers each with one on the file descriptor that stdout was. What is
printed meanwhile goes to the case's folder. ``in_process`` carries cases out itself, one after the other; ``forking``
has everything imported and no thread started, and forks for each case, so that a fit costs a second.
"""

import faulthandler
import json
import os
import resource
import signal
import sys
import time
import traceback
from pathlib import Path

from helpers.fuzzing import RUN

MEMORY = 10 << 30
"""Bytes of address space: what asks for more is told no, as on a small machine."""


def main(mode: str) -> None:
    """Answer until stdin ends."""
    answers = os.fdopen(os.dup(1), "w")
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from neurad import cli

    cli._prepare()
    from helpers.fuzzing import cases

    if mode == "forking":
        cases.import_all()
    carry_out = _forked if mode == "forking" else _judged
    print(json.dumps({"end": "ready"}), file=answers, flush=True)
    for line in sys.stdin:
        job = json.loads(line)
        folder = Path(job["folder"])
        _redirect(folder)
        os.chdir(folder)
        os.environ[RUN] = job["run"]
        answer = carry_out(job["recipe"], folder, job["seconds"])
        if (folder / "executed").exists():  # what code in configs and checkpoints would make
            answer = {"end": "executed", "where": job["recipe"]["kind"], "text": ""}
        os.chdir("/")
        print(json.dumps(answer), file=answers, flush=True)


def _redirect(folder: Path) -> None:
    """What is printed from here on goes to the files ``stdout`` and ``stderr`` of the folder."""
    sys.stdout.flush()
    sys.stderr.flush()
    for number, name in ((1, "stdout"), (2, "stderr")):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        os.dup2(descriptor, number)
        os.close(descriptor)
    faulthandler.enable(2)


def _judged(recipe: dict, folder: Path, seconds: float) -> dict:
    """Carry out a case and say how it ended: ``done``, ``sentence``, or a finding with where it happened."""
    from helpers.fuzzing import cases
    from neurad.core.errors import InputError

    begin = time.monotonic()
    try:
        cases.JUDGES[recipe["kind"]](recipe, folder)
        answer = {"end": "done"}
    except InputError as error:
        answer = _sentence(str(error))
    except AssertionError as error:
        answer = {"end": "silent", "where": str(error), "text": str(error)}
    except SystemExit as leaving:
        answer = cases.judge_exit(leaving.code, folder)
    except BaseException as error:
        answer = {"end": "traceback", "where": place_of(error), "text": traceback.format_exc()[-6000:]}
    answer["seconds"] = time.monotonic() - begin
    return answer


def _sentence(text: str) -> dict:
    if len(text.strip()) < 10 or "Traceback" in text:
        return {"end": "no sentence", "where": text[:80], "text": text}
    return {"end": "sentence", "text": " ".join(text.split())}


def place_of(error: BaseException) -> str:
    """The kind of an error, and the functions of this project that it passed through last."""
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if "/neurad/" in f.filename or "/datamodules/" in f.filename
    ]
    return f"{type(error).__name__} in " + " < ".join(
        f"{Path(f.filename).stem}.{f.name}" for f in reversed(frames[-2:])
    )


def _forked(recipe: dict, folder: Path, seconds: float) -> dict:
    from helpers.fuzzing import cases

    begin = time.monotonic()
    child = os.fork()
    if child == 0:
        os.setsid()
        code = 1
        try:
            cases.COMMANDS[recipe["kind"]](recipe, folder)
            code = 0
        except SystemExit as leaving:
            code = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
        except BaseException:
            traceback.print_exc()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    status = _wait(child, begin + seconds)
    if status is None:
        os.killpg(child, signal.SIGKILL)
        os.waitpid(child, 0)
        return {"end": "hang", "where": f"over {seconds:g} s", "text": _printed(folder), "seconds": seconds}
    answer = cases.judge_end(os.waitstatus_to_exitcode(status), folder)
    return {**answer, "seconds": time.monotonic() - begin}


def _wait(child: int, end: float) -> int | None:
    while time.monotonic() < end:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status
        time.sleep(0.01)
    return None


def _printed(folder: Path) -> str:
    return (folder / "stderr").read_text(errors="replace")[-3000:]


if __name__ == "__main__":
    main(sys.argv[1])
