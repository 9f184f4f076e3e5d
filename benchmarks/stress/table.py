"""The table of ``neurad stress``: on the screen, as CSV and as Markdown."""

from collections.abc import Sequence
from dataclasses import asdict, fields
from pathlib import Path

from benchmarks.stress.case import Row
from neurad.runtime import tables
from neurad.runtime.files import write_text

COLUMNS = tuple(f.name for f in fields(Row))
_EXTREME = 52  # characters of a line on the screen


def heading() -> str:
    """The first line on the screen."""
    return f"{'verdict':<8}{'error':>10}{'bar':>9}{'seconds':>9}  {'what is extreme':<{_EXTREME}}  oracle"


def line(row: Row) -> str:
    """A row on the screen, its note below it."""
    text = (
        f"{row.verdict:<8}{_number(row.error):>10}{_number(row.bar):>9}{row.seconds:>9.1f}  "
        f"{row.family + ': ' + row.extreme:<{_EXTREME}}  {row.oracle}"
    )
    return f"{text}\n{'':<36}  {row.note}" if row.note else text


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """All rows, one a line."""
    tables.write_csv(path, COLUMNS, [asdict(row) for row in rows])


def write_markdown(path: Path, rows: Sequence[Row], title: str) -> None:
    """All rows as one Markdown table."""
    body = (
        (row.family, row.extreme, row.oracle, _number(row.error), _number(row.bar), f"{row.seconds:.1f}", row.verdict,
         row.note)
        for row in rows
    )  # fmt: skip
    lines = tables.markdown(COLUMNS, body, left=COLUMNS)
    write_text(path, "\n".join([f"# {title}", "", *lines]) + "\n")


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
