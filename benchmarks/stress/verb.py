"""``neurad stress``: stiff and extreme cases against oracles, one row a case."""

import argparse
from pathlib import Path

FAMILIES = ("stiff", "surfaces", "precision", "numbers", "faults", "features")
"""Named as the modules with their cases, which import torch: ``neurad stress -h`` is fast without."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--quick", action="store_true", help="the short form: under two minutes")
    parser.add_argument("--only", help=f"families to run, separated by commas: {', '.join(FAMILIES)}")
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for stress.csv (default: .)")
    parser.add_argument("--overwrite", action="store_true", help="write over a table that is there")


def run(options: argparse.Namespace) -> None:
    """Run the cases, print a row each, write the table.

    Raises:
        InputError: an unknown family, or a table that would be overwritten.
        SystemExit: with 1 if a row fails.
    """
    from benchmarks.stress.run import stress

    stress(options)
