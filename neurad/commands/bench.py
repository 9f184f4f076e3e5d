"""``neurad bench``: what a step costs, what methods cost, and what a peer needs; one file a benchmark."""

from __future__ import annotations

import argparse
import importlib

BENCHMARKS: dict[str, str] = {
    "step": "time the stages of a training step, against what the machine allows",
    "encode": "time hash grids, dense grids and networks, against what the machine allows",
    "trace": "time every ray caster that is installed, by kind of ray and size of batch",
    "growth": "time and memory against triangles, views, resolution and table size",
    "ceiling": "fit the material fields to the true maps: what no fit to photographs can be expected to beat",
    "peer": "race Mitsuba 3's path replay backpropagation to a given albedo error, on this machine",
    "cube": "time and memory of a step against albedo, for ours, path replay and differentiated path tracing",
    "gradients": "bias of gradient images and of the loss's gradient, against long paths and a closed form",
}
"""Name of a benchmark (its module here has ``add_arguments(parser)`` and ``run(options)``): what it shows."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare every benchmark and its options."""
    parsers = parser.add_subparsers(dest="benchmark", required=True, metavar="BENCHMARK")
    for name, text in BENCHMARKS.items():
        child = parsers.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
        importlib.import_module(f"neurad.studies.bench.{name}").add_arguments(child)


def run(options: argparse.Namespace) -> None:
    """Run the benchmark that was asked for.

    Raises:
        InputError: the user's mistake, in one sentence.
    """
    importlib.import_module(f"neurad.studies.bench.{options.benchmark}").run(options)
