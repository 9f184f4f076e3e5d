"""Scores against cost: the numbers behind the curves, and the charts of a page."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np

from neurad.callbacks.report import DASHES as MARK_DASHES
from neurad.compare.runs import Run, by_method, full_name, marks
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray
from neurad.pages.chart import MIN_JOINED, PALE, Line, chart
from neurad.runtime import tables

COLOURS = {
    "ours": "#0072b2",
    "no_prior": "#e69f00",
    "direct": "#cc79a7",
    "path": "#009e73",
    "prb": "#d55e00",
    "debiased": "#56b4e9",
    "blend": "#8a5ec2",
}
"""Okabe and Ito's palette: distinct to colour-blind readers too."""
FURTHER = ("#c23b6b", "#8c6d31", "#7b4ab8", "#7f7f7f", "#b3b300", "#00a3a3")
AXES = {
    "seconds": "training time / s", "processor_seconds": "processor time / s", "iteration": "iterations",
    "samples": "path samples",
}  # fmt: skip
POINTS = 64
"""Places at which the curves of several seeds are compared."""


@dataclass(frozen=True)
class Panel:
    """One score against cost."""

    score: str
    """Column of ``metrics.csv``, and of the table."""
    title: str
    unit: str
    better: str
    """Which way is better."""
    row: int


PANELS = (
    *(Panel(f"{x}_psnr", x.capitalize(), "PSNR in dB", "higher is better", 0) for x in RECOVERED),
    Panel("psnr_srgb", "Picture (sRGB)", "PSNR in dB", "higher is better", 0),
    *(Panel(f"{x}_mape", x.capitalize(), "MAPE", "lower is better", 1) for x in RECOVERED),
    Panel("lamp_error", "Worst lamp", "relative error", "lower is better", 2),
)
"""The first row is what a page shows first."""


def colours(methods: Sequence[str]) -> list[str]:
    """One fixed colour a method; methods without one get the next of :data:`FURTHER`."""
    spare = cycle(FURTHER)
    return [COLOURS.get(method) or next(spare) for method in methods]


def write_csv(path: Path, runs: Sequence[Run]) -> None:
    """Every evaluation of every run: method, seed, then all columns of ``metrics.csv``."""
    computed = ["samples"] if any("samples" in run.last for run in runs) else []
    names = dict.fromkeys([*(name for run in runs for name in run.columns), *computed])
    rows: Iterator[tables.Record] = (
        {"method": run.method, "seed": run.seed, **row} for run in runs for row in run.rows
    )
    tables.write_csv(path, ["method", "seed", *names], rows)


def curve(run: Run, axis: str, panel: Panel) -> tuple[FloatArray, FloatArray]:
    """Positions on ``axis``, one of :data:`AXES`, and scores [n], those that can be drawn."""
    pairs = [(row[axis], row[panel.score]) for row in run.rows if axis in row and panel.score in row]
    kept = np.array([(x, y) for x, y in pairs if x > 0 and np.isfinite(y)], np.float32).reshape(-1, 2)
    return kept[:, 0], kept[:, 1]


def band(curves: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Positions, median, least and largest score [POINTS] of several seeds, where all of them have been measured."""
    begin, end = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    at = np.geomspace(begin, max(begin, end), POINTS)
    values = np.stack([np.interp(np.log(at), np.log(x), y) for x, y in curves])
    middle, low, high = (f(values, axis=0).astype(np.float32) for f in (np.median, np.min, np.max))
    return at.astype(np.float32), middle, low, high


def charts(runs: Sequence[Run], axis: str, row: int) -> str:
    """The charts of a row of :data:`PANELS` against ``axis``, for a page; empty where there is nothing to draw."""
    drawn = []
    for panel in (panel for panel in PANELS if panel.row == row):
        lines = lines_of(runs, axis, panel)
        drawn.append(chart(f"{panel.title}, {panel.unit}", panel.better, AXES[axis], lines))
    return "".join(drawn)


def lines_of(runs: Sequence[Run], axis: str, panel: Panel) -> list[Line]:
    """What a chart shows: of each method a band over its seeds where all have been measured at common places, else a
    curve for each; then levels that need no fit.
    """
    lines = []
    groups = by_method(runs)
    for (method, group), colour in zip(groups.items(), colours(list(groups)), strict=True):
        found = [pair for pair in (curve(run, axis, panel) for run in group) if len(pair[0])]
        common = len(found) > 1 and max(x[0] for x, _ in found) < min(x[-1] for x, _ in found)
        if common and min(len(x) for x, _ in found) >= MIN_JOINED:
            x, y, low, high = band(found)
            lines.append(Line(full_name(method), x, y, colour, low=low, high=high))
        else:
            lines += [Line(full_name(method), x, y, colour) for x, y in found]
    for label, scores in marks(runs).items():
        if panel.score in scores:
            level = np.array([scores[panel.score]], np.float32)
            lines.append(Line(label, np.zeros(0, np.float32), level, PALE, MARK_DASHES[label]))
    return lines
