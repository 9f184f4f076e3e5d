"""Figures as a paper takes them: of the width of its text, in its size of letters, as PDF, SVG and PNG."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurad.compare.curves import AXES, PANELS, Panel, curve, lines_of
from neurad.compare.runs import Run, full_name
from neurad.compare.views import KINDS, TRUTH, Maps, error_picture, fits, shown
from neurad.core.decibels import decibels
from neurad.core.records import Float64Array
from neurad.metrics.marks import CONSTANT, LOOKUP
from neurad.metrics.scores import psnr
from neurad.pages.chart import MIN_JOINED, Line, plain_ticks
from neurad.pages.sheet import Crop, worst_squares
from neurad.runtime.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
INSET = 0.4
"""Side of the error's picture over that of the crop in whose corner it is."""


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
            page = _figure(WIDTH * max(len(panels), 2) / 3, 1.55 * len(axes) + 0.6)
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


def write_crops(stem: Path, columns: Mapping[str, Maps], scale: float) -> None:
    """Draw a square of a held-out view where methods are most wrong: the truth, and each method's with its error in a
    corner and its PSNR in the square below. Draws nothing where there is no truth.

    Args:
        columns: maps by method, the truth under its own name, see :func:`neurad.compare.views.sheet`.
        scale: exposure of radiance.
    """
    import matplotlib

    exact, methods = columns[TRUTH], {name: maps for name, maps in columns.items() if name != TRUTH}
    kinds = [kind for kind in KINDS if kind in exact and any(fits(maps, exact, kind) for maps in methods.values())]
    if not kinds:
        return
    crop = _square(exact, methods, kinds[0], scale)
    across = len(methods) + 2
    with matplotlib.rc_context(STYLE):
        page = _figure(WIDTH, len(kinds) * (WIDTH / across + 0.16) + 0.3)
        cells = page.subplots(len(kinds), across, squeeze=False)
        part = np.s_[crop.y : crop.y + crop.side, crop.x : crop.x + crop.side]
        for kind, row in zip(kinds, cells, strict=True):
            whole = shown(kind, exact[kind], scale)
            row[0].imshow(whole, interpolation="none")
            box: dict[str, Any] = {"fill": False, "edgecolor": "#ff40a0", "lw": 1.0}
            row[0].add_patch(matplotlib.patches.Rectangle((crop.x - 0.5, crop.y - 0.5), crop.side, crop.side, **box))
            row[0].set_ylabel(KINDS[kind])
            row[1].imshow(whole[part], interpolation="none")
            for ax, maps in zip(row[2:], methods.values(), strict=True):
                if not fits(maps, exact, kind):
                    ax.set_axis_off()
                    continue
                unit = scale if kind == "render" else 1.0
                ax.imshow(shown(kind, maps[kind], scale)[part], interpolation="none")
                inset = ax.inset_axes((1.0 - INSET, 0.0, INSET, INSET))
                inset.imshow(error_picture(maps[kind], exact[kind], unit)[part], interpolation="none")
                inset.set(xticks=[], yticks=[])
                inset.spines[:].set(color="white", linewidth=0.8)
                one, other = (np.clip(image[part] * unit, 0.0, 1.0) for image in (maps[kind], exact[kind]))
                ax.set_xlabel(decibels(psnr(float(np.square(one - other).mean())), 1), labelpad=2)
            for ax in row:
                ax.set(xticks=[], yticks=[])
        names = ["Held-out view", "Truth", *map(full_name, methods)]
        for ax, name in zip(cells[0], names, strict=True):
            ax.set_title(textwrap.fill(name, max(12, round(100 / across))), pad=3)
        save(page, stem)


def save(page: Figure, stem: Path) -> None:
    """Write a figure as PDF, SVG and PNG; equal figures make equal files."""
    page.draw_without_rendering()
    page.set_layout_engine("none")  # as it is now, for all three
    undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}
    for suffix, metadata in undated.items():
        with replacing(stem.with_suffix(f".{suffix}")) as part:
            page.savefig(part, format=suffix, dpi=DPI, metadata=metadata)


def _figure(width: float, height: float) -> Figure:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    page = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(page)
    return page


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


def _square(exact: Maps, methods: Mapping[str, Maps], kind: str, scale: float) -> Crop:
    """The square of a view in which the methods' errors are largest together; its middle where there are none."""
    unit = scale if kind == "render" else 1.0
    total: Float64Array = np.zeros(exact[kind].shape[:2])
    for maps in methods.values():
        if fits(maps, exact, kind):
            total = total + np.clip(np.abs(maps[kind] - exact[kind]) * unit, 0.0, 1.0).mean(-1)
    found = worst_squares([("", total.astype(np.float32))], 1)
    side = max(1, min(total.shape) // 4)
    return found[0] if found else Crop("A", (total.shape[0] - side) // 2, (total.shape[1] - side) // 2, side, "")
