"""The report of a comparison: its page, its figures and its tables."""

import argparse
import html
import platform
import shlex
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any

import torch

from neurad.compare import curves, views
from neurad.compare.curves import PANELS
from neurad.compare.runs import SCORES, STAGES, Run, by_method, full_name
from neurad.compare.table import MIN_ITERATIONS, RATES, TOO_FEW, TableRow, cell_text, columns, table
from neurad.core.decibels import decibels, figure
from neurad.core.parameters import RECOVERED
from neurad.images.image_io import write_png
from neurad.metrics.marks import CONSTANT
from neurad.pages import page
from neurad.pages.draw import draw
from neurad.pages.sheet import Sheet
from neurad.runtime import tables
from neurad.runtime.files import make_folder, write_text
from neurad.runtime.machine import processor, usable_cores

NOTES = (
    "Scores are those of the held-out views at the end of a run: PSNR in dB with peak 1, "
    "MAPE = mean |p - g| / (g + 0.01). The best constant is the mean of the truth over "
    "the same pixels. The true colour's lookup is a table from albedo to roughness, made of the true maps of training "
    "views and read with the true albedo: what roughness owes to following colour.",
    "Seconds run from the end of a fit's first iteration, as what comes before (the scene, camera rays, compilation) "
    "depends on what ran before; of runs that were not made for this comparison, from the start of their process. "
    "Evaluations are left out. Path samples are those drawn by training: pixels x samples per pixel x samples per "
    f"vertex. Fits of under {MIN_ITERATIONS} iterations are marked and never best.",
    "Milliseconds a step and the rates are taken between the first and the last evaluation. Peak memory is the largest "
    "resident memory of the process that fitted, processor time that of all its threads, evaluations included.",
    "Stages are what a fit does beside gradient descent, whatever its method: "
    f"{', '.join(name for name, _ in STAGES.values())}. `neurad compare --plain` fits without any.",
    "With several seeds the table has medians, and the curves have the median and a band from the lowest score to the "
    "highest.",
)
HEADS = {
    **{
        f"{name}_{score}": f"{name} {heading}"
        for name in RECOVERED
        for score, heading in (("psnr", "PSNR / dB"), ("mape", "MAPE"))
    },
    "psnr_srgb": "picture PSNR / dB, sRGB",
    "lamp_error": "error of the worst lamp",
    "seconds": "training time / s",
    "iterations": "iterations",
    "processor_seconds": "processor time in all / s",
    "samples": "path samples",
    "ms_per_step": "ms a step",
    "rays_per_second": "rays / s",
    "samples_per_second": "samples / s",
    "peak_memory_mib": "peak memory / MiB",
}
LOWER = ("mape", "lamp_error", "seconds", "samples", "ms_", "peak")
"""Parts of the names of what is better when it is lower; everything else is better when it is higher."""
UNRANKED = ("stages", "seeds", "seconds", "iterations", "processor_seconds", "samples")
"""What is neither better nor worse."""
FURTHER = {
    "Against processor time": ("processor_seconds", 0),
    "Against iterations": ("iteration", 0),
    "Against path samples": ("samples", 0),
    "MAPE against training time": ("seconds", 1),
    "MAPE against path samples": ("samples", 1),
    "Lamps that were found against training time": ("seconds", 2),
}
"""Axis and row of :data:`PANELS` of charts that a page shows when they are asked for, by heading."""


