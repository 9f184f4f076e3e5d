"""``lamps.csv``: the lamps of a run that recovers them; and the table of them that a run ends with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from neurad.lamps.scores import ERROR, columns_of
from neurad.lamps.unknown import COLUMNS, body, rows
from neurad.runtime.tables import align, write_csv

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer

NAME = "lamps.csv"
KINDS = {"": "error", "_scaled1": "one scale", "_scaled3": "three"}
"""Errors that the table shows, and their headings."""


def write_lamps(module: InverseRenderer, folder: Path | None) -> None:
    """Write ``lamps.csv`` into the run folder, where lamps are recovered."""
    found = rows(module.assembly)
    if folder is not None and found:
        write_csv(folder / NAME, COLUMNS, found)


def lamps_table(module: InverseRenderer, scores: Mapping[str, float]) -> str:
    """Lamps that were recovered, the pixels that show them and the errors of those with a truth; empty without any."""
    lines = body(module.assembly)
    names = columns_of([line[0] for line in lines[1:]])
    for kind, heading in KINDS.items():
        errors = [scores.get(f"{ERROR}{kind}_{name}") for name in names]
        if any(error is not None for error in errors):
            cells = [heading, *("-" if error is None else f"{100 * error:.1f} %" for error in errors)]
            lines = [[*line, cell] for line, cell in zip(lines, cells, strict=True)]
    return "\n".join(["Lamps", *align(lines)]) if lines else ""
