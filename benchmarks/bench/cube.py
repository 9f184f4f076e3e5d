"""``neurad bench cube``: the paper's Cube study, time and memory of a training step against the length of light paths.

In a closed cube the albedo of the walls sets how long paths are. Every method gets the same pixels, positions and
samples, and every pair of method and albedo a separate process, so that peak memory is that of the pair alone.
The processes of one method stay alive together and take their steps in turns: other load of the machine then slows
all albedos alike, and with ``--peer`` ours on dense grids and Mitsuba alike. Albedo and radiance fields start at
the true values, and the optimizers run at rate 0, so each step costs what a training step costs and the albedo stays
that of the row (as in the paper's supplement).
"""

import argparse
import json
import math
import random
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Annotated, Any

from neurad.core.errors import InputError
from neurad.core.ranges import Count, OpenFraction, Positive, PositiveFraction, Range, option
from neurad.runs import child

ALBEDOS = (0.3, 0.5, 0.7, 0.9, 0.95, 0.97, 0.99)
METHODS = ("ours", "prb", "path")
FIELDS = ("hash", "dense")
MIN_STEPS = 3
"""Least number of steps behind a figure."""
COLD = 3
"""Steps of a turn that do not count. Ours on dense grids take 17.8, 16.0, 14.5, 13.7, 13.6 and 14.0
ms one after another (medians of 25 turns), Mitsuba's 166, 158, 157, 159, 159 and 158."""
WORKER = [*child.NEURAD, "bench", "cube-worker"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--albedos", type=option(OpenFraction), nargs="+", default=list(ALBEDOS), metavar="A", help="of the walls"
    )
    parser.add_argument("--methods", default=",".join(METHODS), help="of ours, prb and path (AD-PT), with commas")
    parser.add_argument("--fields", default=",".join(FIELDS), help="hash (grids and networks), dense (grids), or both")
    parser.add_argument(
        "--peer", action="store_true",
        help="Mitsuba 3's prb (llvm_ad_rgb) too, in turns with ours on dense grids; takes 1.4 GB an albedo",
    )  # fmt: skip
    parser.add_argument("--pixels", type=option(Count), default=2048, help="pixels in a batch")
    parser.add_argument(
        "--spp", type=option(Annotated[int, Range(2, 1 << 16)]), default=8, help="samples per pixel; at least 2"
    )
    parser.add_argument(
        "--size",
        type=option(Annotated[int, Range(2, 1 << 10)]),
        default=128,
        help="vertices along a side of the dense grids",
    )
    parser.add_argument(
        "--rr-prob", type=option(PositiveFraction), default=0.95,
        help="largest probability to go on; 1 lets paths at albedo a live 1 / (1 - a) bounces, as in the paper's table",
    )  # fmt: skip
    parser.add_argument("--steps", type=option(Count), default=9, help="steps behind a figure")
    parser.add_argument(
        "--limit",
        type=option(Positive),
        default=10.0,
        help=f"seconds after which {MIN_STEPS} steps suffice for a figure",
    )
    parser.add_argument("--out", type=Path, default=Path("cube.csv"), help="table to write (default: cube.csv)")


def run(options: argparse.Namespace) -> None:
    """Measure, print the table, write the CSV.

    Raises:
        InputError: a bad option, or parts that cannot be built.
    """
    for name, known in (("methods", METHODS), ("fields", FIELDS)):
        for word in getattr(options, name).split(","):
            if word not in known:
                raise InputError(f"--{name}: {word or 'nothing'} is unknown, there are {', '.join(known)}")
    common = {name: getattr(options, name) for name in ("pixels", "spp", "size", "rr_prob")}
    lengths = {albedo: path_lengths(albedo, options.rr_prob) for albedo in options.albedos}
    for albedo, (mean, limit) in lengths.items():
        print(f"albedo {albedo:g}: paths of {mean:.2f} bounces on average, at most {limit} (99.9 %)", flush=True)
    rows: list[dict[str, Any]] = []
    for group in _groups(options):
        jobs = [
            {**common, "fields": kind, "method": method, "albedo": albedo, "limit": lengths[albedo][1]}
            for kind, method in group
            for albedo in options.albedos
        ]
        cells = measure(jobs, options.steps, options.limit)
        for cell in cells:
            if not cell.missing:
                rows.append(_row(cell, *lengths[cell.job["albedo"]]))
                what = f"{rows[-1]['method']}, {rows[-1]['fields']}, albedo {rows[-1]['albedo']:g}"
                print(f"neurad: {what}: {cell.failed or 'measured'}", file=sys.stderr, flush=True)
            elif cell.job["method"] != "mitsuba":
                raise InputError(cell.missing)
        if reason := next((cell.missing for cell in cells if cell.missing), ""):
            print(f"neurad: left out: {reason}", file=sys.stderr)
    # Not before the last child has ended: on Linux a child begins with the peak memory of its parent.
    from benchmarks.bench.machine import describe, report

    title = (
        f"\ntraining step of {options.pixels} pixels x {options.spp} samples on {describe()}: median of the steps, "
        f"peak memory of the process and how much of it the steps added"
    )
    report(rows, title, str(options.out))


