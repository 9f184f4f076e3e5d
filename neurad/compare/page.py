"""The page of a comparison."""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

from neurad.compare.curves import PANELS
from neurad.compare.runs import SCORES, full_name
from neurad.compare.table import RATES, TOO_FEW, TableRow, cell_text, columns
from neurad.core.decibels import decibels, figure
from neurad.core.parameters import RECOVERED
from neurad.metrics.marks import CONSTANT
from neurad.pages import page
from neurad.pages.sheet import Sheet
from neurad.runtime.files import write_text

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


def write_page(
    path: Path,
    title: str,
    facts: Sequence[str],
    rows: Sequence[TableRow],
    reach: Sequence[float],
    first: str,
    further: Mapping[str, str],
    views: Sequence[Sheet],
    notes: Sequence[str],
) -> None:
    """Write the page.

    Args:
        facts: lines on what was compared, how and where.
        first: the charts that come first, HTML.
    """
    parts = [page.paragraph(headline(rows), "verdict"), *(f'<p class="note">{fact}</p>' for fact in facts)]
    for row in rows:
        if row.get("status") not in (None, "ok"):
            parts.append(page.paragraph(f"{full_name(str(row['method']))}: {row['status']}", "warn"))
    behind = [str(row["stages"]) for row in _fitted(rows) if row.get("stages")]
    if len(set(behind)) > 1:
        said = "Methods have different stages behind them: scores are not of methods alone."
        parts.append(page.paragraph(said, "warn"))
    parts += ["<h2>Scores</h2>", _table(rows, ["method", "stages", "seeds", "seconds", "iterations", *SCORES])]
    if first:
        parts += ["<h2>Scores against training time</h2>", f'<div class="charts">{first}</div>']
    for heading, drawn in further.items():
        if drawn:
            parts.append(f"<details><summary>{heading}</summary><div class='charts'>{drawn}</div></details>")
    times = [name for name in columns(reach) if name.startswith("seconds_to_")]
    for heading, names in (
        ("Training seconds until albedo first has so many dB", times),
        ("Cost", ["processor_seconds", "samples", *RATES, "peak_memory_mib"]),
    ):
        if made := _table(rows, ["method", *names]):
            parts += [f"<h2>{heading}</h2>", made]
    if views:
        parts.append("<h2>Held-out views</h2>")
    for number, sheet in enumerate(views):
        parts += [f"<h3>{html.escape(sheet.title)}</h3>", page.sheet(sheet, f"v{number}")]
    if notes:
        parts += ["<h2>How to read this</h2>", *(page.note(text) for text in notes)]
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
