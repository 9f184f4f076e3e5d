"""The page on what the verification found: figures and pictures side by side, nothing loaded from elsewhere."""

import html
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.decibels import decibels
from neurad.core.records import FloatArray
from neurad.export.seams import BOUND
from neurad.export.verified import Verified
from neurad.metrics.scores import block_means
from neurad.pages import page
from neurad.pages.colours import encode

DIFFERENCE = 10.0
"""Times that differences are enlarged."""
BLOCK = 8
"""Side of the blocks of pixels over which differences are averaged."""
MEANINGS = {
    "photograph": "what the camera saw",
    "fields": "neurad, from the fields of the fit",
    "baked": "neurad, from the exported folder",
    "mitsuba": "Mitsuba 3, scene.xml",
    "cycles": "Blender's Cycles, scene.glb",
}
STYLES = {"kept": "kept", "missed": "beyond", "not decided": "open"}


def write_report(found: Verified, path: Path, title: str) -> None:
    """Write the page."""
    said = found.as_json()
    kept = "No bound is missed; noise leaves some open." if found.undecided else "All bounds are kept."
    parts = [
        page.paragraph(f"Verified on {said['verified_on']}."),
        *(page.paragraph(text, "beyond") for text in found.beyond),
        *([] if found.beyond else [page.paragraph(kept, "kept")]),
        *(page.note(f"Not decided: {text}; more samples (--spp) tell.") for text in found.undecided),
        *(page.note(f"Left out: {text}.") for text in found.left_out),
        _bounds(found),
        _baking(found),
        _seams(found),
        _renderers(said["renderers"]),
        page.note(
            "All pictures share one exposure, as in the report of the run. Differences are to the exported folder in "
            f"neurad, {DIFFERENCE:g} times enlarged, means of {BLOCK} x {BLOCK} pixels as single ones are mostly noise."
        ),
    ]
    for index in range(len(found.views)):
        parts += _view(found, said["renderers"], index)
    path.write_text(page.page(title, parts), encoding="utf-8")


def _view(found: Verified, renderers: dict[str, Any], index: int) -> list[str]:
    """A row of pictures with their figures, and below it one of their differences."""
    name, photo = found.views[index].name, found.photographs[index]
    shown = {renderer: pictures.mean[index] for renderer, pictures in found.pictures.items()}
    parts = [f"<h2>{html.escape(name)}</h2>", '<div class="row">']
    if photo is not None:
        parts.append(_figure("photograph", f"mean {photo.mean():.4g}", photo))
    for renderer, picture in shown.items():
        entry = renderers[renderer]["views"][name]
        figures = [f"mean {entry['mean']:.4g} &plusmn; {entry['standard_error']:.1g}"]
        if renderer != "baked":
            figures.append(f"{entry['ratio_of_means']:.4f} of baked")
        if entry["psnr_below_white"] is not None:
            figures.append(f"PSNR {entry['psnr_below_white']:.2f} &plusmn; {entry['psnr_standard_error']:.2f} dB")
        parts.append(_figure(renderer, ", ".join(figures), picture))
    parts.append('</div><div class="row">')
    others = shown if photo is None else {"photograph": photo, **shown}
    for renderer, picture in others.items():
        if renderer != "baked":
            off = block_means(picture - shown["baked"], np.ones(picture.shape[:2], bool), BLOCK)[0]
            off = np.abs(off) * np.float32(DIFFERENCE)
            parts.append(_figure(f"{renderer} - baked", f"&times; {DIFFERENCE:g}, in blocks of {BLOCK}", off))
    return [*parts, "</div>"]


def _bounds(found: Verified) -> str:
    rows = []
    for verdict in found.verdicts:
        error = f" &plusmn; {verdict.error:.2g}" if verdict.error else ""
        state = f'<span class="{STYLES[verdict.state]}">{verdict.state}</span>'
        rows.append([html.escape(verdict.name), f"{verdict.value:.4f}{error}", f"{verdict.bound:g}", state])
    return "<h2>Bounds</h2>" + page.table(["what", "found", "bound", "verdict"], rows)


def _baking(found: Verified) -> str:
    rows = [
        [what, decibels(before), decibels(after), decibels(lost, 3)]
        for what, (before, after, lost) in found.lost().items()
    ]
    head = ["against the truth (the picture: against the photographs)", "fields", "baked", "lost"]
    return "<h2>Baking</h2>" + page.table(head, rows)


def _seams(found: Verified) -> str:
    seams = found.seams
    if seams is None or seams.points == 0:
        return ""
    return page.paragraph(
        f"Seams: over {seams.points} points on {seams.sides} sides of chart borders lookups differ from the fields by "
        f"{255 * seams.mean:.2f}/255 on average, {255 * seams.largest:.2f}/255 at most (on {seams.where}), "
        f"{100 * seams.beyond:.2f} % of them by more than {255 * BOUND:g}/255."
    )


def _renderers(renderers: dict[str, Any]) -> str:
    rows = []
    for name, entry in renderers.items():
        score, worst = entry["psnr_below_white"], entry["worst_view"]
        said = "-" if score is None else f"{score:.2f} &plusmn; {entry['psnr_standard_error']:.2f} dB"
        ratio, last = f"{entry['ratio_of_means']:.4f}", f"{worst['ratio_of_means']:.4f}"
        rows.append([MEANINGS[name], said, ratio, html.escape(worst["name"]), last])
    head = ["renderer", "PSNR (linear, below white)", "mean / baked", "worst view", "its mean / baked"]
    return "<h2>Renderers</h2>" + page.table(head, rows)


def _figure(name: str, figures: str, picture: FloatArray) -> str:
    meaning = f"{MEANINGS[name]}<br>" if name in MEANINGS else ""
    return page.tile(encode(picture), name, meaning + figures)
