"""Odd input of every kind: it works, or it ends with one sentence and exit code 2.

Recipes are drawn by hypothesis from a seed, NEURAD_FUZZ_SEED (1 if not given), and carried out in processes of their
own, so that crashes and hangs are findings, too. A finding is printed with its recipe and a folder that has the files.
NEURAD_FUZZ_SECONDS bounds the time of each long test.
"""

import os
import time

import pytest
from helpers.fuzzing import strategies
from helpers.fuzzing.driver import Worker, explored

pytest.importorskip("mitsuba")

SEED = int(os.environ.get("NEURAD_FUZZ_SEED", "1"))
SECONDS = float(os.environ["NEURAD_FUZZ_SECONDS"]) if "NEURAD_FUZZ_SECONDS" in os.environ else None
"""Of every long test."""
ENOUGH = 40
"""Cases of which some have to succeed; a slow machine may not come so far within the seconds."""


FAMILIES = {
    "scenes": (strategies.scenes, "reading", 60, 3300),
    "settings": (strategies.settings, "reading", 40, 800),
    "verbs": (strategies.verbs, "reading", 40, 300),
    "checkpoints": (strategies.checkpoints, "reading", 40, 600),
    "whole commands": (strategies.fits, "whole", 6, 200),
}
"""What draws recipes, which worker carries them out, and how many: in every run of the tests, and as a whole."""


@pytest.fixture(scope="module")
def workers(tmp_path_factory):
    """One whose commands end before they run, and one that carries them out."""
    made = {mode: Worker(mode, tmp_path_factory.mktemp(mode)) for mode in ("reading", "whole")}
    yield made
    for worker in made.values():
        worker.close()


@pytest.fixture(scope="module")
def finished_run(workers):
    """A finished run that checkpoints are made from."""
    answer = workers["whole"].carry_out({"kind": "settings", "runs": True, "mutations": []}, keep=True)
    assert answer["end"] == "done", answer
    for worker in workers.values():
        worker.run = str(answer["folder"] / "lightning_logs/version_0")


@pytest.mark.usefixtures("finished_run")
@pytest.mark.parametrize("whole", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", FAMILIES)
def test_odd_input_works_or_gets_a_sentence(workers, family, whole):
    """Carry out the cases and fail with all that was found."""
    strategy, mode, quick, all_of_them = FAMILIES[family]
    begin = time.monotonic()
    ends = explored(strategy(), workers[mode], all_of_them if whole else quick, SEED, SECONDS)
    said = ", ".join(f"{number} {end}" for end, number in ends.most_common())
    print(f"\nfuzz: {ends.total()} cases in {time.monotonic() - begin:.0f} s: {said}; seed {SEED}")
    if ends.total() >= ENOUGH:
        assert ends["done"], "all cases were refused, which shows little of what accepted ones do"


def test_crashes_and_tracebacks_are_findings(workers):
    """The last one: a worker that has crashed would have to start again."""
    crash, mistake = ({"kind": "crash", "variant": variant, "mutations": []} for variant in (1, 0))
    answer = workers["reading"].carry_out(mistake)
    assert answer["end"] == "traceback"
    assert answer["where"].startswith("ValueError")
    assert workers["reading"].carry_out(crash)["end"] == "crash"
