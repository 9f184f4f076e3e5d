"""The whole of ``neurad stress``: choose cases, run them, print a row each, write the table."""

import argparse
import os
import time

from benchmarks.stress import faults, features, numbers, precision, stiff, surfaces
from benchmarks.stress.case import Case, judge
from neurad.core.errors import InputError
from neurad.core.suggest import did_you_mean
from neurad.runtime.files import check_folder, make_folder
from neurad.runtime.progress import phase
from neurad.runtime.tables import Cell, write_csv

CASES = {
    "stiff": stiff.cases,
    "surfaces": surfaces.cases,
    "precision": precision.cases,
    "numbers": numbers.cases,
    "faults": faults.cases,
    "features": features.cases,
}
"""By family."""
_EXTREME = 52  # characters of a line on the screen


def collect(only: list[str] | None = None) -> list[Case]:
    """The cases of the named families, or all of them.

    Raises:
        InputError: there is no such family.
    """
    for name in only or []:
        if name not in CASES:
            near = did_you_mean(name, CASES)
            raise InputError(f"--only: {name} is no family of cases, there are {', '.join(CASES)}{near}")
    return [case for name in (CASES if only is None else only) for case in CASES[name]()]


def stress(options: argparse.Namespace) -> None:
    """Run the cases that the verb's options choose.

    Raises:
        InputError: an unknown family, or a table that would be overwritten.
        SystemExit: with 1 if a row fails.
    """
    cases = collect(None if options.only is None else [name.strip() for name in options.only.split(",")])
    table = options.out / "stress.csv"
    if not options.overwrite and table.exists():
        raise InputError(f"--out: {table} is there already; add --overwrite to write over it")
    check_folder(options.out, "--out")
    make_folder(options.out, "--out")
    begin = time.perf_counter()
    rows: list[dict[str, Cell]] = []
    print(f"{'verdict':<8}{'error':>10}{'bar':>9}{'seconds':>9}  {'what is extreme':<{_EXTREME}}  oracle", flush=True)
    chosen = [case for case in cases if case.quick or not options.quick]
    with phase("stress", len(chosen), covers=True) as running:
        for case in chosen:
            running.detail = f"{case.family}: {case.extreme}"
            rows.append(judge(case, options.quick))
            running.step()
            print(_line(rows[-1]), flush=True)
            write_csv(table, list(rows[0]), rows)  # after each row, so that an interrupted run leaves what it found
    failed = sum(row["verdict"] == "FAIL" for row in rows)
    spent = time.perf_counter() - begin
    print(f"\n{len(rows)} rows, {failed} failed, {spent:.0f} s on {os.cpu_count()} cores; {table}")
    if failed:
        raise SystemExit(1)


def _line(row: dict[str, Cell]) -> str:
    """A row on the screen, its note below it."""
    error, bar = ("" if row[key] is None else f"{row[key]:.3g}" for key in ("error", "bar"))
    what = f"{row['family']}: {row['extreme']}"
    text = f"{row['verdict']:<8}{error:>10}{bar:>9}{row['seconds']:>9.1f}  {what:<{_EXTREME}}  {row['oracle']}"
    return f"{text}\n{'':<36}  {row['note']}" if row["note"] else text
