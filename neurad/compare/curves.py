"""Scores against cost: the numbers behind the curves, the charts of a page, and figures as a paper takes them: of the
width of its text, in its size of letters, as PDF, SVG and PNG.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurad.callbacks.report import DASHES as MARK_DASHES
from neurad.compare.runs import Run, by_method, full_name, marks
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray
from neurad.metrics.marks import CONSTANT, LOOKUP
from neurad.pages.chart import MIN_JOINED, PALE, Line, chart, new_figure, plain_ticks
from neurad.runtime import tables
from neurad.runtime.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
WIDTH = 7.0
"""Inches of a page's text in two columns."""
STYLE: Any = {
    "font.family": "STIXGeneral", "mathtext.fontset": "stix", "font.size": 8, "axes.titlesize": 8, "axes.labelsize": 8,
    "xtick.labelsize": 7, "ytick.labelsize": 7, "legend.fontsize": 8, "axes.linewidth": 0.6, "lines.linewidth": 1.2,
    "xtick.major.width": 0.6, "ytick.major.width": 0.6, "pdf.fonttype": 42, "svg.hashsalt": "neurad",
}  # fmt: skip
"""Letters that go with Times and Libertine, embedded as TrueType."""
DPI = 250
DASHES = {CONSTANT: (0, (4, 3)), LOOKUP: (0, (1, 2))}
"""How lines are dashed that need no fit."""
FIGURES = {"curves_psnr": (0,), "curves_mape": (1, 2)}
"""Files, and the rows of :data:`PANELS` in them."""


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


def write_curves(folder: Path, runs: Sequence[Run]) -> None:
    """Draw scores against processor time and iterations, a row of panels each, with the methods' names below.

    Seeds of a method are a band from the lowest score to the highest around their median. Where a run has no processor
    time, as other programs' have not, the time of the clock takes its place.
    """
    import matplotlib
    from matplotlib.lines import Line2D

    time = "processor_seconds" if all("processor_seconds" in run.last for run in runs if run.rows) else "seconds"
    for name, rows in FIGURES.items():
        panels = [panel for panel in PANELS if panel.row in rows and _is_drawn(runs, "seconds", panel)]
        axes = [axis for axis in (time, "iteration") if any(_is_drawn(runs, axis, panel) for panel in panels)]
        if not panels:
            continue
        with matplotlib.rc_context(STYLE):
            page = new_figure(WIDTH * max(len(panels), 2) / 3, 1.55 * len(axes) + 0.6)
            cells = page.subplots(len(axes), len(panels), squeeze=False, sharey="col")
            entries: dict[str, Any] = {}
            for axis, cells_of_axis in zip(axes, cells, strict=True):
                for panel, ax in zip(panels, cells_of_axis, strict=True):
                    for line in lines_of(runs, axis, panel):
                        if len(line.x):
                            _draw(ax, line)
                            entries[line.label] = Line2D([], [], color=line.colour)
                        elif np.isfinite(line.y).all():
                            dash: dict[str, Any] = {"color": line.colour, "lw": 0.9, "ls": DASHES[line.label]}
                            ax.axhline(float(line.y[0]), zorder=1, **dash)
                            entries[line.label] = Line2D([], [], **dash)
                    _dress(ax, axis, panel)
                    if axis == axes[0]:
                        ax.set_title(panel.title)
            widest = max(map(len, entries))
            columns = max(1, min(len(entries), int(page.get_figwidth() / (0.055 * widest + 0.5))))
            page.legend(entries.values(), entries, loc="outside lower center", ncols=columns, frameon=False)
            save(page, folder / name)


def save(page: Figure, stem: Path) -> None:
    """Write a figure as PDF, SVG and PNG; equal figures make equal files."""
    page.draw_without_rendering()
    page.set_layout_engine("none")  # as it is now, for all three
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}
    for suffix, metadata in undated.items():
        with replacing(stem.with_suffix(f".{suffix}")) as part:
            page.savefig(part, format=suffix, dpi=DPI, metadata=metadata)


def _is_drawn(runs: Sequence[Run], axis: str, panel: Panel) -> bool:
    return any(len(curve(run, axis, panel)[0]) for run in runs)


def _draw(ax: Axes, line: Line) -> None:
    if line.low is not None and line.high is not None:
        ax.fill_between(line.x, line.low, line.high, color=line.colour, alpha=0.2, lw=0)
    joined = len(line.x) >= MIN_JOINED
    ax.plot(line.x, line.y, color=line.colour, ls="-" if joined else "none", marker="" if joined else "o", ms=3.5)


def _dress(ax: Axes, axis: str, panel: Panel) -> None:
    """A logarithmic axis of cost, labels, a faint grid."""
    arrow = "\u2191" if panel.better.startswith("higher") else "\u2193"
    ax.set(xscale="log", xlabel=AXES[axis], ylabel=f"{panel.unit.replace(' in ', ' / ')} {arrow}")
    plain_ticks(ax)
    ax.grid(True, color="#dddddd", lw=0.4)
