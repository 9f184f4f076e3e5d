"""Charts of a page: lines over a logarithmic axis of cost, drawn in the page's own colours for light and dark."""

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from neurad.core.decibels import EXACT
from neurad.core.records import FloatArray

WIDTH, HEIGHT = 400, 280
LEFT, RIGHT, TOP, BOTTOM = 46, 10, 10, 40
"""Margins of the frame."""
MIN_JOINED = 3
"""Points from which on a line joins them: two are no curve."""
MIN_SPAN = 1.0
"""Shortest vertical axis, in its unit: smaller differences may not fill a chart."""


@dataclass(frozen=True)
class Line:
    """One curve, or a level."""

    label: str
    x: FloatArray
    """[n], above 0; empty for a level, which has one ``y`` and goes from side to side."""
    y: FloatArray
    colour: str
    """CSS."""
    dash: str = ""
    """SVG's ``stroke-dasharray``."""
    low: FloatArray | None = None
    """Lower edge of a band [n]."""
    high: FloatArray | None = None


def chart(title: str, better: str, x_label: str, lines: Sequence[Line]) -> str:
    """A chart as HTML; empty where there is no curve.

    Args:
        title: quantity and unit.
        better: which way is better, in words.
    """
    lines = [drawable(line) for line in lines]
    curves = [line for line in lines if len(line.x)]
    if not curves:
        return ""
    x0, x1 = min(float(line.x.min()) for line in curves), max(float(line.x.max()) for line in curves)
    if x0 == x1:
        x0, x1 = x0 / 1.25, x1 * 1.25
    values = np.concatenate([part for line in lines for part in (line.y, line.low, line.high) if part is not None])
    y0, y1 = float(values.min()), float(values.max())
    spare = max(0.06 * (y1 - y0), (MIN_SPAN - (y1 - y0)) / 2)
    y0, y1 = y0 - spare, y1 + spare

    def place(x: float, y: float) -> tuple[float, float]:
        across = math.log(x / x0) / math.log(x1 / x0)
        return (
            LEFT + across * (WIDTH - LEFT - RIGHT),
            HEIGHT - BOTTOM - (y - y0) / (y1 - y0) * (HEIGHT - TOP - BOTTOM),
        )

    marks = []
    for value in _steps(y0, y1):
        _, y = place(x0, value)
        marks.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>')
        marks.append(f'<text x="{LEFT - 6}" y="{y + 4:.1f}" text-anchor="end">{value:g}</text>')
    for value in _decades(x0, x1):
        x, _ = place(value, y0)
        marks.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
        marks.append(f'<text x="{x:.1f}" y="{HEIGHT - BOTTOM + 16}" text-anchor="middle">{_plain(value)}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    marks.append(f'<text class="pale" x="{middle}" y="{HEIGHT - 5}" text-anchor="middle">{html.escape(x_label)}</text>')
    for line in lines:
        if line.low is not None and line.high is not None:
            edge = [*zip(line.x, line.low, strict=True), *reversed([*zip(line.x, line.high, strict=True)])]
            path = " ".join("{:.1f},{:.1f}".format(*place(float(x), float(y))) for x, y in edge)
            marks.append(f'<polygon points="{path}" style="fill:{line.colour};opacity:.2"/>')
        if not len(line.y):
            continue
        level = not len(line.x)
        points = [(x0, line.y[0]), (x1, line.y[0])] if level else [*zip(line.x, line.y, strict=True)]
        places = [place(float(x), float(y)) for x, y in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
        joined = level or len(places) >= MIN_JOINED
        if joined:
            marks.append(f'<polyline points="{path}" {_stroke(line)}>{_title(line, line.y[-1])}</polyline>')
        if not level and line.low is None:
            size = 2.4 if joined else 4.0
            marks += [_dot(x, y, size, line, _title(line, of)) for (x, y), of in zip(places, line.y, strict=True)]
    key = "".join(
        f'<span><svg viewBox="0 0 26 10">{_sample(line)}</svg>{html.escape(line.label)}</span>'
        for line in {line.label: line for line in lines}.values()
    )
    return (
        f'<figure class="chart"><figcaption><b>{html.escape(title)}</b> \u2014 {html.escape(better)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{html.escape(title)}">{"".join(marks)}</svg>'
        f'<div class="key">{key}</div></figure>'
    )


def drawable(line: Line) -> Line:
    """A line without the scores that no axis has a place for: its label says where it ends with one."""
    there = np.isfinite(line.y)
    label = f"{line.label}: {EXACT}" if len(line.y) and line.y[-1] == np.inf else line.label
    return replace(line, label=label, x=line.x[there] if len(line.x) else line.x, y=line.y[there])


def _stroke(line: Line) -> str:
    dash = f";stroke-dasharray:{line.dash}" if line.dash else ""
    return f'style="fill:none;stroke:{line.colour};stroke-width:2{dash}"'


def _title(line: Line, value: np.floating) -> str:
    return f"<title>{html.escape(line.label)}: {float(value):.2f}</title>"


def _dot(x: float, y: float, radius: float, line: Line, named: str = "") -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" style="fill:{line.colour}">{named}</circle>'


def _sample(line: Line) -> str:
    """How a line is drawn, for the key."""
    if 0 < len(line.x) < MIN_JOINED:
        return _dot(13, 5, 4.0, line)
    return f'<polyline points="0,5 26,5" {_stroke(line)}/>'


def _steps(low: float, high: float, count: int = 5) -> list[float]:
    """Round numbers between two."""
    rough = (high - low) / count
    unit = 10.0 ** math.floor(math.log10(rough))
    step = unit * next(factor for factor in (1, 2, 5, 10) if factor * unit >= rough)
    return [round(n * step, 10) for n in range(math.ceil(low / step), math.floor(high / step) + 1)]


def _decades(low: float, high: float, most: int = 7) -> list[float]:
    """Round numbers between two on a logarithmic axis."""
    found: list[float] = []
    for factors in ((1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7)):
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        ticks = [f * 10.0**p for p in powers for f in factors if low * 0.999 <= f * 10.0**p <= high * 1.001]
        if len(ticks) > most and found:
            break
        found = ticks
    return found if len(found) > 1 else _steps(low, high, 4)


def _plain(value: float) -> str:
    """A number with a letter for thousands and more."""
    for unit, letter in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if value >= unit * (10 if letter == " k" else 1):
            return f"{value / unit:g}{letter}"
    return f"{value:g}"
