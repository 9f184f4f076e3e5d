"""Pages: one HTML file each that needs nothing beside it and no network, for light and dark screens."""

import base64
import html
from collections.abc import Mapping, Sequence

from neurad.core.records import Bytes
from neurad.images.image_io import png
from neurad.pages.assets import SCRIPT, STYLE
from neurad.pages.colours import ramp
from neurad.pages.draw import lettered
from neurad.pages.sheet import Scale, Sheet, Tile

POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
"""Content policy for the browser: nothing is loaded from anywhere."""


def page(title: str, parts: Sequence[str]) -> str:
    """A whole page: a heading, plain text, and HTML below it."""
    head = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        '<meta name="viewport" content="width=device-width, initial-scale=1">',
        f'<meta http-equiv="Content-Security-Policy" content="{POLICY}">',
        '<meta name="color-scheme" content="light dark">',
        f"<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
    ]
    return "\n".join([*head, *parts, f"<script>{SCRIPT}</script></body></html>"]) + "\n"


def paragraph(text: str, style: str = "") -> str:
    """A paragraph of plain text."""
    return f'<p class="{style}">{html.escape(text)}</p>' if style else f"<p>{html.escape(text)}</p>"


def note(text: str) -> str:
    """A paragraph in small print."""
    return paragraph(text, "note")


def table(head: Sequence[str], rows: Sequence[Sequence[str]], classes: Mapping[int, str] | None = None) -> str:
    """A table of HTML cells, the first of each row its label; ``classes`` are styles of rows, by number."""
    lines = ["<tr>" + "".join(f"<th>{cell}</th>" for cell in head) + "</tr>"]
    classes = classes or {}
    for number, row in enumerate(rows):
        style = f' class="{classes[number]}"' if number in classes else ""
        lines.append(f"<tr{style}>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>")
    return f'<div class="scroll"><table>{"".join(lines)}</table></div>'


def tile(picture: Bytes, heading: str, caption: str = "", scale: Scale | None = None, name: str = "") -> str:
    """A picture [h, w, 3] that enlarges, its heading plain text and its caption HTML, in an element of this name."""
    title = html.escape(heading)
    bar = "" if scale is None else _bar(scale)
    identity = f' id="{html.escape(name)}"' if name else ""
    coded = base64.b64encode(png(picture)).decode("ascii")
    return (
        f'<figure class="tile"><figcaption><b>{title}</b></figcaption>'
        f'<img{identity} alt="{title}" tabindex="0" role="button" src="data:image/png;base64,{coded}">'
        f"{bar}{f'<figcaption>{caption}</figcaption>' if caption else ''}</figure>"
    )


def _slider(name: str, one: Tile, other: Tile, squares: str) -> str:
    """Two tiles over each other with a line between them that moves, and buttons that show one of both; the script
    takes their pictures from the elements named after ``name``. ``squares`` stand beside them, HTML.
    """
    before, after = html.escape(f"{name}-{one.key}"), html.escape(f"{name}-{other.key}")
    first, second = html.escape(one.heading), html.escape(other.heading)
    bar = "" if one.scale is None else _bar(one.scale)
    buttons = ((100, first), (50, "both"), (0, second))
    return (
        f'<figure class="slider" data-before="{before}" data-after="{after}"><figcaption>'
        + "".join(f'<button type="button" value="{at}">{word}</button>' for at, word in buttons)
        + f'</figcaption><div class="beside"><div><div class="box"><img alt="{second}"><img class="over" alt="{first}">'
        f'<span></span><input type="range" min="0" max="100" value="50" step="0.5" aria-label="{first} | {second}">'
        f"</div>{bar}</div>{squares}</div></figure>"
    )


def sheet(shown: Sheet, name: str) -> str:
    """A sheet: a slider for each pair with its crops beside it, then its rows, in elements named after ``name``."""
    by_key = {one.key: one for one in shown.tiles}
    pairs: dict[frozenset[str], tuple[Tile, Tile]] = {}
    for one in shown.tiles:
        if one.pair in by_key:
            pairs.setdefault(frozenset((one.key, one.pair)), (one, by_key[one.pair]))
    sliders: list[str] = []
    crops = shown.cropped
    for pair, (one, other) in pairs.items():
        squares = [
            tile(picture, f"{crop.letter}: {of.heading}")
            for crop, pieces in crops
            for of, picture in pieces
            if of.key in pair or (not sliders and of.pair not in by_key)
        ]
        across = 3 if len(pairs) == 1 and len(squares) > 4 else 2  # one slider takes the width, and has room beside it
        beside = f'<div class="squares" style="--across:{across}">{"".join(squares)}</div>' if squares else ""
        sliders.append(_slider(name, one, other, beside))
    said = [note(f"{crop.letter}: {crop.meaning}.") for crop, _ in crops] + [note(text) for text in shown.notes]
    last = [f"<div>{''.join(said)}</div>"]
    if len(sliders) > 1 and crops:  # there is a place beside them
        sliders, last = sliders + last, []
    least = 540 if crops else 340  # pixels of a slider, with squares beside it and without
    parts = [f'<div class="sliders" style="--least:{least}px">{"".join(sliders)}</div>', *last]
    widest = max(2, *map(len, shown.rows.values()))
    for tiles in shown.rows.values():
        cells = [
            "<figure></figure>"
            if one is None
            else tile(lettered(shown, one), one.heading, scale=one.scale, name=f"{name}-{one.key}")
            for one in tiles
        ]
        columns = len(tiles) if len(tiles) > 1 else widest  # one alone would be the largest of all
        parts.append(f'<div class="row" style="--columns:{columns}">{"".join(cells)}</div>')
    return "\n".join(parts)


def _bar(scale: Scale) -> str:
    stops = ", ".join("#" + bytes(colour.tolist()).hex() for colour in ramp(scale.colours, 16))
    ends = f"<span>{html.escape(scale.low)}</span><span>{html.escape(scale.high)}</span>"
    return (
        f'<div class="bar" style="background:linear-gradient(to right, {stops})"></div>'
        f'<div class="ends">{ends}</div><figcaption class="meaning">{html.escape(scale.meaning)}</figcaption>'
    )
