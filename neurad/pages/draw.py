"""A sheet as one picture."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from neurad.core.records import Bytes
from neurad.pages.colours import ramp
from neurad.pages.sheet import BOX, Scale, Sheet, Tile

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

INK, PALE = (26, 26, 26), (96, 96, 96)
GAP = 10
HEADING, BAR, LINE = 18, 8, 15
"""Heights in pixels of a tile's heading, of a colour bar, and of a line of small text."""
SIZE = {"title": 16, "heading": 13, "small": 11}


def draw(sheet: Sheet) -> Bytes:
    """The sheet [h, w, 3] on white."""
    from PIL import Image, ImageDraw

    pictures = {tile.key: lettered(sheet, tile) for tile in sheet.tiles}
    height, width = next(iter(pictures.values())).shape[:2]
    rows = sheet.packed
    columns = max(map(len, rows))
    crops = sheet.cropped
    per_crop = max((sum(p.shape[1] + GAP for _, p in tiles) for _, tiles in crops), default=0)
    total = GAP + max(columns * (width + GAP), per_crop)
    title = _wrapped(sheet.title, _font("title", True), total - 2 * GAP)
    notes = [line for note in sheet.notes for line in _wrapped(note, _font("small"), total - 2 * GAP)]
    bars = [any(tile and tile.scale for tile in tiles) for tiles in rows]
    high = GAP + 22 * len(title) + sum(HEADING + height + (BAR + 2 * LINE if bar else 0) + GAP for bar in bars)
    high += sum(LINE + HEADING + tiles[0][1].shape[0] + GAP for _, tiles in crops if tiles)
    page = Image.new("RGB", (total, high + LINE * len(notes) + GAP), "white")
    pen = ImageDraw.Draw(page)
    y = GAP
    for line in title:
        pen.text((GAP, y), line, INK, _font("title", True))
        y += 22
    for tiles, bar in zip(rows, bars, strict=True):
        for column, tile in enumerate(tiles):
            if tile is None:
                continue
            x = GAP + column * (width + GAP)
            pen.text((x, y), _fitting(tile.heading, _font("heading", True), width), INK, _font("heading", True))
            page.paste(Image.fromarray(pictures[tile.key]), (x, y + HEADING))
            if tile.scale is not None:
                _bar(page, pen, tile.scale, x, y + HEADING + height + 3, width)
        y += HEADING + height + (BAR + 2 * LINE if bar else 0) + GAP
    for crop, squares in crops:
        pen.text((GAP, y), f"{crop.letter}: {crop.meaning}", INK, _font("small", True))
        x = GAP
        for tile, square in squares:
            pen.text((x, y + LINE), _fitting(tile.heading, _font("small"), square.shape[1]), PALE, _font("small"))
            page.paste(Image.fromarray(square), (x, y + LINE + HEADING))
            x += square.shape[1] + GAP
        y += LINE + HEADING + squares[0][1].shape[0] + GAP if squares else 0
    for note in notes:
        pen.text((GAP, y), note, PALE, _font("small"))
        y += LINE
    return np.asarray(page)


def lettered(sheet: Sheet, tile: Tile) -> Bytes:
    """The picture of a tile as it is to be displayed, with the letters of its crops."""
    from PIL import Image, ImageDraw

    picture = sheet.displayed(tile)
    if not sheet.crops:
        return picture
    page = Image.fromarray(picture)
    zoom, by = sheet.zoom
    font = _font("small", True)
    font = font.font_variant(size=max(font.size, page.width // 24))  # pages show wide pictures smaller
    for crop in sheet.crops:
        corner = (crop.x * zoom // by + 5, crop.y * zoom // by + 3)
        ImageDraw.Draw(page).text(corner, crop.letter, BOX, font, stroke_width=1, stroke_fill="black")
    return np.asarray(page)


def _bar(page: Any, pen: ImageDraw, scale: Scale, x: int, y: int, width: int) -> None:
    """A colour bar of the width of its tile, what its ends stand for, and its meaning."""
    from PIL import Image

    colours = ramp(scale.colours, width)[None].repeat(BAR, axis=0)
    page.paste(Image.fromarray(np.ascontiguousarray(colours)), (x, y))
    pen.rectangle((x, y, x + width - 1, y + BAR - 1), outline=PALE)
    font = _font("small")
    pen.text((x, y + BAR), scale.low, INK, font)
    pen.text((x + width - round(font.getlength(scale.high)), y + BAR), scale.high, INK, font)
    meaning = _fitting(scale.meaning, font, width)
    pen.text((x + (width - round(font.getlength(meaning))) // 2, y + BAR + LINE - 2), meaning, PALE, font)


@lru_cache
def _font(name: str, bold: bool = False) -> Any:
    """DejaVu Sans, which comes with matplotlib, or else Pillow's own."""
    import matplotlib
    from PIL import ImageFont

    path = Path(matplotlib.get_data_path()) / "fonts/ttf" / ("DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf")
    return ImageFont.truetype(str(path), SIZE[name]) if path.is_file() else ImageFont.load_default(SIZE[name])


def _fitting(text: str, font: Any, width: int) -> str:
    if font.getlength(text) <= width:
        return text
    while text and font.getlength(text + "\u2026") > width:
        text = text[:-1]
    return text + "\u2026"


def _wrapped(text: str, font: Any, width: int) -> list[str]:
    lines = [""]
    for word in text.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and font.getlength(longer) > width:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines
