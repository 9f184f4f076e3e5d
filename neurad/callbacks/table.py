"""``metrics.csv``, one row an evaluation, and ``lamps.csv``; and the tables printed at the end of a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from neurad.core.decibels import figure
from neurad.core.errors import InputError
from neurad.core.parameters import RECOVERED
from neurad.lamps import unknown
from neurad.lamps.scores import ERROR, columns_of
from neurad.metrics.marks import MARKS
from neurad.runtime.files import write_text
from neurad.runtime.tables import align, append_csv, read_lines, read_numbers, write_csv

if TYPE_CHECKING:
    from neurad.training.inverse import InverseRenderer

SCORES = ("psnr_linear", "psnr_srgb", *(f"{name}_{score}" for name in RECOVERED for score in ("psnr", "mape")))
COLUMNS = ("iteration", "seconds", "processor_seconds", "rays", "samples", *SCORES, *(f"{s}_seen" for s in SCORES))
HEADINGS = {
    "": "",
    "albedo_psnr": "albedo PSNR",
    "albedo_psnr_8x8": "8x8",
    "albedo_mape": "MAPE",
    **{
        f"{name}_{score}": heading
        for name in RECOVERED[1:]
        for score, heading in (("psnr", f"{name} PSNR"), ("mape", "MAPE"))
    },
    "psnr_srgb": "image PSNR (sRGB)",
}
LIGHT = {
    "": "",
    "albedo_psnr": "albedo PSNR",
    "albedo_mape": "MAPE",
    "environment_mape": "environment MAPE",
    "environment_mape_seen": "lit by it and seen",
    "mape_linear": "image MAPE",
    "relight_psnr_linear": "relit PSNR linear",
    "relight_mape_linear": "MAPE",
}
"""Scores that the factor between light and albedo matters for, and their headings."""
REGIONS = {
    "": "all pixels",
    "_seen": "pixels whose surface a training view sees",
    "_lit_glossy": "glossy pixels with light on them",
}
LAMP_ERRORS = {"": "error", "_scaled1": "one scale", "_scaled3": "three"}
"""Errors that the table of lamps shows, and their headings."""
Row = dict[str, float]


class MetricsTable:
    """``metrics.csv`` of a run, there or not: it grows by whole rows and can be cut back to an iteration."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def rows(self) -> list[Row]:
        """All rows that were written completely; empty cells are left out.

        Raises:
            InputError: the file is not such a table.
        """
        _, found = read_numbers(self.path, ("iteration", "seconds"))
        if not all("iteration" in row for row in found):
            raise InputError(f"{self.path}: a row has no iteration; repair it, or move it away")
        return found

    def append(self, row: Mapping[str, float]) -> None:
        """Add a row. The first row fixes the columns: :data:`COLUMNS`, then what else it has."""
        columns = [*COLUMNS, *(key for key in row if key not in COLUMNS)]
        append_csv(self.path, columns, {**row, "seconds": f"{row['seconds']:.2f}"})

    def cut(self, iteration: int) -> None:
        """Drop the rows that come after ``iteration``, and a line that was not written to its end."""
        self.rows()
        lines = read_lines(self.path).splitlines(keepends=True)
        kept = lines[:1]
        for line in lines[1:]:
            whole = line.endswith("\n") and line.count(",") == lines[0].count(",")
            if whole and float(line.partition(",")[0]) <= iteration:
                kept.append(line)
        if len(kept) != len(lines):
            write_text(self.path, "".join(kept))


def score_table(
    scores: Mapping[str, float], spp: int, label: str = "neurad", steady: bool = False, views: str = "Held-out views"
) -> str:
    """The closing table: this run beside the best constant and, for roughness, a lookup by the true colours, over all
    held-out pixels and over each of :data:`REGIONS`.

    Args:
        scores: by the names of :data:`COLUMNS`; a best constant's score has ``_constant`` before any ``_seen``.
        spp: samples per pixel of the renderings behind ``psnr_srgb``; 0 where there are none.
        steady: whether the radiance field took their noise from these renderings, where there is one.
    """
    lines = []
    for pixels, body in score_rows(scores, label).items():
        control = ", the radiance field as control variate" if steady and "psnr_lhs" in scores else ""
        rendered = f" (images rendered with {spp} samples per pixel{control})" if spp else ""
        lines += [f"{views}, {pixels}{rendered}", *align(body), ""]
    return "\n".join(lines + light_table(scores)).rstrip()