def work(job: str) -> None:
    """Entry point of a child process: runs the ``job`` of a :class:`Cell`, given as JSON."""
    from benchmarks.bench.cube_worker import main

    main(json.loads(job))


def _groups(options: argparse.Namespace) -> list[list[tuple[str, str]]]:
    """Pairs of field and method whose processes take their steps in turns: each alone, but ours beside the peer."""
    groups = [[(kind, method)] for kind in options.fields.split(",") for method in options.methods.split(",")]
    if options.peer:
        beside = next((group for group in groups if group == [("dense", "ours")]), [])
        groups = [group for group in groups if group is not beside]
        groups.append([*beside, ("voxels", "mitsuba")])
    return groups


def path_lengths(albedo: float, rr_prob: float) -> tuple[float, int]:
    """Mean number of bounces of paths in the cube, which a coin ends by roulette, and the 99.9 percentile."""
    going_on = min(albedo, rr_prob)
    return 1.0 / (1.0 - going_on), math.ceil(math.log(0.001) / math.log(going_on))


@dataclass
class Cell:
    """One pair of method and albedo, and the process that measures it."""

    job: dict[str, Any]
    seconds: list[float] = field(default_factory=list)
    rays: int = 0
    base: int = 0
    """Bytes in use before the first step."""
    peak: int = 0
    """Largest number of bytes in use."""
    failed: str = ""
    """Why there is no figure, if there is none."""
    missing: str = ""
    """The user's mistake, or a library that is not here."""

    def __post_init__(self) -> None:
        self.log = Path(tempfile.mkstemp(suffix=".log")[1])
        with self.log.open("wb") as errors:
            self.process = subprocess.Popen(
                [*WORKER, json.dumps(self.job)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )

    def receive(self) -> dict[str, Any] | None:
        """The next line of the process, parsed; None once it has failed."""
        assert self.process.stdout is not None
        line = self.process.stdout.readline() if not self.failed else ""
        if line:
            answer: dict[str, Any] = json.loads(line)
            self.missing = answer.get("error", "")
            if not self.missing:
                return answer
        self.failed = self.failed or self.missing or child.failure(self.process.wait(), self.log)
        return None

    def request(self, command: str) -> dict[str, Any] | None:
        """Send a command, ``step`` or ``end``, and wait for the answer."""
        assert self.process.stdin is not None
        if self.failed:
            return None
        with suppress(BrokenPipeError):  # it has ended: receive() reports why
            print(command, file=self.process.stdin, flush=True)
        return self.receive()

    def close(self) -> None:
        """Kill the process if it still runs, and remove its log."""
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()
        self.log.unlink(missing_ok=True)


def measure(jobs: Sequence[dict[str, Any]], steps: int, limit: float) -> list[Cell]:
    """Start a process for every job, let them take steps in turns, and read their peak memory at the end.

    A turn is :data:`COLD` steps that do not count and one that does: in a training run a step finds the caches as the
    step before left them, which it does not after another process's turn. The order of turns is drawn anew in every
    round: after Mitsuba's, whose threads stay active for a while, steps take longest.
    """
    shuffled = random.Random(0)
    cells = [Cell(job) for job in jobs]

    def wanted(cell: Cell) -> bool:
        count = len(cell.seconds)
        return not cell.failed and (count < MIN_STEPS or (count < steps and sum(cell.seconds) <= limit))

    try:
        for cell in cells:
            cell.receive()  # it is ready
        while any(wanted(cell) for cell in cells):
            for cell in shuffled.sample(cells, len(cells)):
                if not wanted(cell):
                    continue
                for _ in range(COLD):
                    cell.request("step")
                if answer := cell.request("step"):
                    cell.seconds.append(answer["seconds"])
                    cell.rays = answer["rays"]
        for cell in cells:
            if answer := cell.request("end"):
                cell.base, cell.peak = answer["base"], answer["peak"]
    finally:
        for cell in cells:
            cell.close()
    return cells


def _row(cell: Cell, mean: float, limit: int) -> dict[str, Any]:
    job, known = cell.job, bool(cell.seconds) and not cell.failed
    return {
        "fields": job["fields"], "method": job["method"], "albedo": job["albedo"], "mean_bounces": mean,
        "max_depth": 2 if job["method"] == "ours" else limit + 1, "steps": len(cell.seconds) if known else None,
        "ms": 1e3 * median(cell.seconds) if known else None, "peak_mib": cell.peak / 2**20 if known else None,
        "step_mib": (cell.peak - cell.base) / 2**20 if known else None, "rays": cell.rays or None,
        "failed": cell.failed,
    }  # fmt: skip
