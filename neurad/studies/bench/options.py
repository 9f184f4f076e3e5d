"""Options that benchmarks share; imports nothing heavy, so that help answers at once."""

from __future__ import annotations

import argparse


def add_settings(parser: argparse.ArgumentParser, default: str = "kitchen.yaml") -> None:
    """Declare ``--config`` and ``--set``."""
    parser.add_argument(
        "--config", action="append", metavar="NAME.yaml", help=f"config, may be repeated as for fit (default {default})"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, e.g. model.sampling.spp=4"
    )
    parser.set_defaults(default_config=default)
