"""The page: one HTML file that needs nothing beside it and no network."""

from __future__ import annotations

import base64
import html
from collections.abc import Sequence
from pathlib import Path

from neurad.runtime.files import write_text
from neurad.studies.compare.table import TableRow, present, shown

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1a1a1a; background: #fff; max-width: 1240px; margin: 2em auto;
       padding: 0 1em; }
h1 { font-size: 1.5em; } h2 { font-size: 1.15em; margin-top: 2em; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: .3em .6em; text-align: right; vertical-align: bottom; border-bottom: 1px solid #ddd; }
th { font-weight: 600; max-width: 7em; }
th:first-child, td:first-child, th:last-child, td:last-child { text-align: left; white-space: nowrap; }
img { max-width: 100%; height: auto; } code { font-size: 13px; overflow-wrap: anywhere; }
.note { color: #555; } .failed { color: #a40000; }
"""


def write_page(
    path: Path,
    title: str,
    facts: Sequence[str],
    rows: Sequence[TableRow],
    reach: Sequence[float],
    curves: Sequence[tuple[str, Path]],
    views: Sequence[tuple[str, Path]],
    notes: Sequence[str],
) -> None:
    """Write the page.

    Args:
        path: the HTML file.
        title: its heading.
        facts: lines on what was compared, how and where.
        rows: the table.
        reach: albedo PSNRs whose time the table has.
        curves: captions and PNGs of the figures.
        views: captions and PNGs of the held-out views.
        notes: how the figures were measured.
    """
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        *(f'<p class="note">{fact}</p>' for fact in facts),
        f'<h2>Table</h2><div class="scroll">{_table(rows, reach)}</div>',
    ]
    for heading, images in (("Error against cost", curves), ("Held-out views", views)):
        if images:
            parts.append(f"<h2>{heading}</h2>")
            parts += [_image(caption, image) for caption, image in images]
    if notes:
        parts.append("<h2>How to read this</h2>")
        parts += [f'<p class="note">{html.escape(note)}</p>' for note in notes]
    write_text(path, "\n".join([*parts, "</body></html>"]) + "\n")


def _table(rows: Sequence[TableRow], reach: Sequence[float]) -> str:
    names = present(rows, reach)
    lines = ["<tr>" + "".join(f"<th>{html.escape(name.replace('_', ' '))}</th>" for name in names) + "</tr>"]
    for row in rows:
        failed = str(row.get("status") or "").startswith("failed")
        cells = "".join(f"<td>{html.escape(shown(name, row.get(name)))}</td>" for name in names)
        lines.append(f'<tr class="failed">{cells}</tr>' if failed else f"<tr>{cells}</tr>")
    return "<table>" + "\n".join(lines) + "</table>"


def _image(caption: str, path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode("ascii")
    text = html.escape(caption)
    return f'<p>{text}</p>\n<img alt="{text}" src="data:image/png;base64,{data}">'
