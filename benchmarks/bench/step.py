"""``neurad bench step``: what the stages of a training step cost, against what the machine allows."""

import argparse
from typing import Any


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
    from benchmarks.bench.machine import describe, report
    from benchmarks.bench.measure import measure_step

    found = measure_step(options, options.steps, options.warmup)
    device: Any = found.device
    rates = found.rates
    title = (
        f"training step on {describe(device)}: {found.milliseconds:.1f} ms a step, "
        f"{found.rays / found.milliseconds / 1e3:.2f} million rays/s, "
        f"{found.samples / found.milliseconds / 1e3:.3f} million samples/s, peak memory {found.peak / 2**30:.2f} GiB\n"
        f"(machine: {rates['closest'] / 1e6:.2f} million rays/s nearest, {rates['shadow'] / 1e6:.2f} shadow, "
        f"{rates['matrix'] / 1e9:.1f} GFLOP/s, {rates['bandwidth'] / 1e9:.1f} GB/s)"
    )
    report(found.rows, title, options.out)