def write_report(options: argparse.Namespace, runs: Sequence[Run], reach: Sequence[float]) -> None:
    """Write index.html, the figures, table.md, table.csv and curves.csv; ``reach`` is that of :func:`table`."""
    out, budget = options.out, ""
    if options.budget is not None:
        budget = f"Every fit was given {options.budget:g} training seconds"
    elif options.samples is not None:
        budget = f"Every fit drew {options.samples:g} path samples in its steps"
    make_folder(out, "--out")
    for old in [path for name in ("view_*.png", "curves_*.???", "crops.???") for path in out.glob(name)]:
        old.unlink()
    done = [run for run in runs if not run.message]
    rows, names, line = table(runs, reach), columns(reach), shlex.join(["neurad", "compare", *options.words])
    tables.write_csv(out / "table.csv", names, rows)
    cells = ([cell_text(name, row.get(name)) for name in names] for row in rows)
    lines = tables.markdown(names, cells, left=("method", "stages", "status"))
    said = ". ".join(part for part in (f"`{line}`", budget, _machine(), date.today().isoformat()) if part)
    write_text(out / "table.md", "\n".join(lines) + f"\n\n{said}.\n")
    curves.write_csv(out / "curves.csv", runs)
    curves.write_curves(out, done)
    firsts = [group[0] for group in by_method(done).values()]
    shown = views.compared(firsts, options.views, options.trust) if options.views else []
    if shown:
        views.write_crops(out / "crops", shown[0].columns, shown[0].scale)
    sheets = [views.sheet(view) for view in shown]
    for number, sheet in enumerate(sheets):
        write_png(out / f"view_{number:03d}.png", draw(sheet))
    where = f"{_machine()}, Python {platform.python_version()}, torch {torch.__version__}, {date.today().isoformat()}"
    facts = [f"<code>{html.escape(line)}</code>", html.escape(". ".join(p for p in (budget, where) if p) + ".")]
    write_page(out / "index.html", f"Comparison on {_scene_name(runs)}", facts, rows, reach, done, sheets)


def _scene_name(runs: Sequence[Run]) -> str:
    for run in runs:
        data: Mapping[str, Any] = run.config.get("data") or {}
        if data.get("root") or data.get("scene"):
            return Path(str(data["root"])).name if data.get("root") else str(data["scene"])
    return "an unknown scene"


def _machine() -> str:
    """Processor, cores that may be used, and the GPU if there is one."""
    cores = usable_cores()
    gpu = f", {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else ""
    return f"{processor()}, {cores} core{'s' if cores > 1 else ''}{gpu}"


def write_page(
    path: Path, title: str, facts: Sequence[str], rows: Sequence[TableRow], reach: Sequence[float],
    runs: Sequence[Run], sheets: Sequence[Sheet],
) -> None:  # fmt: skip
    """Write the page; ``facts`` are lines on what was compared, how and where, HTML."""
    parts = [page.paragraph(headline(rows), "verdict"), *(f'<p class="note">{fact}</p>' for fact in facts)]
    for row in rows:
        if row.get("status") not in (None, "ok"):
            parts.append(page.paragraph(f"{full_name(str(row['method']))}: {row['status']}", "warn"))
    behind = [str(row["stages"]) for row in _fitted(rows) if row.get("stages")]
    if len(set(behind)) > 1:
        said = "Methods have different stages behind them: scores are not of methods alone."
        parts.append(page.paragraph(said, "warn"))
    parts += ["<h2>Scores</h2>", _table(rows, ["method", "stages", "seeds", "seconds", "iterations", *SCORES])]
    if first := curves.charts(runs, "seconds", 0):
        parts += ["<h2>Scores against training time</h2>", f'<div class="charts">{first}</div>']
    for heading, (axis, row_of_panels) in FURTHER.items():
        if drawn := curves.charts(runs, axis, row_of_panels):
            parts.append(f"<details><summary>{heading}</summary><div class='charts'>{drawn}</div></details>")
    times = [name for name in columns(reach) if name.startswith("seconds_to_")]
    for heading, names in (
        ("Training seconds until albedo first has so many dB", times),
        ("Cost", ["processor_seconds", "samples", *RATES, "peak_memory_mib"]),
    ):
        if made := _table(rows, ["method", *names]):
            parts += [f"<h2>{heading}</h2>", made]
    if sheets:
        parts.append("<h2>Held-out views</h2>")
    for number, sheet in enumerate(sheets):
        parts += [f"<h3>{html.escape(sheet.title)}</h3>", page.sheet(sheet, f"v{number}")]
    parts += ["<h2>How to read this</h2>", *(page.note(text) for text in NOTES)]
    write_text(path, page.page(title, parts))


