"""``neurad bench``: what a step costs, what methods cost, and what a peer needs; one file a benchmark."""

import argparse

from benchmarks.bench import bound, capture, ceiling, cube, gradients, growth, memory, peer, start, step
from neurad.commands import Verb
from neurad.runtime.files import check_file, check_folder

BENCHMARKS: dict[str, tuple[Verb, str]] = {
    "step": (step, "time the stages of a training step"),
    "start": (start, "time what a fit does before its first step, imports included"),
    "growth": (growth, "time and memory against triangles, views, resolution and table size"),
    "memory": (memory, "whether the memory of a fit of 20 000 steps grows"),
    "ceiling": (
        ceiling,
        "fit the material fields to the true maps: what a fit to photographs is not expected to beat",
    ),
    "bound": (
        bound,
        "how far a fit is from the best possible: resolution, noise, and the fit itself",
    ),
    "capture": (capture, "what errors of poses, mesh and photographs cost, in dB of the recovered materials"),
    "peer": (peer, "race Mitsuba 3's path replay backpropagation to a given albedo error, on this machine"),
    "cube": (cube, "time and memory of a step against albedo, for ours, path replay and differentiated path tracing"),
    "gradients": (
        gradients,
        "bias of each method's gradient, against closed forms",
    ),
}
"""Benchmarks by name, and what each shows."""
FOLDERS = ("peer",)
"""Those whose ``--out`` is a folder; that of the others is a file."""
WORKERS = {"cube-worker": cube.work, "peer-worker": peer.work}
"""What the child processes of a benchmark run, given one JSON text; not listed in the help."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare every benchmark and its options."""
    parsers = parser.add_subparsers(dest="benchmark", required=True, metavar="BENCHMARK")
    for name, (benchmark, text) in BENCHMARKS.items():
        child = parsers.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
        benchmark.add_arguments(child)
    for name in WORKERS:
        parsers.add_parser(name).add_argument("job")


def run(options: argparse.Namespace) -> None:
    """Run the chosen benchmark.

    Raises:
        InputError: the user's mistake, in one sentence.
    """
    if options.benchmark in WORKERS:
        WORKERS[options.benchmark](options.job)
    else:
        if (out := getattr(options, "out", None)) is not None:
            (check_folder if options.benchmark in FOLDERS else check_file)(out, "--out")
        BENCHMARKS[options.benchmark][0].run(options)
