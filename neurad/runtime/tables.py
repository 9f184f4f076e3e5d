"""Tables: CSV files that are replaced as a whole or grow by whole rows, and aligned or Markdown text.

Imports nothing heavy: the parent process of a comparison reads tables too, and its memory counts for its children.
"""

import csv
import io
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from neurad.core.decibels import EXACT, parsed
from neurad.core.errors import InputError
from neurad.runtime.files import append, write_text
from neurad.runtime.reading import exists, regular_file

Cell = str | int | float | None
Record = Mapping[str, Cell]

COUNTS = ("iteration", "iterations", "rays", "samples", "seeds")
"""Columns of whole numbers."""


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Record]) -> None:
    """Write a table: a header, then a line a row. A reader sees the old file or the new one, never a part of it.

    Missing cells and None stay empty, floats get seven digits, infinity is called exact.

    Raises:
        InputError: the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_text(name, row.get(name)) for name in columns] for row in rows)
    write_text(path, out.getvalue())


def append_csv(path: Path, columns: Sequence[str], row: Record) -> None:
    """Add a row at the end of a table, under the columns of its header; ``columns`` is the header of a new table.

    Raises:
        InputError: the file cannot be written, or what is there is no table.
    """
    header = next(csv.reader(io.StringIO(read_lines(path, 1))), [])
    if not header:
        write_csv(path, columns, [row])
        return
    line = io.StringIO()
    csv.writer(line, lineterminator="\n").writerow([_text(name, row.get(name)) for name in header])
    append(path, line.getvalue().encode())


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Columns and rows of a table; nothing if there is no file.

    A line with too few or too many cells is left out: a process that is killed while it writes leaves a short one.
    """
    reader = csv.DictReader(io.StringIO(read_lines(path)))
    try:
        whole = [row for row in reader if None not in row and None not in row.values()]
    except csv.Error as error:
        raise _no_table(path, reader.line_num) from error
    return list(reader.fieldnames or []), whole


def read_lines(path: Path, count: int = -1) -> str:
    """The text of a table, or its first ``count`` lines; nothing if there is no file.

    Raises:
        InputError: the file cannot be read, or has bytes that belong to no text.
    """
    if not exists(path):
        return ""
    try:
        with regular_file(path).open("rb") as file:
            lines = file.readlines() if count < 0 else [file.readline() for _ in range(count)]
    except OSError as error:
        raise InputError(f"{path}: it cannot be read ({error.strerror})") from error
    for number, line in enumerate(lines, 1):
        try:
            is_text = "\0" not in line.decode()
        except UnicodeDecodeError:
            is_text = False
        if not is_text:
            raise _no_table(path, number)
    return b"".join(lines).decode()


def _no_table(path: Path, line: int) -> InputError:
    return InputError(f"{path}: line {line} is not the text of a table; repair the file, or move it away")


def read_numbers(path: Path, needed: Collection[str]) -> tuple[list[str], list[dict[str, float]]]:
    """Columns and rows of a table of :func:`numbers`; nothing if there is no file, or an empty one.

    Raises:
        InputError: it lacks one of the columns ``needed``, or a cell is not a number.
    """
    columns, rows = read_csv(path)
    try:
        if columns and not set(needed) <= set(columns):
            raise ValueError(f"it has no columns {' and '.join(needed)}")
        return columns, [numbers(row) for row in rows]
    except ValueError as error:
        raise InputError(f"{path}: {error}; repair it, or move it away") from error


def numbers(row: Mapping[str, str]) -> dict[str, float]:
    """The cells of a row as numbers; empty ones are left out.

    Raises:
        ValueError: a cell is not a number.
    """
    return {name: parsed(text) for name, text in row.items() if text != ""}


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
    if value == math.inf:
        return EXACT
    if name in COUNTS:
        return str(int(value))
    return f"{value:.7g}" if isinstance(value, float) else str(value)
