"""``neurad bench memory``: whether the memory of a long fit grows.

A tiny scene is fitted by ``neurad fit`` in a process of its own, with all that a run writes: evaluations, pictures,
TensorBoard, ``metrics.csv`` and checkpoints. Resident memory is taken on the way; its slope is that of the straight
line through the second half, when caches and heaps have their size.
"""

import argparse
import math
from statistics import linear_regression, mean

from benchmarks.bench.options import SMALL_FIELDS
from neurad.core.errors import InputError
from neurad.core.ranges import Count, option
from neurad.runtime.memory import resident_memory
from neurad.runtime.tables import Record

STEPS = 20_000
SAMPLES = 200
"""Samples of the resident memory over a run."""
SETTINGS = (
    "--config=cornell.yaml", "--trainer.max_time=null", "--trainer.accelerator=cpu",
    "--trainer.enable_progress_bar=false",
    "--data.patches=16", "--model.sampling.spp=4", "--model.sampling.cached_spp=4",
    "--evaluation.spp=1", *SMALL_FIELDS,
)  # fmt: skip
"""A fit whose steps take milliseconds."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the benchmark."""
    parser.add_argument("--steps", type=option(Count), default=STEPS, help=f"iterations of the fit (default: {STEPS})")
    parser.add_argument("--evaluations", type=option(Count), default=40, help="evaluations on the way (default: 40)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the fit, e.g. data.resident=2"
    )
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")


def run(options: argparse.Namespace) -> None:
    """Fit, and print the memory on the way and its slope.

    Raises:
        InputError: a bad number, a wrong setting, or a system that does not report resident memory.
    """
    if options.steps < SAMPLES or options.evaluations < 1:
        raise InputError(f"--steps: at least {SAMPLES} are needed, and --evaluations at least 1")
    from benchmarks.bench.machine import report
    from benchmarks.bench.session import watched_fit
    from benchmarks.bench.watches import MemoryWatch

    if not resident_memory():
        raise InputError("bench memory: this system does not report resident memory in /proc/self/statm")
    words = [
        *SETTINGS, f"--trainer.max_steps={options.steps}",
        f"--evaluation.every_n_steps={max(1, options.steps // options.evaluations)}",
        *(f"--{word}" for word in options.set),
    ]  # fmt: skip
    watched = watched_fit("bench memory", MemoryWatch, {"every": options.steps // SAMPLES}, words)
    found = [(row["iteration"], row["resident_KiB"]) for row in watched]
    shown = [found[round(i * (len(found) - 1) / 10)] for i in range(11)]
    rows: list[Record] = [{"iteration": int(x), "resident_MiB": kib / 1024} for x, kib in shown]
    x, y = zip(*found[len(found) // 2 :], strict=True)
    line = linear_regression(x, y)
    noise = math.sqrt(mean((b - line.intercept - line.slope * a) ** 2 for a, b in zip(x, y, strict=True)))
    slope = 1000 * line.slope
    report(rows, f"resident memory of a fit with {options.evaluations} evaluations", options.out)
    print(f"\nslope over the second half: {slope:+.1f} KiB per 1000 steps (scatter about the line {noise:.0f} KiB)")
