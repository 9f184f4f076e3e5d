"""Charts: curves and levels over a logarithmic axis of cost, as SVG in a page's own colours for light and dark, and as
pictures for what shows no SVG.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from neurad.core.decibels import EXACT
from neurad.core.records import Bytes, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ACCENT, PALE = "#0b63b5", "#555555"
"""Colours of a run's curve, and of what needs no fit."""
INK, GRID = "#1a1a1b", "#e4e4e5"
PAGE_COLOURS = {ACCENT: "var(--accent)", PALE: "var(--pale)", INK: "var(--ink)", GRID: "var(--line)"}
"""What these are on a page."""
MIN_JOINED = 3
"""Points from which on a line joins them: two are no curve."""
MIN_SPAN = 1.0
"""Shortest vertical axis, in its unit: smaller differences may not fill a chart."""
SIZE, ROW = (4.2, 2.5), 0.18
"""Inches of a chart on a page without its key, and of a row of that."""
PICTURE = 340, 208
"""Pixels of a picture: TensorBoard's cards, 350 pixels wide, scale what is higher."""
DPI = 100
STYLE: Any = dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK)
STROKE = 1.6
"""Width of a line in points."""


@dataclass(frozen=True)
class Line:
    """One curve, or a level."""

    label: str
    x: FloatArray
    """[n], above 0; empty for a level, which has one ``y`` and goes from side to side."""
    y: FloatArray
    colour: str
    dash: tuple[float, ...] = ()
    """Lengths in points of dashes and gaps; solid without."""
    low: FloatArray | None = None
    """Lower edge of a band [n]."""
    high: FloatArray | None = None


def chart(title: str, better: str, x_label: str, lines: Sequence[Line]) -> str:
    """A chart as HTML, its title a quantity and unit, with which way is better in words; empty without any curve."""
    from matplotlib import rc_context

    lines = [drawable(line) for line in lines]
    if not any(len(line.x) for line in lines):
        return ""
    drawn = io.StringIO()
    with rc_context({**STYLE, "font.size": 9, "svg.fonttype": "none", "svg.hashsalt": "neurad"}):
        page = _drawn(SIZE, ROW, "", x_label, lines)
        page.savefig(drawn, format="svg", transparent=True, metadata={"Date": None})
    svg = re.sub(r"<metadata>.*?</metadata>", "", drawn.getvalue(), flags=re.DOTALL)
    for colour, name in PAGE_COLOURS.items():
        svg = svg.replace(colour, name)
    heading = f"<figcaption><b>{html.escape(title)}</b> \u2014 {html.escape(better)}</figcaption>"
    return f'<figure class="chart">{heading}{svg[svg.index("<svg") :]}</figure>'


def plot(title: str, better: str, x_label: str, lines: Sequence[Line]) -> Bytes:
    """A chart as a picture [h, w, 3]; the arguments are those of :func:`chart`."""
    from matplotlib import rc_context

    size = PICTURE[0] / DPI, PICTURE[1] / DPI
    with rc_context({**STYLE, "font.size": 8, "text.hinting": "none"}):
        page = _drawn(size, 0.0, f"{title}\n{better}", x_label, [drawable(line) for line in lines])
        canvas: Any = page.canvas
        canvas.draw()
    drawn: Bytes = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return drawn


def _drawn(size: tuple[float, float], row: float, title: str, x_label: str, lines: Sequence[Line]) -> Figure:
    """A figure of curves and levels, with the key below, each row of which makes it ``row`` inches higher."""
    page = new_figure(*size)
    ax = page.subplots()
    for line in lines:
        _draw(ax, line)
    low, high = ax.get_ylim()
    spare = max(0.0, MIN_SPAN - (high - low)) / 2
    ax.set(xscale="log", xlabel=x_label, ylim=(low - spare, high + spare))
    at = np.concatenate([line.x for line in lines])
    if len(at) and at.min() == at.max():
        ax.set_xlim(0.5 * at[0], 2.0 * at[0])  # in the middle
    plain_ticks(ax)
    ax.grid(True, color=GRID, lw=0.6)
    ax.set_title(title, loc="left", fontsize="medium")
    handles = {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    columns = min(max(1, int(16 * size[0] / (max(map(len, handles)) + 7))), len(handles))
    page.legend(handles.values(), handles, loc="outside lower center", ncols=columns, frameon=False, handlelength=2.5)
    page.set_figheight(size[1] + row * -(-len(handles) // columns))
    return page


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches, laid out by itself."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    page = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(page)
    return page


def _draw(ax: Axes, line: Line) -> None:
    style: dict[str, Any] = {"color": line.colour, "lw": STROKE, "label": line.label}
    dashes = (0, [length / STROKE for length in line.dash]) if line.dash else "-"
    if not len(line.x):
        ax.axhline(line.y[0] if len(line.y) else np.nan, ls=dashes, **style)
        return
    if line.low is not None and line.high is not None:
        ax.fill_between(line.x, line.low, line.high, color=line.colour, alpha=0.2, lw=0)
    joined = len(line.x) >= MIN_JOINED
    marker = "" if line.low is not None else "o"
    ax.plot(line.x, line.y, ls=dashes if joined else "", marker=marker, ms=3 if joined else 5, **style)


def plain_ticks(ax: Axes) -> None:
    """Few ticks of a logarithmic axis, in plain numbers; no frame above and at the right."""
    from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullLocator

    low, high = ax.get_xlim()
    decades = np.log10(high / low)
    subs = (1.0,) if decades > 3 else (1.0, 3.0) if decades > 1.5 else (1.0, 2.0, 5.0)
    ax.xaxis.set_major_locator(MaxNLocator(4) if decades < 0.7 else LogLocator(subs=subs, numticks=12))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(EngFormatter(sep=" "))
    ax.set_axisbelow(True)
    ax.spines[["top", "right"]].set_visible(False)


def drawable(line: Line) -> Line:
    """A line without the scores that no axis has a place for: its label says where it ends with one."""
    there = np.isfinite(line.y)
    label = f"{line.label}: {EXACT}" if len(line.y) and line.y[-1] == np.inf else line.label
    return replace(line, label=label, x=line.x[there] if len(line.x) else line.x, y=line.y[there])
