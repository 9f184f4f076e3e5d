"""Tables: CSV files that are replaced as a whole or grow by whole rows, and aligned or Markdown text.

Imports nothing heavy: the parent process of a comparison reads tables too, and its memory counts for its children.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

Cell = str | int | float | None
Record = Mapping[str, Cell]

COUNTS = ("iteration", "rays", "samples", "seeds")
"""Columns of whole numbers."""


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Record]) -> None:
    """Write a table: a header, then a line a row. A reader sees the old file or the new one, never a part of it.

    Args:
        path: the file; its folder exists.
        columns: names, in order.
        rows: cells by column; a missing one and None stay empty, floats get seven digits.

    Raises:
        OSError: the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_text(name, row.get(name)) for name in columns] for row in rows)
    replace_text(path, out.getvalue())


def append_csv(path: Path, columns: Sequence[str], row: Record) -> None:
    """Add a row at the end of a table, under the columns of its header; ``columns`` is the header of a new table.

    Raises:
        OSError: the file cannot be written.
    """
    header = read_header(path)
    if not header:
        write_csv(path, columns, [row])
        return
    with path.open("a", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow([_text(name, row.get(name)) for name in header])


def read_header(path: Path) -> list[str]:
    """The columns of a table; none if there is no file."""
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return next(csv.reader(file), [])


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a table; nothing if there is no file.

    A line with too few or too many cells is left out: a process that is killed while it writes leaves a short one.
    """
    if not path.is_file():
        return [], []
    reader = csv.DictReader(io.StringIO(path.read_text()))
    whole = [row for row in reader if None not in row and None not in row.values()]
    return list(reader.fieldnames or []), whole


def numbers(row: Mapping[str, str]) -> dict[str, float]:
    """The cells of a row as numbers; empty ones are left out.

    Raises:
        ValueError: a cell is not a number.
    """
    return {name: float(text) for name, text in row.items() if text != ""}


def replace_text(path: Path, text: str) -> None:
    """Write a text file beside its place and move it there."""
    part = path.with_name(path.name + ".part")
    part.write_text(text, newline="")
    os.replace(part, path)


def align(body: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """Rows of cells as lines of equal columns, those with the numbers ``left`` flush left, the others flush right."""
    widths = [max(len(row[i]) for row in body) for i in range(len(body[0]))]
    return [
        "  ".join(
            cell.ljust(width) if i in left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in body
    ]


def markdown(columns: Sequence[str], body: Iterable[Sequence[str]], left: Collection[str]) -> list[str]:
    """Lines of a Markdown table, the columns ``left`` flush left, the others flush right."""
    rule = "".join("---|" if name in left else "---:|" for name in columns)
    rows = ("| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in [columns, *body])
    return [next(rows), "|" + rule, *rows]


def _text(name: str, value: Cell) -> str:
    """A cell as it is stored."""
    if value is None or isinstance(value, str):
        return value or ""
    if name in COUNTS:
        return str(int(value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)