def headline(rows: Sequence[TableRow]) -> str:
    """Who is best at what, and what nobody found, in one sentence."""
    level = next((row for row in rows if row["method"] == CONSTANT), {})
    best: dict[str, list[str]] = {}
    missed = []
    for panel in (panel for panel in PANELS if panel.row == 0):
        found = [(_number(row.get(panel.score)), str(row["method"])) for row in _fitted(rows) if not _is_short(row)]
        scored = [(value, method) for value, method in found if value is not None]
        if not scored:
            continue
        score, method = max(scored)
        constant = _number(level.get(panel.score))
        what = panel.title.partition(" ")[0].lower()
        if constant is not None and score <= constant:
            missed.append(f"no method has {what} above the best constant ({decibels(constant)})")
        else:
            beside = "" if constant is None else f", the best constant {figure(constant)}"
            best.setdefault(method, []).append(f"{what} ({decibels(score)}{beside})")
    parts = [f"{full_name(method)} has the best {_all_of(words)}" for method, words in best.items()] + missed
    nothing = f"every fit did {TOO_FEW}" if any(map(_is_short, rows)) else "nothing was scored"
    return f"On the held-out views {'; '.join(parts) or nothing}."


def _all_of(words: Sequence[str]) -> str:
    return " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))


def _is_short(row: TableRow) -> bool:
    """Whether fits of a method did too few iterations to be compared."""
    return TOO_FEW in str(row.get("status"))


def _fitted(rows: Sequence[TableRow]) -> list[TableRow]:
    return [row for row in rows if "seeds" in row]


def _number(cell: object) -> float | None:
    return float(cell) if isinstance(cell, int | float) else None


def _table(rows: Sequence[TableRow], names: Sequence[str]) -> str:
    """Some columns as a table, the best of each bold, with an arrow for which way is better; empty without figures."""
    kept = [name for name in names if any(row.get(name) not in (None, "") for row in rows)]
    if set(kept) <= {"method", "stages", "seeds"}:
        return ""
    lines = [row for row in rows if any(row.get(name) not in (None, "") for name in kept if name != "method")]
    best = {}
    for name in kept:
        eligible = [row for row in _fitted(lines) if not _is_short(row)]
        values = [value for row in eligible if (value := _number(row.get(name))) is not None]
        if len(values) > 1 and name not in UNRANKED:
            best[name] = (min if _is_lower(name) else max)(values)
    cells = [
        [
            _cell(name, row.get(name), "seeds" in row and not _is_short(row) and row.get(name) == best.get(name, ""))
            for name in kept
        ]
        for row in lines
    ]
    styles = {number: "mark" for number, row in enumerate(lines) if "seeds" not in row}
    styles |= {n: "failed" for n, row in enumerate(lines) if row.get("status") not in (None, "ok")}
    return page.table([_head(name) for name in kept], cells, styles)


def _cell(name: str, value: object, best: bool) -> str:
    text = html.escape(full_name(str(value)) if name == "method" else cell_text(name, value))  # type: ignore[arg-type]
    return f'<span class="best">{text}</span>' if best else text


def _head(name: str) -> str:
    """The name of a column; its unit and arrow stay together where it takes two lines."""
    ranked = name not in ("method", *UNRANKED)
    text = HEADS.get(name) or (f"{name.removeprefix('seconds_to_albedo_')} dB" if ranked else name)
    arrow = f" {'&darr;' if _is_lower(name) else '&uarr;'}" if ranked else ""
    words, slash, unit = text.partition(" / ")
    if not slash:
        words, _, unit = text.rpartition(" ")
    whole = f'<span class="whole">{"/ " * bool(slash)}{html.escape(unit)}{arrow}</span>'
    return f"{html.escape(words)} {whole}" if words else whole


def _is_lower(name: str) -> bool:
    return any(part in name for part in LOWER) and not name.endswith("per_second")
