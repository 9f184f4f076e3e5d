"""Options of several benchmarks; imports nothing heavy, so that help answers at once."""

import argparse

from neurad.core.ranges import Count, CountOrZero, option

SMALL_FIELDS = tuple(
    f"--model.{part}.{key}={value}"
    for part in ("albedo", "roughness", "radiance")
    for key, value in {"grid.levels": 2, "grid.coarsest": 4, "grid.finest": 8, "grid.log2_size": 8, "width": 8}.items()
)
"""Settings of a fit whose fields have a few cells."""


def add_settings(parser: argparse.ArgumentParser, default: str = "patterns.yaml") -> None:
    """Declare ``--config`` and ``--set``."""
    parser.add_argument(
        "--config", action="append", metavar="NAME.yaml", help=f"config, may be repeated as for fit (default {default})"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, e.g. model.sampling.spp=4"
    )
    parser.set_defaults(default_config=default)


def add_timing(parser: argparse.ArgumentParser, steps: int, warmup: int) -> None:
    """Declare ``--steps`` and ``--warmup`` with these defaults, ``--device`` and ``--out``."""
    parser.add_argument("--steps", type=option(Count), default=steps, help="steps that count")
    parser.add_argument("--warmup", type=option(CountOrZero), default=warmup, help="steps before them")
    parser.add_argument("--device", default="auto", help="cpu, cuda or auto")
    parser.add_argument("--out", metavar="FILE.csv", help="write the table here too")
