"""Draws the plots of the results page from the measured numbers in ``docs/data``.

    python docs/plots.py

To report new measurements, replace rows in ``docs/data/*.csv`` and run it again. Every axis that shows an error or a
cost says that lower is better.
"""

from __future__ import annotations

import argparse
import csv
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
ROOMS = {"patterns": "built-in patterned kitchen"}
"""Names of rooms that a reader would not recognise."""
MAPS = ("albedo", "roughness")
Row = dict[str, str]


def rows(name: str) -> list[Row]:
    """The rows of ``docs/data/NAME.csv``."""
    with (DOCS / "data" / f"{name}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def rmse(psnr: str | float) -> float:
    """Root mean square error of a PSNR in dB with peak 1."""
    return float(10.0 ** (-float(psnr) / 20.0))


def distinct(values: Iterable[str]) -> list[str]:
    """Values in the order in which they first appear."""
    return list(dict.fromkeys(values))


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


def _curves(name: str, key: str | None = None) -> Figure:
    """Error of albedo and roughness against seconds: a curve for each value of column ``key``, or of room ``name``."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4))
    constants = {row["room"]: row for row in rows("constants")}
    table = rows(name)
    for axes, quantity in zip(both, MAPS, strict=True):
        for index, group in enumerate(distinct(row[key] for row in table) if key else [name]):
            chosen = [row for row in table if key is None or row[key] == group]
            seconds = [float(row["seconds"]) for row in chosen]
            label = ROOMS.get(group, group)
            axes.plot(
                seconds, [rmse(r[f"{quantity}_psnr"]) for r in chosen], "o-", ms=3, color=f"C{index}", label=label
            )
            axes.axhline(rmse(constants[group][f"{quantity}_psnr"]), color=f"C{index}", ls=":", lw=1)
        axes.set_xlabel("seconds of training")
        _error_axis(axes, quantity)
    both[0].legend(title="dotted: best constant", fontsize=8, title_fontsize=8)
    return figure


def patterns() -> Figure:
    """Error of the patterned kitchen against time."""
    return _curves("patterns")


def rooms() -> Figure:
    """Error in the four rooms against time."""
    return _curves("rooms", "room")


COMPARED = ("patterns", "staircase")
"""Rooms with a ``methods_ROOM.csv``, which has the columns of the ``curves.csv`` that ``neurad compare`` writes."""


def methods() -> Figure:
    """Error of every method at its end, in every room."""
    figure, both = plt.subplots(1, 2, figsize=(10, 4))
    constants = {row["room"]: row for row in rows("constants")}
    tables = {room: rows(f"methods_{room}") for room in COMPARED}
    names = distinct(row["method"] for table in tables.values() for row in table)
    for axes, quantity in zip(both, MAPS, strict=True):
        for index, (room, table) in enumerate(tables.items()):
            last = {row["method"]: rmse(row[f"{quantity}_psnr"]) for row in table}  # rows are in the order of time
            at = [number + 0.4 * (index - 0.5 * (len(tables) - 1)) for number in range(len(names))]
            bars = axes.bar(at, [last[name] for name in names], 0.38, color=f"C{index}", label=ROOMS.get(room, room))
            axes.bar_label(bars, fmt="%.3f", fontsize=7)
            axes.axhline(rmse(constants[room][f"{quantity}_psnr"]), color=f"C{index}", ls=":", lw=1)
        axes.set_xticks(range(len(names)), names)
        axes.set_ylabel(f"{quantity} RMSE (lower is better)")
    both[0].legend(title="dotted: best constant", fontsize=8, title_fontsize=8)
    ends = distinct(str(round(max(float(row["seconds"]) for row in table))) for table in tables.values())
    figure.suptitle(f"after {' or '.join(ends)} seconds of training", fontsize=10)
    return figure


def methods_curves() -> Figure:
    """Error of every method against time, a row of panels for each room."""
    figure, panels = plt.subplots(len(COMPARED), 2, figsize=(10, 4 * len(COMPARED)), squeeze=False)
    for line, room in zip(panels, COMPARED, strict=True):
        table = rows(f"methods_{room}")
        for axes, quantity in zip(line, MAPS, strict=True):
            for run in distinct(f"{row['method']} {row['seed']}" for row in table):
                method, seed = run.split()
                chosen = [row for row in table if (row["method"], row["seed"]) == (method, seed)]
                error = [rmse(row[f"{quantity}_psnr"]) for row in chosen]
                color = f"C{distinct(row['method'] for row in table).index(method)}"
                label = method if seed == table[0]["seed"] else None
                axes.plot([float(row["seconds"]) for row in chosen], error, "o-", ms=3, color=color, label=label)
            axes.set_xlabel("seconds of training")
            axes.set_title(ROOMS.get(room, room), fontsize=10)
            _error_axis(axes, quantity)
        line[0].legend(fontsize=8)
    return figure


def cube() -> Figure:
    """Milliseconds of a training step in the closed cube against its albedo."""
    table = rows("cube")
    kinds = distinct(row["fields"] for row in table)
    figure, both = plt.subplots(1, len(kinds), figsize=(10, 4), sharey=True)
    for axes, kind in zip(both, kinds, strict=True):
        for index, method in enumerate(distinct(row["method"] for row in table if row["fields"] == kind)):
            chosen = [row for row in table if row["fields"] == kind and row["method"] == method]
            albedo = [float(row["albedo"]) for row in chosen]
            axes.plot(
                albedo, [float(row["ms_per_step"]) for row in chosen], "o-", ms=4, color=f"C{index}", label=method
            )
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
    table = rows("growth")
    figure, panels = plt.subplots(2, len(GROWTH), figsize=(12, 5.6), sharey="row")
    for column, (label, curves) in enumerate(GROWTH.values()):
        for curve in curves:
            chosen = [row for row in table if row["curve"] == curve]
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


PLOTS: dict[str, Callable[[], Figure]] = {
    "patterns": patterns, "rooms": rooms, "methods": methods, "cube": cube, "growth": growth,
}  # fmt: skip
"""Every plot by the name of its file."""


def main(args: list[str] | None = None) -> None:
    """Write every plot as ``NAME.png``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--out", type=Path, default=DOCS, help="folder (default: docs)")
    out = parser.parse_args(args).out
    curves = any(
        len(rows(f"methods_{room}")) > len({r["method"] for r in rows(f"methods_{room}")}) for room in COMPARED
    )
    for name, draw in PLOTS.items() if not curves else [*PLOTS.items(), ("methods_curves", methods_curves)]:
        figure = draw()
        figure.tight_layout()
        figure.savefig(out / f"{name}.png", dpi=100, metadata={"Software": None})
        plt.close(figure)


if __name__ == "__main__":
    main()
