"""``report.html``: one page on what a run recovered, how well, and where not to trust it."""

import html
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from neurad.callbacks import pictures
from neurad.callbacks.table import Row, score_rows
from neurad.callbacks.verdict import verdict
from neurad.core.parameters import RECOVERED
from neurad.metrics.marks import CONSTANT, LOOKUP, MARKS
from neurad.metrics.unseen import Unseen
from neurad.pages import page
from neurad.pages.chart import ACCENT, PALE, Line, chart
from neurad.runtime.files import write_text
from neurad.training.evaluate import Evaluation

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


def write_report(
    path: Path,
    title: str,
    evaluation: Evaluation,
    unseen: Unseen,
    *,
    views: str = "held-out views",
    number: int = 0,
    rows: Sequence[Row] = (),
    warnings: Sequence[str] = (),
    trust: Sequence[str] = (),
    facts: Sequence[str] = (),
    steps: Sequence[tuple[str, str]] = (),
) -> None:
    """Write the page; texts that are empty are left out.

    Args:
        evaluation: with maps of the views that are shown first.
        unseen: what of all views no photograph shows.
        views: which views the scores are of.
        number: how many views there are.
        rows: of ``metrics.csv``.
        warnings: what may have gone wrong.
        trust: where the result can be trusted, and where not.
        facts: how it was made.
        steps: commands that go on from here, and what they do.
    """
    judged = verdict(evaluation.scores, views)
    parts = [
        page.paragraph(judged.sentence, "verdict"),
        *(page.paragraph(text, "warn") for text in (*warnings, *judged.warnings) if text),
        *(page.paragraph(text) for text in (unseen.sentence(f"the {views}"), *trust) if text),
        *(page.note(fact) for fact in facts if fact),
    ]
    if drawn := "".join(chart(heading, BETTER, SECONDS, lines) for heading, _, lines in curves(rows)):
        parts += ["<h2>While it trained</h2>", f'<div class="charts">{drawn}</div>']
    parts += [f"<h2>Scores</h2>{_tables(evaluation.scores)}"]
    if sky := evaluation.environment:
        tiles = [page.tile(picture, heading) for heading, picture in pictures.environments(sky).items()]
        parts += ["<h2>Light</h2>", f'<div class="row" style="--columns:2">{"".join(tiles)}</div>']
        parts.append(page.note("All directions, up is at the top. The exposure is not that of the views."))
    shown = evaluation.maps[:VIEWS]
    if shown:
        parts.append("<h2>Views</h2>")
        if len(shown) < number:
            parts.append(page.note(f"The first {len(shown)} of {number}; the others are in images/."))
    for index, view in enumerate(shown):
        name = pictures.view_name(view, index)
        parts += [
            f"<h3>View {html.escape(name)}</h3>",
            page.sheet(pictures.view_sheet(view, evaluation.exposure, ""), f"v{index}"),
        ]
    parts += ["<h2>How to read this</h2>", *(page.note(text) for text in READING)]
    if steps:
        shown_steps = (f"<p><code>{html.escape(step)}</code><br>{html.escape(text)}</p>" for step, text in steps)
        parts += ["<h2>How to go on</h2>", *shown_steps]
    write_text(path, page.page(title, parts))


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
