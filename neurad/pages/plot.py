"""A chart as a picture, for what shows no SVG: the curves and levels of :mod:`neurad.pages.chart`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neurad.core.records import Bytes
from neurad.pages.chart import MIN_JOINED, Line, drawable

SIZE = 340, 208
"""Width and height in pixels: TensorBoard's cards, 350 pixels wide, scale what is higher."""
DPI = 100
STROKE = 1.6
"""Width of a line in points."""


def plot(title: str, better: str, x_label: str, lines: Sequence[Line]) -> Bytes:
    """A chart [h, w, 3] over a logarithmic axis of cost; the arguments are those of :func:`neurad.pages.chart.chart`,
    with colours that matplotlib has.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    with rc_context({"font.size": 8, "text.hinting": "none"}):
        page = Figure(figsize=(SIZE[0] / DPI, SIZE[1] / DPI), dpi=DPI, layout="constrained")
        canvas, ax = FigureCanvasAgg(page), page.subplots()
        for line in map(drawable, lines):
            dash = [float(x) / STROKE for x in line.dash.split()]
            style: dict[str, Any] = {
                "color": line.colour,
                "lw": STROKE,
                "ls": (0, dash) if dash else "-",
                "label": line.label,
            }
            if len(line.x):
                joined = len(line.x) >= MIN_JOINED
                ax.plot(line.x, line.y, **{**style, "ls": "-" if joined else ""}, marker="o", ms=3 if joined else 5)
            else:
                ax.axhline(line.y[0] if len(line.y) else np.nan, **style)
        ax.set(xscale="log", xlabel=x_label)
        low, high = ax.get_xlim()
        ax.xaxis.set_major_locator(MaxNLocator(4) if high / low < 5 else LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.xaxis.set_minor_locator(NullLocator())
        ax.xaxis.set_major_formatter("{x:g}")
        ax.grid(True, color="#e4e4e4", lw=0.6)
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_title(f"{title}\n{better}", loc="left", fontsize=8)
        page.legend(loc="outside lower center", ncols=min(len(lines), 2), frameon=False, handlelength=3)
        canvas.draw()  # type: ignore[no-untyped-call]
    drawn: Bytes = np.asarray(canvas.buffer_rgba())[..., :3].copy()  # type: ignore[no-untyped-call]
    return drawn
