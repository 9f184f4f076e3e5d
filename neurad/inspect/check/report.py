"""``check.html`` and ``check.csv``: what a check found, with the edges of the geometry over each photograph."""

import html
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neurad.core.records import Array, Bytes
from neurad.inspect.check.findings import Finding, Findings, Level
from neurad.inspect.check.geometry import Places
from neurad.inspect.check.light import Light
from neurad.inspect.check.look import Looked
from neurad.lamps.photographed import PhotographedLamp
from neurad.metrics.unseen import UNSEEN
from neurad.pages import page
from neurad.pages.colours import encode, hatched
from neurad.runtime.files import write_text
from neurad.runtime.tables import write_csv
from neurad.scene.exposure import exposure

PAGE, TABLE = "check.html", "check.csv"
VIEWS = 60
"""Views whose pictures are on the page at most: those with something wrong come first."""
MESHES = 12
"""Rows of the table of surfaces that no photograph shows."""
EDGE = (0, 235, 255)
"""Colour of edges of the geometry."""
SHOWN = {
    "mean": ("mean", "#.3g"), "highest": ("highest", "#.3g"), "clipped": ("clipped", ".1%"),
    "exposure": ("exposure", ".2f"), "surface": ("surface", ".1%"), "distance": ("distance", "#.3g"),
    "width": ("free width", "#.3g"), "edge_rank": ("edge rank", ".2f"), "edge_peak": ("peak", ".1f"),
    "edge_excess": ("excess", ".2f"), "offset": ("offset, px", ".2f"),
}  # fmt: skip
"""Columns that the table of the page has beside a view and its part: what it calls them and how it writes them."""
VERDICTS = {
    Level.REFUSED: "A fit would refuse this scene.",
    Level.WRONG: "It can be read, but something looks wrong.",
    Level.NOTE: "Nothing looks wrong.",
}
READING = (
    "Coloured lines are edges of the geometry as the camera sees them: outlines, creases, borders between materials. "
    "They lie on edges of the photograph where pose, lens and geometry are right. Shadows and textures have no line.",
    "Edge rank: how large the photograph's gradients are at these lines among all of its pixels, from 0 to 1. Peak: "
    "how many standard deviations the pose stands out of cameras turned by up to 14 pixels. Excess: by how many the "
    "best of those is better than the pose; a view is named from 0.25 on (0.5 with fewer than 1000 places along "
    "edges), or if its rank is far below all others.",
    "Offset: by how many pixels the photograph's textures lie beside what others show of the same surfaces; blank "
    "where too few flat patches with a texture are shown by several photographs.",
    "Mean: of the pixels that show surfaces and no lamp; clipped: how many of these are at the photograph's ceiling. "
    "Highest: of all pixels. Surface: pixels whose camera meets one. Distance: median of these, in units of the scene.",
    "Exposure: brightness of the photograph over that of a picture with the lights and materials of the scene file. "
    "Where these materials are made up (as by neurad data), only differences between views say something.",
    "Hatched: surfaces of held-out views that no training photograph shows.",
    "Click a picture to enlarge it.",
)


@dataclass(frozen=True)
class Checked:
    """All that a check has found."""

    name: str
    subject: Mapping[str, str]
    """How large the scene is: labels and values."""
    looked: Sequence[Looked]
    places: Places
    light: Light
    findings: Findings


def write_pages(checked: Checked, out: Path) -> None:
    """Write the page and the table."""
    rows = [_row(checked, index) for index in range(len(checked.looked))]
    write_csv(out / TABLE, [*rows[0]], rows)
    write_text(out / PAGE, page.page(f"neurad check: {checked.name}", _parts(checked)))


def verdict(findings: Findings) -> str:
    """The first line."""
    bad = len(findings.of(Level.REFUSED)) + len(findings.of(Level.WRONG))
    return VERDICTS[findings.worst] + (f" {bad} thing{'s' * (bad != 1)} to look at." if bad else "")


def _parts(checked: Checked) -> list[str]:
    findings = checked.findings
    bad = [*findings.of(Level.REFUSED), *findings.of(Level.WRONG)]
    subject = [[html.escape(label), html.escape(value)] for label, value in checked.subject.items()]
    parts = [page.paragraph(verdict(findings), "verdict")]
    parts += [page.paragraph(finding.text, "warn") for finding in bad]
    parts += ["<h2>Scene</h2>", page.table(["", ""], subject)]
    parts += [page.note(finding.text) for finding in findings.of(Level.NOTE)]
    if checked.light.power:
        parts += ["<h2>Lamps</h2>", _lamps(checked.light)]
    parts += ["<h2>Views</h2>", _pictures(checked), _table(checked)]
    unseen = [
        [html.escape(name), f"{100 * part:.1f} %", f"{100 * unseen:.0f} %"]
        for name, part, unseen in checked.places.unseen_meshes[:MESHES]
        if unseen > 0.0
    ]
    parts.append("<h2>Surfaces that no training photograph shows</h2>")
    parts.append(page.table(["mesh", "of all surface", "of it unseen"], unseen))
    return [*parts, "<h2>How to read this</h2>", *(page.note(text) for text in READING)]


