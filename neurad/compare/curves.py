"""Scores against cost: the numbers behind the curves, and the charts of a page."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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


def colours(methods: Sequence[str]) -> dict[str, str]:
    """One fixed colour a method; methods without one get the next of :data:`FURTHER`."""
    spare = iter(FURTHER * (len(methods) // len(FURTHER) + 1))
    return {method: COLOURS.get(method) or next(spare) for method in methods}


def write_csv(path: Path, runs: Sequence[Run]) -> None:
    """Every evaluation of every run: method, seed, then all columns of ``metrics.csv``."""
    names: list[str] = []
    for run in runs:
        names += [name for name in run.columns if name not in names]
    if "samples" not in names and any("samples" in run.last for run in runs):
        names.append("samples")
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
    groups, levels = by_method(runs), marks(runs)
    palette = colours(list(groups))
    drawn = []
    for panel in (panel for panel in PANELS if panel.row == row):
        lines: list[Line] = []
        for method, group in groups.items():
            for x, y, low, high in lines_of(group, axis, panel):
                lines.append(Line(full_name(method), x, y, palette[method], low=low, high=high))
        for label, scores in levels.items():
            if panel.score in scores:
                level = np.array([scores[panel.score]], np.float32)
                lines.append(Line(label, np.zeros(0, np.float32), level, PALE, MARK_DASHES[label]))
        drawn.append(chart(f"{panel.title}, {panel.unit}", panel.better, AXES[axis], lines))
    return "".join(drawn)


def lines_of(
    group: Sequence[Run], axis: str, panel: Panel
) -> list[tuple[FloatArray, FloatArray, FloatArray | None, FloatArray | None]]:
    """What is drawn of the seeds of a method: positions, scores [n] and the edges of a band, or one curve a seed."""
    found = [pair for pair in (curve(run, axis, panel) for run in group) if len(pair[0])]
    return [band(found)] if is_band(found) else [(x, y, None, None) for x, y in found]


def is_band(curves: Sequence[tuple[FloatArray, FloatArray]]) -> bool:
    """Whether several seeds have been measured at common places."""
    return (
        len(curves) > 1
        and min(len(x) for x, _ in curves) >= MIN_JOINED
        and max(x[0] for x, _ in curves) < min(x[-1] for x, _ in curves)
    )
