"""``neurad bench start``: how long ``neurad fit`` takes to its first step, part by part.

Each start is a process of its own, a fit that ends after one step. Its clock runs from the start of the process,
interpreter and imports included.
"""

import argparse
import os
import statistics
import tempfile
import time

from benchmarks.bench.options import add_settings
from neurad.core.ranges import Count, option
from neurad.runtime.tables import Record

PARTS = ("imports and settings", "photographs", "scene and fields", "camera rays and checks", "first step")
"""In the order of a start."""
CACHE = "NUMBA_CACHE_DIR"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the benchmark."""
    add_settings(parser, "kitchen.yaml")
    parser.add_argument("--repeats", type=option(Count), default=5, help="starts, of which medians are shown")
    parser.add_argument(
        "--cold", action="store_true", help="an empty cache of compiled kernels for each, as after an installation"
    )
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Start fits, and print the medians of their parts.

    Raises:
        InputError: a setting is wrong, or a fit failed.
    """
    from benchmarks.bench.machine import report

    words = [f"--config={name}" for name in options.config or [options.default_config]]
    words += [f"--{word}" for word in options.set]
    if not options.cold:
        start(words, cold=False)  # fills the cache
    found = [start(words, options.cold) for _ in range(options.repeats)]
    rows: list[Record] = [
        {"part": part, **{key: statistics.median(one[i][key] for one in found) for key in ("seconds", "processor_s")}}
        for i, part in enumerate((*PARTS, "to the end of the first step"))
    ]
    cache = "empty" if options.cold else "full"
    report(rows, f"{' '.join(words)}: medians of {options.repeats} starts with {cache} cache of kernels", options.out)


def start(words: list[str], cold: bool) -> list[dict[str, float]]:
    """Wall-clock and processor seconds of each part, and of all, for one fit with the settings ``words``.

    Raises:
        InputError: the fit failed.
    """
    from benchmarks.bench.session import watched_fit
    from benchmarks.bench.watches import StartWatch

    ended = [*words, "--trainer.max_time=null", "--trainer.max_steps=1", "--trainer.logger=false"]
    before = os.environ.get(CACHE)
    with tempfile.TemporaryDirectory() as kernels:
        if cold:
            os.environ[CACHE] = kernels
        try:
            times = watched_fit("bench start", StartWatch, {"begun": time.monotonic()}, ended)
        finally:
            if cold:
                del os.environ[CACHE]
            if before is not None:
                os.environ[CACHE] = before
    begin = {"seconds": 0.0, "processor_s": 0.0}
    parts = [{key: now[key] - then[key] for key in begin} for then, now in zip([begin, *times], times, strict=False)]
    return [*parts, times[-1]]
