"""Scores against seconds and against path samples: the numbers behind the curves, and the figures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurad.callbacks.report import DASHES as MARK_DASHES
from neurad.compare.runs import Run, by_method, marks
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray
from neurad.metrics.marks import CONSTANT, LOOKUP
from neurad.pages.chart import Line, chart
from neurad.runtime import tables
from neurad.runtime.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {
    "ours": "#0072b2",
    "no_prior": "#e69f00",
    "direct": "#cc79a7",
    "path": "#009e73",
    "prb": "#d55e00",
    "debiased": "#56b4e9",
}
"""Okabe and Ito's palette: distinct to colour-blind readers too."""
FURTHER = ("#c23b6b", "#8c6d31", "#7b4ab8", "#7f7f7f", "#b3b300", "#00a3a3")
AXES = {"seconds": "training time / s", "samples": "path samples"}
DASHES = {CONSTANT: (0, (4, 3)), LOOKUP: (0, (1, 2))}
"""How lines are dashed that need no fit."""
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
    column: int


PANELS = (
    *(Panel(f"{x}_psnr", x.capitalize(), "PSNR in dB", "higher is better", 0, i) for i, x in enumerate(RECOVERED)),
    Panel("psnr_srgb", "Picture (sRGB)", "PSNR in dB", "higher is better", 0, len(RECOVERED)),
    *(Panel(f"{x}_mape", x.capitalize(), "MAPE", "lower is better", 1, i) for i, x in enumerate(RECOVERED)),
    Panel("lamp_error", "Worst lamp", "relative error", "lower is better", 2, 0),
)
"""The first row is what a page shows first; where the figure has no picture's MAPE, it has its legend."""


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
    """Positions on ``axis`` ('seconds' or 'samples') and scores [n], those that can be drawn."""
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
            found = [pair for pair in (curve(run, axis, panel) for run in group) if len(pair[0])]
            if is_band(found):
                x, middle, low, high = band(found)
                lines.append(Line(method, x, middle, palette[method], low=low, high=high))
            else:
                lines += [Line(method, x, y, palette[method]) for x, y in found]
        for label, scores in levels.items():
            if panel.score in scores:
                level = np.array([scores[panel.score]], np.float32)
                lines.append(Line(label, np.zeros(0, np.float32), level, "var(--pale)", MARK_DASHES[label]))
        drawn.append(chart(f"{panel.title}, {panel.unit}", panel.better, AXES[axis], lines))
    return "".join(drawn)


def is_band(curves: Sequence[tuple[FloatArray, FloatArray]]) -> bool:
    """Whether several seeds have been measured at common places."""
    return len(curves) > 1 and max(x[0] for x, _ in curves) < min(x[-1] for x, _ in curves)


def figure(path: Path, runs: Sequence[Run], axis: str) -> bool:
    """Draw every score against ``axis`` into a PNG.

    Args:
        path: the PNG.
        runs: finished runs.
        axis: 'seconds' or 'samples'.

    Returns:
        Whether there was anything to draw; without, no file is written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    groups = by_method(runs)
    palette = colours(list(groups))
    levels = marks(runs)
    panels = [panel for panel in PANELS if any(len(curve(run, axis, panel)[0]) for run in runs)]
    if not panels:
        return False
    rows = sorted({panel.row for panel in panels})
    columns = sorted({panel.column for panel in panels} | {2})
    page = Figure(figsize=(3.9 * len(columns), 3.3 * len(rows)), dpi=110, layout="constrained")
    FigureCanvasAgg(page)
    cells = page.subplots(len(rows), len(columns), squeeze=False)
    free = set(cells.flat)
    entries: dict[str, Any] = {}
    for panel in panels:
        ax = cells[rows.index(panel.row)][columns.index(panel.column)]
        free.discard(ax)
        drawn = {method: _draw(ax, group, axis, panel, palette[method]) for method, group in groups.items()}
        entries |= {method: line for method, line in drawn.items() if line is not None}
        for label, scores in levels.items():
            if np.isfinite(scores.get(panel.score, np.inf)):
                entries[label] = ax.axhline(scores[panel.score], color="#555555", lw=1.2, ls=DASHES[label], zorder=1)
        _dress(ax, axis, panel)
    for ax in free:
        ax.set_axis_off()
    names = [name for name in [*groups, *levels] if name in entries]
    home = cells[0][-1] if cells[0][-1] in free else cells[-1][-1]
    home.legend([entries[name] for name in names], names, frameon=False, fontsize=12, loc="center left")
    with replacing(path) as part:
        page.savefig(part, format="png")
    return True


def _draw(ax: Axes, group: Sequence[Run], axis: str, panel: Panel, colour: str) -> Any:
    """The curve of one method, with a band if it has several seeds; None if there is nothing to draw."""
    curves = [pair for pair in (curve(run, axis, panel) for run in group) if len(pair[0])]
    if not curves:
        return None
    if not is_band(curves):
        return [ax.plot(x, y, color=colour, lw=1.8, marker="o", ms=3.2)[0] for x, y in curves].pop()
    x, middle, low, high = band(curves)
    ax.fill_between(x, low, high, color=colour, alpha=0.2, lw=0)
    return ax.plot(x, middle, color=colour, lw=1.8)[0]


def _dress(ax: Axes, axis: str, panel: Panel) -> None:
    """A logarithmic axis of cost with a few ticks in plain numbers, labels, a faint grid."""
    from matplotlib.ticker import EngFormatter, FuncFormatter, LogLocator, MaxNLocator, NullLocator

    ax.set(xscale="log", title=panel.title, xlabel=AXES[axis], ylabel=f"{panel.unit} ({panel.better})")
    low, high = ax.get_xlim()
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 3 else (1.0, 3.0) if decades > 1.5 else (1.0, 2.0, 5.0)
    ax.xaxis.set_major_locator(MaxNLocator(5) if decades < 0.7 else LogLocator(subs=subs, numticks=12))
    ax.xaxis.set_minor_locator(NullLocator())
    plain = FuncFormatter(lambda value, _: f"{value:g}")
    ax.xaxis.set_major_formatter(EngFormatter(sep=" ") if axis == "samples" else plain)
    ax.grid(True, color="#dddddd", lw=0.7)
    ax.set_axisbelow(True)
    for edge in ("top", "right"):
        ax.spines[edge].set_visible(False)