def _lamps(light: Light) -> str:
    photographed = {lamp.name: lamp for lamp in light.lamps}
    rows = []
    for name, radiance, area, power in light.power:
        lamp = photographed.get(name)
        rows.append([html.escape(name), _three(radiance), f"{area:.3g}", f"{power:.3g}", _photographed(lamp)])
    head = ["lamp", "radiance (R, G, B)", "area", "power &pi;AL", "photographed over declared"]
    return page.table(head, rows)


def _photographed(lamp: PhotographedLamp | None) -> str:
    if lamp is None or lamp.pixels == 0:
        return "in no pixel alone"
    return _three(lamp.factor) if np.isfinite(lamp.factor).all() else "clipped in every photograph"


def _table(checked: Checked) -> str:
    rows, classes = [], {}
    for index in range(len(checked.looked)):
        row = _row(checked, index)
        shown = (_short(row[key], how) for key, (_, how) in SHOWN.items())
        rows.append([html.escape(str(row["view"])), str(row["part"]), *shown])
        if row["wrong"]:
            classes[index] = "failed"
    return page.table(["view", "part", *(heading for heading, _ in SHOWN.values())], rows, classes)


def _row(checked: Checked, index: int) -> dict[str, str | int | float | None]:
    """The facts of one view."""
    one, around = checked.looked[index], checked.places.around[index]
    facts, fit = one.facts, one.fit
    name = one.view.name
    return {
        "view": name,
        "part": one.part,
        "photograph": one.view.image,
        "wrong": "; ".join(finding.about for finding in checked.findings.bad(name)),
        **{key: None if facts is None else getattr(facts, key) for key in ("mean", "highest", "clipped", "black")},
        "exposure": _known(checked.light.exposures.get(name)),
        "surface": one.surface,
        "distance": _known(one.distance),
        "free": around.free,
        "width": _known(around.width),
        "backs": around.backs,
        "unseen": None if one.seen is None else float((one.seen == UNSEEN).mean()),
        "edges": 0 if fit is None else fit.places,
        "edge_rank": None if fit is None else fit.here,
        "edge_peak": None if fit is None else fit.peak,
        "edge_excess": None if fit is None else fit.excess,
        "offset": _known(checked.light.offsets.get(name)),
    }


def _pictures(checked: Checked) -> str:
    """Photographs with edges over them; of views with something wrong the bare photograph beside it."""
    findings = checked.findings
    order = sorted(range(len(checked.looked)), key=lambda i: not findings.bad(checked.looked[i].view.name))
    level = exposure(one.picture for one in checked.looked if one.picture is not None)
    parts, tiles = [], []
    for index in order[:VIEWS]:
        one = checked.looked[index]
        bad = findings.bad(one.view.name)
        drawn = page.tile(overlay(one, level), f"{one.view.name}, {one.part}", _caption(one, bad))
        if bad and one.picture is not None:
            bare = page.tile(encode(one.picture * np.float32(level)), f"{one.view.name}, the photograph alone")
            parts.append(f'<div class="row" style="--columns:2">{drawn}{bare}</div>')
        else:
            tiles.append(drawn)
    if tiles:
        parts.append(f'<div class="row" style="--columns:4">{"".join(tiles)}</div>')
    if len(order) > VIEWS:
        parts.append(page.note(f"{len(order) - VIEWS} further views are in {TABLE} alone."))
    return "\n".join(parts)


def overlay(one: Looked, level: float) -> Bytes:
    """A photograph, multiplied with ``level``, with edges over it [h, w, 3]; edges alone where there is none."""
    shape = (*one.mask.shape, 3)
    picture = np.full(shape, 40, np.uint8) if one.picture is None else encode(one.picture * np.float32(level))
    if one.seen is not None:
        picture = hatched(picture, one.seen[..., 0] == UNSEEN)
    picture[one.mask] = EDGE
    return picture


def _caption(one: Looked, bad: Sequence[Finding]) -> str:
    words = [f'<span class="warn">{html.escape(finding.sentence)}</span>' for finding in bad]
    if one.refused:
        return " ".join(words)
    if one.fit is not None:
        words.append(f"edge rank {one.fit.here:.2f}, peak {one.fit.peak:.1f}, excess {one.fit.excess:.2f}")
    return "<br>".join(words)


def _known(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def _short(value: str | int | float | None, how: str) -> str:
    return "" if value is None else value if isinstance(value, str) else f"{value:{how}}".removesuffix(".")


def _three(values: Array) -> str:
    return ", ".join(f"{float(x):.3g}" for x in values)