def score_rows(scores: Mapping[str, float], label: str) -> dict[str, list[list[str]]]:
    """Rows of cells, the headings first, by the pixels that they are of; see :func:`score_table`."""
    found = {}
    for suffix, pixels in REGIONS.items():
        body = [list(HEADINGS.values())]
        for row, kind in ((label, ""), *MARKS.items()):
            values = {name: scores.get(f"{name}{kind}{suffix}") for name in HEADINGS if name}
            if any(value is not None for value in values.values()):
                body.append([row, *(_score(name, value) for name, value in values.items())])
        if len(body) > 1:
            found[pixels] = _known(body)
    return found


def light_table(scores: Mapping[str, float]) -> list[str]:
    """Scores that say how well light was found, or how well materials do under another; no lines without any.

    Where both were unknown, albedo times a factor and light over it look the same; then scores after the best factor,
    one for all channels or one for each, stand beside the raw ones.
    """
    if not any(name.startswith(("environment", "relight")) or name == "albedo_psnr_scaled1" for name in scores):
        return []
    names = [name for name in LIGHT if name and name in scores]
    body = [["", *(LIGHT[name] for name in names)]]
    for label, scale in (("as found", ""), ("one scale", "_scaled1"), ("three scales", "_scaled3")):
        keys = [_scaled(name, scale) for name in names]
        if any(key in scores for key in keys):
            body.append([label, *(_score(key, scores.get(key)) for key in keys)])
    return ["Light and albedo, up to the factor between them", *align(body)]


def _scaled(name: str, scale: str) -> str:
    """Column of a score after scaling: the region stays last."""
    base = name.removesuffix("_seen")
    return f"{base}{scale}{name[len(base) :]}"


def curve_table(rows: Sequence[Row]) -> str:
    """Seconds and scores of about eight evaluations, evenly chosen, the first and the last included."""
    if not rows:
        return ""
    steps = min(8, len(rows))
    chosen = sorted({round(i * (len(rows) - 1) / max(steps - 1, 1)) for i in range(steps)})
    names = [*(f"{name}_psnr" for name in RECOVERED), "psnr_srgb"]
    body = [["seconds", "iteration", *(f"{name} PSNR" for name in RECOVERED), "image PSNR (sRGB)"]]
    for index in chosen:
        row = rows[index]
        scores = [_score(name, row.get(name)) for name in names]
        body.append([f"{row['seconds']:.0f}", str(int(row["iteration"])), *scores])
    return "\n".join(align(_known(body)))


def write_lamps(module: InverseRenderer, folder: Path | None) -> None:
    """Write ``lamps.csv`` into the run folder, where lamps are recovered."""
    found = unknown.rows(module.assembly)
    if folder is not None and found:
        write_csv(folder / "lamps.csv", unknown.COLUMNS, found)


def lamps_table(module: InverseRenderer, scores: Mapping[str, float]) -> str:
    """Lamps that were recovered, the pixels that show them and the errors of those with a truth; empty without any."""
    lines = unknown.body(module.assembly)
    names = columns_of([line[0] for line in lines[1:]])
    for kind, heading in LAMP_ERRORS.items():
        errors = [scores.get(f"{ERROR}{kind}_{name}") for name in names]
        if any(error is not None for error in errors):
            cells = [heading, *("-" if error is None else f"{100 * error:.1f} %" for error in errors)]
            lines = [[*line, cell] for line, cell in zip(lines, cells, strict=True)]
    return "\n".join(["Lamps", *align(lines)]) if lines else ""


def _known(body: list[list[str]]) -> list[list[str]]:
    """The columns that have a score in any row, below their headings."""
    kept = [column for column in zip(*body, strict=True) if any(cell != "-" for cell in column[1:])]
    return [list(row) for row in zip(*kept, strict=True)]


def _score(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if "mape" in name else figure(value)
