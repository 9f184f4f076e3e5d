"""Makes the tables and plots of the pages in ``docs`` of the measured numbers in ``docs/data``.

    python docs/results.py

A line ``<!-- table: NAME -->`` in a page is followed by the rows of ``docs/data/NAME.csv``, up to the next empty line.
To report new measurements, replace rows there and run it again.
"""

from __future__ import annotations

import argparse
import csv
import re
from collections.abc import Callable, Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

DOCS = Path(__file__).resolve().parent
TABLE = re.compile(r"^(<!-- table: (\w+) -->\n)(?:.+\n)*", re.M)
"""A marker, the name in it, and the lines that stand for its table."""
Row = dict[str, str]


def rows(name: str) -> list[Row]:
    """The rows of ``docs/data/NAME.csv``."""
    with (DOCS / "data" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def table(name: str) -> str:
    """``docs/data/NAME.csv`` in Markdown; columns may have the same title."""
    with (DOCS / "data" / f"{name}.csv").open(newline="") as file:
        head, *body = csv.reader(file, strict=True)
    if wrong := [line for line in body if len(line) != len(head)]:
        raise ValueError(f"docs/data/{name}.csv: {len(wrong[0])} columns in place of {len(head)}: {wrong[0]}")
    return "".join(f"| {' | '.join(line)} |\n" for line in (head, ["---"] * len(head), *body))


def page(text: str) -> str:
    """The page with the tables of today's data."""
    return TABLE.sub(lambda found: found[1] + table(found[2]), text)


def rmse(psnr: str | float) -> float:
    """Root mean square error of a PSNR in dB with peak 1."""
    return float(10.0 ** (-float(psnr) / 20.0))


def _plain_ticks(axis: Axis, values: Iterable[float]) -> None:
    """Ticks at ``values`` with plain numbers, on a logarithmic axis."""
    axis.set_major_locator(FixedLocator(list(values)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))


def _error_axis(axes: Axes, name: str) -> None:
    """A logarithmic RMSE axis."""
    axes.set_yscale("log")
    axes.set_ylabel(f"{name} RMSE (lower is better)")
    low, high = axes.get_ylim()
    nice = [0.015, 0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.12, 0.14, 0.17, 0.2, 0.3, 0.4, 0.5]
    _plain_ticks(axes.yaxis, [value for value in nice if low <= value <= high])
    axes.grid(True, alpha=0.3)


def patterns() -> Figure:
    """Error of the patterned kitchen against time."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4))
    curve, constant = rows("patterns"), rows("methods")[-1]
    for axes, quantity in zip(both, ("albedo", "roughness"), strict=True):
        seconds = [float(row["seconds"]) for row in curve]
        axes.plot(seconds, [rmse(row[f"{quantity}_psnr"]) for row in curve], "o-", ms=3)
        axes.axhline(rmse(constant[f"patterns: {quantity}"]), color="C0", ls=":", lw=1, label="best constant")
        axes.set_xlabel("seconds of training")
        _error_axis(axes, quantity)
    both[0].legend(fontsize=8)
    return figure


def cube() -> Figure:
    """Milliseconds of a training step in the closed cube against its albedo."""
    timed = [row for row in rows("cube") if row["measured"] == "ms a step"]
    kinds = list(dict.fromkeys(row["fields"] for row in timed))
    figure, both = plt.subplots(1, len(kinds), figsize=(10, 4), sharey=True)
    for axes, kind in zip(both, kinds, strict=True):
        for row in (row for row in timed if row["fields"] == kind):
            curve = {float(albedo): float(ms) for albedo, ms in row.items() if albedo.startswith("0.")}
            axes.plot(curve.keys(), curve.values(), "o-", ms=4, label=row["method"])
        axes.set_title(kind, fontsize=10)
        axes.set_xlabel("albedo of the walls")
        axes.set_yscale("log")
        _plain_ticks(axes.yaxis, [10, 20, 50, 100, 200, 500])
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=8)
    both[0].set_ylabel("ms a step (lower is better)")
    return figure


GROWTH = {
    "triangles": ("triangles", ["triangles"]),
    "views": ("training views of 512 x 512 pixels", ["views in memory", "views streamed"]),
    "pixels": ("pixels along a view's side", ["pixels along a side"]),
    "entries": ("entries of a hash grid's level", ["log2 of entries a level"]),
}
"""A panel each: what its axis shows, and the curves in it."""


def growth() -> Figure:
    """Time of a step and peak memory as something in the scene or the fields grows."""
    measured = rows("growth")
    figure, panels = plt.subplots(2, len(GROWTH), figsize=(12, 5.6), sharey="row")
    for column, (label, curves) in enumerate(GROWTH.values()):
        for curve in curves:
            chosen = [row for row in measured if row["curve"] == curve]
            value = [2.0 ** float(r["value"]) if curve.startswith("log2") else float(r["value"]) for r in chosen]
            name = curve.removeprefix("views ")
            for line, key in zip(panels[:, column], ("ms_per_step", "peak_mib"), strict=True):
                line.plot(value, [float(row[key]) for row in chosen], "o-", ms=4, label=name)
        for line in panels[:, column]:
            line.set_xscale("log", base=2 if label.startswith(("pixels", "entries")) else 10)
            line.grid(True, alpha=0.3)
        panels[1, column].set_yscale("log")
        _plain_ticks(panels[1, column].yaxis, [500, 1000, 2000, 5000])
        panels[1, column].set_xlabel(label)
        if len(curves) > 1:
            panels[1, column].legend(fontsize=8)
    panels[0, 0].set_ylim(0)
    panels[0, 0].set_ylabel("ms a step (lower is better)")
    panels[1, 0].set_ylabel("peak MiB (lower is better)")
    return figure


def captures() -> Figure:
    """Decibels that each damage to a capture costs, of albedo and of roughness, and standard errors."""
    damages = [row for row in rows("captures") if row["albedo lost"]]
    height, place = 0.38, range(len(damages))
    figure, axes = plt.subplots(figsize=(10, 5.6))
    for side, quantity in zip((-0.5, 0.5), ("albedo", "roughness"), strict=True):
        lost = [float(row[f"{quantity} lost"]) for row in damages]
        error = [float(row[f"{quantity} +-"]) for row in damages]
        thin = {"elinewidth": 0.8, "ecolor": "#666666"}
        bars = axes.barh([y + side * height for y in place], lost, height, xerr=error, label=quantity, error_kw=thin)
        axes.bar_label(bars, fmt="%.2f", padding=3, fontsize=8)
    axes.set_yticks(place, [row["what is wrong"] for row in damages])
    axes.invert_yaxis()
    axes.margins(x=0.07, y=0.02)
    axes.set_xlabel("dB of PSNR lost (lower is better)")
    axes.grid(True, axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(fontsize=8)
    return figure


PLOTS: dict[str, Callable[[], Figure]] = {"patterns": patterns, "cube": cube, "growth": growth, "captures": captures}
"""Every plot by the name of its file."""


def main(args: list[str] | None = None) -> None:
    """Write the pages with their tables, and every plot as ``NAME.png``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder (default: docs)")
    out = parser.parse_args(args).out
    for path in DOCS.glob("*.md"):
        if TABLE.search(text := path.read_text()):
            (out / path.name).write_text(page(text))
    for name, draw in PLOTS.items():
        figure = draw()
        figure.tight_layout()
        figure.savefig(out / f"{name}.png", dpi=100, metadata={"Software": None})
        plt.close(figure)


if __name__ == "__main__":
    main()
