"""``neurad bench step``: what the stages of a training step cost."""

import argparse


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    from benchmarks.bench.options import add_settings, add_timing

    add_settings(parser)
    add_timing(parser, steps=100, warmup=30)


def run(options: argparse.Namespace) -> None:
    """Train a little and print the table.

    Raises:
        InputError: the settings are wrong.
    """
    from benchmarks.bench.machine import report
    from benchmarks.bench.measure import measure_step

    title, rows = measure_step(options)
    report(rows, title, options.out)
