"""``report.html``: one page on what a run recovered, how well, and where not to trust it."""

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from neurad.callbacks import pictures
from neurad.callbacks.table import Row, score_rows
from neurad.callbacks.verdict import verdict
from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray
from neurad.metrics.marks import CONSTANT, LOOKUP, MARKS
from neurad.metrics.unseen import Unseen
from neurad.pages import page
from neurad.pages.chart import ACCENT, PALE, Line, chart
from neurad.runtime.files import write_text

NAME = "report.html"
VIEWS = 8
"""Views that the page shows at most: its pictures are in it."""
DASHES = {CONSTANT: (6.0, 4.0), LOOKUP: (2.0, 3.0)}
"""How lines are dashed that need no fit."""
SECONDS = "training time / s"
CHARTS = {
    **{f"{name.capitalize()}, PSNR in dB": f"{name}_psnr" for name in RECOVERED},
    "Picture (sRGB), PSNR in dB": "psnr_srgb",
}
BETTER = "higher is better"
READING = (
    "PSNR is in dB with peak 1: 20 dB is a typical error of 0.1, 30 dB of 0.03, 40 dB of 0.01. MAPE = mean |found - "
    "true| / (true + 0.01): lower is better. The best constant is the mean of the truth over the same pixels: what is "
    "not above it was not recovered. "
    "The true colour's lookup reads roughness from the true albedo by a table made of training views: what roughness "
    "owes to following colour. 8x8 are scores after a box filter of 8 x 8 pixels.",
    "A hatched surface is in no training photograph, so what stands there is a guess. Error bars are the run's own "
    "reckoning, over what they would be without photographs: 0 is sure, 1 is unknown. From 0.5 on thin pale lines say "
    "that a surface is not determined.",
    "Click a picture to enlarge it. The line in the upper pictures moves, and the buttons over them switch.",
)


@dataclass(frozen=True)
class Result:
    """What a report is made of."""

    title: str
    facts: list[str]
    """Lines on how it was made."""
    scores: Mapping[str, float]
    maps: Sequence[Mapping[str, Any]]
    """Maps of the held-out views, those that are shown first."""
    unseen: Unseen
    """What of all held-out views no photograph shows."""
    views: str = "held-out views"
    """Which views the scores are of."""
    rows: Sequence[Row] = ()
    """Rows of ``metrics.csv``."""
    busy: str = ""
    """That something else had the processor."""
    exposure: float = 1.0
    """What radiance is multiplied with to be shown."""
    environment: Mapping[str, FloatArray] = field(default_factory=dict)
    number: int = 0
    """How many views there are."""
    determined: str = ""
    """On how much of the surface photographs determine it."""
    distrusted: str = ""
    """Which surfaces the result may be wrong on."""
    steps: Sequence[tuple[str, str]] = ()
    """Commands that go on from here, and what they do."""
    causes: Sequence[str] = ()
    """What is wrong with all training photographs."""


def write_report(path: Path, result: Result) -> None:
    """Write the page."""
    judged = verdict(result.scores, result.views)
    distrusted = f"Do not trust {result.distrusted}." if result.distrusted else ""
    said = result.unseen.sentence(f"the {result.views}"), result.determined, distrusted
    parts = [
        page.paragraph(judged.sentence, "verdict"),
        *(page.paragraph(text, "warn") for text in (result.busy, *result.causes, *judged.warnings) if text),
        *(page.paragraph(text) for text in said if text),
        *(page.note(fact) for fact in result.facts),
    ]
    if drawn := _charts(result.rows):
        parts += ["<h2>While it trained</h2>", f'<div class="charts">{drawn}</div>']
    parts += [f"<h2>Scores</h2>{_tables(result.scores)}"]
    if result.environment:
        tiles = [page.tile(picture, heading) for heading, picture in pictures.environments(result.environment).items()]
        parts += ["<h2>Light</h2>", f'<div class="row" style="--columns:2">{"".join(tiles)}</div>']
        parts.append(page.note("All directions, up is at the top. The exposure is not that of the views."))
    shown = result.maps[:VIEWS]
    if shown:
        parts.append("<h2>Views</h2>")
        if len(shown) < result.number:
            parts.append(page.note(f"The first {len(shown)} of {result.number}; the others are in images/."))
    for index, view in enumerate(shown):
        name = pictures.view_name(view, index)
        parts += [
            f"<h3>View {html.escape(name)}</h3>",
            page.sheet(pictures.view_sheet(view, result.exposure, ""), f"v{index}"),
        ]
    parts += ["<h2>How to read this</h2>", *(page.note(text) for text in READING)]
    if result.steps:
        steps = [f"<p><code>{html.escape(command)}</code><br>{html.escape(text)}</p>" for command, text in result.steps]
        parts += ["<h2>How to go on</h2>", *steps]
    write_text(path, page.page(result.title, parts))


def _charts(rows: Sequence[Row]) -> str:
    """Scores over training time beside what needs no fit."""
    return "".join(chart(title, BETTER, SECONDS, lines) for title, _, lines in curves(rows))


def curves(rows: Sequence[Row]) -> Iterator[tuple[str, str, list[Line]]]:
    """Charts of scores over training time by the rows of ``metrics.csv``: title, name of the score, its curve and
    dashed what needs no fit.
    """
    for title, name in CHARTS.items():
        kept = [row for row in rows if name in row and row.get("seconds", 0.0) > 0]
        if not kept:
            continue
        x, y = (np.array([row[key] for row in kept], np.float32) for key in ("seconds", name))
        lines = [Line("this run", x, y, ACCENT)]
        for label, end in MARKS.items():
            level = kept[-1].get(f"{name}{end}")
            if level is not None:
                lines.append(Line(label, np.zeros(0, np.float32), np.array([level], np.float32), PALE, DASHES[label]))
        yield title, name, lines


def _tables(scores: Mapping[str, float]) -> str:
    parts = []
    for pixels, body in score_rows(scores, "this run").items():
        head, *rows = [[html.escape(cell) for cell in row] for row in body]
        styles = {number: "mark" for number in range(1, len(rows))}
        parts += [f"<h4>{html.escape(pixels.capitalize())}</h4>", page.table(head, rows, styles)]
    return "".join(parts)
