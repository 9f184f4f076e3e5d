"""``neurad stress``: stiff and extreme cases against oracles, one row a case."""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

from neurad.studies.stress import FAMILIES, collect


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options of the verb."""
    parser.add_argument("--quick", action="store_true", help="the short form: under two minutes")
    parser.add_argument("--only", help=f"families to run, separated by commas: {', '.join(FAMILIES)}")
    parser.add_argument(
        "--scenes", type=Path, help="folder of scene folders; each gets a row of the family features (not in --quick)"
    )
    parser.add_argument("--out", type=Path, default=Path("."), help="folder for stress.csv and stress.md (default: .)")
    parser.add_argument("--overwrite", action="store_true", help="write over tables that are there")


def run(options: argparse.Namespace) -> None:
    """Run the cases, print a row each, write both tables.

    Raises:
        InputError: an unknown family, no scene folder in ``--scenes``, or a table that would be overwritten.
        SystemExit: with 1 if a row fails.
    """
    from neurad.core.errors import InputError

    only = None if options.only is None else [name.strip() for name in options.only.split(",")]
    for name in only or []:
        if name not in FAMILIES:
            raise InputError(f"--only: {name} is no family of cases, there are {', '.join(FAMILIES)}")
    paths = options.out / "stress.csv", options.out / "stress.md"
    if not options.overwrite and (found := [path for path in paths if path.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")
    options.out.mkdir(parents=True, exist_ok=True)

    from neurad.studies.stress.case import judge
    from neurad.studies.stress.table import heading, line, write_csv, write_markdown

    cases = collect(only)
    if options.scenes is not None:
        from neurad.studies.stress.features import folders

        cases += folders(options.scenes)
    begin = time.perf_counter()
    rows = []
    print(heading(), flush=True)
    for case in cases:
        if options.quick and not case.quick:
            continue
        rows.append(judge(case, options.quick))
        print(line(rows[-1]), flush=True)
        write_csv(paths[0], rows)  # after each row, so that an interrupted run leaves what it found
    form = "quick" if options.quick else "full"
    failed = sum(row.verdict == "FAIL" for row in rows)
    spent = time.perf_counter() - begin
    write_markdown(paths[1], rows, f"neurad stress ({form}): {len(rows)} rows, {failed} failed")
    print(f"\n{len(rows)} rows, {failed} failed, {spent:.0f} s on {os.cpu_count()} cores; {paths[0]}, {paths[1]}")
    if options.scenes is None and not options.quick and (only is None or "features" in only):
        print("scene folders were left out: --scenes DIR names the folder that has them")
    if failed:
        raise SystemExit(1)
