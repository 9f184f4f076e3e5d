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
import random
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median, quantiles
from typing import Annotated, Any

from neurad.core.errors import InputError
from neurad.core.ranges import Count, OpenFraction, Positive, PositiveFraction, Range, option
from neurad.runs import child

ALBEDOS = (0.3, 0.5, 0.7, 0.9, 0.95, 0.97, 0.99)
METHODS = ("ours", "prb", "path")
FIELDS = ("hash", "dense")
BAR = 0.10
"""Largest change of time and memory that still counts as constant."""
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
        "--field-fraction", type=option(PositiveFraction), default=0.25,
        help="fraction of the positions at which the radiance field of ours learns, as model.sampling.field_fraction",
    )  # fmt: skip
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
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--tracer", default=None, help="default: embree, on a GPU warp")
    parser.add_argument("--out", type=Path, default=Path("cube.csv"), help="table to write (default: cube.csv)")


def run(options: argparse.Namespace) -> None:
    """Measure, print the table and the verdict, write the CSV.

    Raises:
        InputError: a bad option, or parts that cannot be built.
    """
    _check(options)
    common = {name: getattr(options, name) for name in ("pixels", "spp", "field_fraction", "size", "rr_prob", "device")}
    common["tracer"] = options.tracer or ("warp" if options.device.startswith("cuda") else "embree")
    lengths = _path_lengths(options.albedos, common)
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
                print(f"neurad: {_sentence(rows[-1])}", file=sys.stderr, flush=True)
            elif cell.job["method"] != "mitsuba":
                raise InputError(cell.missing)
        if reason := next((cell.missing for cell in cells if cell.missing), ""):
            print(f"neurad: left out: {reason}", file=sys.stderr)
    _report(rows, options)


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


def _check(options: argparse.Namespace) -> None:
    for name, known in (("methods", METHODS), ("fields", FIELDS)):
        for word in getattr(options, name).split(","):
            if word not in known:
                raise InputError(f"--{name}: {word or 'nothing'} is unknown, there are {', '.join(known)}")


# ---- processes


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


def _path_lengths(albedos: Sequence[float], common: dict[str, Any]) -> dict[float, tuple[float, int]]:
    """Average length of the roulette walk at every albedo, and its 99.9 percentile."""
    cell = Cell({**common, "method": "lengths", "albedos": list(albedos)})
    try:
        answer = cell.receive()
    finally:
        cell.close()
    if answer is None:
        raise InputError(f"bench cube: {cell.failed}")
    return {albedo: (mean, limit) for albedo, (mean, limit) in zip(albedos, answer["lengths"], strict=True)}


# ---- figures


def _row(cell: Cell, mean: float, limit: int) -> dict[str, Any]:
    job, ms = cell.job, [1e3 * s for s in cell.seconds]
    known = bool(ms) and not cell.failed
    low, _, high = quantiles(ms, n=4, method="inclusive") if len(ms) > 1 else (None, None, None)
    return {
        "fields": job["fields"], "method": job["method"], "albedo": job["albedo"], "mean_bounces": mean,
        "max_depth": 2 if job["method"] == "ours" else limit + 1, "steps": len(ms) if known else None,
        "ms": median(ms) if known else None, "ms_low": low if known else None, "ms_high": high if known else None,
        "peak_mib": cell.peak / 2**20 if known else None,
        "step_mib": (cell.peak - cell.base) / 2**20 if known else None,
        "rays": cell.rays or None, "failed": cell.failed,
    }  # fmt: skip


def _sentence(row: dict[str, Any]) -> str:
    what = f"{row['method']}, {row['fields']}, albedo {row['albedo']:g}"
    return f"{what}: " + (row["failed"] or f"{row['ms']:.1f} ms a step, peak {row['peak_mib']:.0f} MiB")


def verdicts(rows: Sequence[dict[str, Any]]) -> list[str]:
    """How far time and memory of ours move from the first albedo to the last, one sentence a kind of field."""
    found = []
    for kind in dict.fromkeys(row["fields"] for row in rows if row["method"] == "ours"):
        ours = [row for row in rows if row["method"] == "ours" and row["fields"] == kind]
        name = f"ours, {kind}, albedo {ours[0]['albedo']:g} to {ours[-1]['albedo']:g}"
        if any(row["ms"] is None for row in ours):
            found.append(f"{name}: not all steps could be measured")
            continue
        ratios = {what: ours[-1][key] / ours[0][key] for what, key in (("time", "ms"), ("peak memory", "peak_mib"))}
        kept = all(abs(ratio - 1.0) <= BAR for ratio in ratios.values())
        figures = ", ".join(f"{what} x {ratio:.3f}" for what, ratio in ratios.items())
        spread = max(row["ms"] for row in ours) / min(row["ms"] for row in ours)
        found.append(
            f"{name}: {figures} (bar: within {BAR:.0%}: {'met' if kept else 'MISSED'}); slowest over fastest albedo "
            f"x {spread:.3f}"
        )
    return found


def ratios(rows: Sequence[dict[str, Any]]) -> list[str]:
    """How many times longer Mitsuba's step takes than ours with dense grids, one sentence an albedo."""
    ours = {row["albedo"]: row["ms"] for row in rows if (row["method"], row["fields"]) == ("ours", "dense")}
    return [
        f"mitsuba over ours, albedo {row['albedo']:g}: x {row['ms'] / ours[row['albedo']]:.2f}"
        for row in rows
        if row["method"] == "mitsuba" and row["ms"] and ours.get(row["albedo"])
    ]


def _report(rows: list[dict[str, Any]], options: argparse.Namespace) -> None:
    # Not before the last child has ended: on Linux a child begins with the peak memory of its parent.
    from benchmarks.bench.machine import describe, pick_device, report

    title = (
        f"\none training step of {options.pixels} pixels x {options.spp} samples on "
        f"{describe(pick_device(options.device))}: median of the steps, their quartiles, peak memory of the process "
        f"and how much of it the steps added"
    )
    report(rows, title, str(options.out))
    for sentence in verdicts(rows) + ratios(rows):
        print(f"neurad: {sentence}")
