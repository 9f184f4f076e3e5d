"""Odd input of every kind: it works, or it ends with one sentence and exit code 2.

Recipes are drawn by hypothesis from a seed, NEURAD_FUZZ_SEED (1 if not given), and carried out in processes of their
own, so that crashes and hangs are findings, too. A finding is printed with its recipe and a folder that has the files.
NEURAD_FUZZ_SECONDS bounds the time of each long test.
"""

import os
import time
from pathlib import Path

import pytest
from helpers.fuzzing import RUN, strategies
from helpers.fuzzing.driver import Worker, explored

pytest.importorskip("mitsuba")

SEED = int(os.environ.get("NEURAD_FUZZ_SEED", "1"))
SECONDS = float(os.environ["NEURAD_FUZZ_SECONDS"]) if "NEURAD_FUZZ_SECONDS" in os.environ else None
"""Of every long test."""
ENOUGH = 40
"""Cases of which some have to succeed; a slow machine may not come so far within the seconds."""


@pytest.fixture(scope="module")
def reading(tmp_path_factory):
    """A worker that reads one case after the other."""
    worker = Worker("in_process", tmp_path_factory.mktemp("reading"))
    yield worker
    worker.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory):
    """A worker that forks for each case."""
    worker = Worker("forking", tmp_path_factory.mktemp("running"))
    yield worker
    worker.close()


@pytest.fixture(scope="module")
def finished_run(running, tmp_path_factory):
    """A finished run that checkpoints are made from, named in the environment."""
    folder = tmp_path_factory.mktemp("finished")
    answer = running.carry_out({"kind": "settings", "runs": True, "mutations": []}, keep=folder)
    assert answer["end"] == "done", answer
    os.environ[RUN] = str(folder / "lightning_logs/version_0")
    yield
    del os.environ[RUN]


def look_for_findings(strategy, worker, count, out: Path):
    """Carry out the cases and fail with all that was found."""
    begin = time.monotonic()
    ends = explored(strategy, worker, count, SEED, SECONDS, out)
    said = ", ".join(f"{number} {end}" for end, number in ends.most_common())
    print(f"\nfuzz: {ends.total()} cases in {time.monotonic() - begin:.0f} s: {said}; seed {SEED}")
    if ends.total() >= ENOUGH:
        assert ends["done"], "all cases were refused, which shows little of what accepted ones do"


def quick_and_whole(quick, whole):
    return pytest.mark.parametrize("count", [quick, pytest.param(whole, marks=pytest.mark.slow)])


@quick_and_whole(60, 3300)
def test_scene_folders(count, reading, tmp_path):
    look_for_findings(strategies.scenes(), reading, count, tmp_path)


@quick_and_whole(40, 800)
def test_settings(count, reading, tmp_path):
    look_for_findings(strategies.settings(), reading, count, tmp_path)


@quick_and_whole(40, 300)
def test_options_of_other_verbs(count, reading, tmp_path):
    look_for_findings(strategies.verbs(), reading, count, tmp_path)


@quick_and_whole(40, 600)
def test_checkpoints(count, finished_run, reading, tmp_path):
    look_for_findings(strategies.checkpoints(), reading, count, tmp_path)


@quick_and_whole(6, 200)
def test_whole_commands(count, finished_run, running, tmp_path):
    look_for_findings(strategies.fits(), running, count, tmp_path)


@pytest.mark.parametrize("worker", ["reading", "running"])
def test_crashes_and_tracebacks_are_findings(worker, request):
    """The last one: a worker that has crashed would have to start again."""
    worker = request.getfixturevalue(worker)
    crash, mistake = ({"kind": "crash", "variant": variant, "mutations": []} for variant in (1, 0))
    answer = worker.carry_out(mistake)
    assert answer["end"] == "traceback"
    assert answer["where"].startswith("ValueError")
    assert worker.carry_out(crash)["end"] == "crash"
