"""``neurad bench``: what a step costs, what methods cost, and what a peer needs; one file a benchmark."""

from __future__ import annotations

import argparse
import importlib

BENCHMARKS: dict[str, str] = {}
"""Name of a benchmark (its module in this package has ``add_arguments(parser)`` and ``run(options)``): what it shows."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare every benchmark and its options."""
    parsers = parser.add_subparsers(dest="benchmark", required=True, metavar="BENCHMARK")
    for name, text in BENCHMARKS.items():
        child = parsers.add_parser(name, help=text, description=text[:1].upper() + text[1:] + ".")
        importlib.import_module(f"neurad.commands.bench.{name}").add_arguments(child)


def run(options: argparse.Namespace) -> None:
    """Run the benchmark that was asked for.

    Raises:
        InputError: the user's mistake, in one sentence.
    """
    importlib.import_module(f"neurad.commands.bench.{options.benchmark}").run(options)
