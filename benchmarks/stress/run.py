"""The whole of ``neurad stress``: choose cases, run them, print a row each, write both tables."""

import argparse
import os
import time
from pathlib import Path

from benchmarks.stress import (
    delta,
    faults,
    features,
    guard,
    images,
    light,
    numbers,
    precision,
    shapes,
    stiff,
    surfaces,
)
from benchmarks.stress.case import Case, judge
from benchmarks.stress.families import FAMILIES
from benchmarks.stress.table import heading, line, write_csv, write_markdown
from neurad.core.errors import InputError
from neurad.core.suggest import did_you_mean
from neurad.runtime.files import check_folder, make_folder
from neurad.runtime.progress import phase

CASES = {
    "stiff": stiff.cases,
    "surfaces": surfaces.cases,
    "light": light.cases,
    "images": images.cases,
    "shapes": shapes.cases,
    "delta": delta.cases,
    "precision": precision.cases,
    "guard": guard.cases,
    "numbers": numbers.cases,
    "faults": faults.cases,
    "features": features.cases,
}
"""By family, in the order of :data:`FAMILIES`."""


def collect(only: list[str] | None = None) -> list[Case]:
    """The cases of the named families, or all of them.

    Raises:
        InputError: there is no such family.
    """
    for name in only or []:
        if name not in FAMILIES:
            near = did_you_mean(name, FAMILIES)
            raise InputError(f"--only: {name} is no family of cases, there are {', '.join(FAMILIES)}{near}")
    return [case for name in (FAMILIES if only is None else only) for case in CASES[name]()]


def stress(options: argparse.Namespace) -> None:
    """Run the cases that the verb's options choose.

    Raises:
        InputError: an unknown family, or a table that would be overwritten.
        SystemExit: with 1 if a row fails.
    """
    only = None if options.only is None else [name.strip() for name in options.only.split(",")]
    cases = collect(only)
    csv, markdown = _free(options.out, options.overwrite)
    begin = time.perf_counter()
    rows = []
    print(heading(), flush=True)
    chosen = [case for case in cases if case.quick or not options.quick]
    with phase("stress", len(chosen), covers=True) as running:
        for case in chosen:
            running.detail = f"{case.family}: {case.extreme}"
            rows.append(judge(case, options.quick))
            running.step()
            print(line(rows[-1]), flush=True)
            write_csv(csv, rows)  # after each row, so that an interrupted run leaves what it found
    form = "quick" if options.quick else "full"
    failed = sum(row.verdict == "FAIL" for row in rows)
    spent = time.perf_counter() - begin
    write_markdown(markdown, rows, f"neurad stress ({form}): {len(rows)} rows, {failed} failed")
    print(f"\n{len(rows)} rows, {failed} failed, {spent:.0f} s on {os.cpu_count()} cores; {csv}, {markdown}")
    if failed:
        raise SystemExit(1)


def _free(out: Path, overwrite: bool) -> tuple[Path, Path]:
    """The two tables to write, in a folder that exists from now on."""
    paths = out / "stress.csv", out / "stress.md"
    if not overwrite and (found := [path for path in paths if path.exists()]):
        raise InputError(f"--out: {found[0]} is there already; add --overwrite to write over it")
    check_folder(out, "--out")
    make_folder(out, "--out")
    return paths
