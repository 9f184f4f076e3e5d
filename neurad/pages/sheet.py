"""A sheet: pictures of a view in rows, with headings, colour bars, crops, and hatching of what no photograph shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from neurad.core.parameters import SurfaceParameter
from neurad.core.records import BoolArray, Bytes, FloatArray
from neurad.pages.colours import NUMBERS, enlarged, hatched, reduced, veiled, without_specks

MIN_WIDTH, MAX_WIDTH = 256, 512
"""Width in pixels that small pictures are at least enlarged to, and that large ones are reduced below twice of."""
CROP, CROP_WIDTH = 0.25, 168
"""Side of a crop over the shorter side of the view, and the largest width in pixels that it is enlarged to."""
SPECK = 6
"""Displayed pixels that a marked part of a picture is wide at least."""
BOX = (255, 64, 160)
"""Colour of the frame of a crop: one that no colour map here has."""


@dataclass(frozen=True)
class Scale:
    """A colour bar."""

    colours: str
    """A name that :func:`neurad.pages.colours.ramp` knows."""
    low: str
    """What the left end stands for."""
    high: str
    meaning: str
    """Quantity, unit, and which way is better."""


def scale_of(parameter: SurfaceParameter) -> Scale | None:
    """The colour bar of a map of a surface parameter; None of a colour."""
    return None if parameter.ends is None else Scale(NUMBERS, *parameter.ends, parameter.name)


@dataclass(frozen=True)
class Tile:
    """One picture of a sheet."""

    key: str
    """What it shows, such as ``albedo_true``; unique in its sheet."""
    heading: str
    picture: Bytes
    """[h, w, 3], the same size for all tiles of a sheet."""
    scale: Scale | None = None
    pair: str = ""
    """Key of the tile that it is to be compared with."""
    doubtful: BoolArray | None = None
    """Pixels [h, w] where what it shows is not determined."""


@dataclass(frozen=True)
class Crop:
    """A square of the view that is shown enlarged."""

    letter: str
    y: int
    x: int
    side: int
    meaning: str
    """Why this square."""


@dataclass
class Sheet:
    """Pictures of one view."""

    title: str
    rows: dict[str, list[Tile | None]] = field(default_factory=dict)
    """By label; None leaves a place empty."""
    unseen: BoolArray | None = None
    """Pixels [h, w] that are hatched in every tile."""
    crops: list[Crop] = field(default_factory=list)
    crop_keys: Sequence[str] = ()
    """Tiles that crops are taken of."""
    notes: list[str] = field(default_factory=list)
    widths: tuple[int, int] = (MIN_WIDTH, MAX_WIDTH)
    """In pixels, as :data:`MIN_WIDTH` and :data:`MAX_WIDTH`."""

    @property
    def tiles(self) -> list[Tile]:
        """All tiles in reading order."""
        return [tile for tiles in self.rows.values() for tile in tiles if tile is not None]

    @property
    def packed(self) -> list[list[Tile | None]]:
        """The rows, each beside the one before where both fit into the width of the widest."""
        most = max(len(tiles) for tiles in self.rows.values())
        lines: list[list[Tile | None]] = []
        for tiles in self.rows.values():
            if lines and len(lines[-1]) + len(tiles) <= most:
                lines[-1] += tiles
            else:
                lines.append([*tiles])
        return lines

    @property
    def zoom(self) -> tuple[int, int]:
        """By which whole number pictures are enlarged, and by which they are reduced; one of both is 1."""
        width = self.tiles[0].picture.shape[1]
        return max(1, -(-self.widths[0] // width)), max(1, width // self.widths[1])

    def displayed(self, tile: Tile) -> Bytes:
        """The picture of a tile as it is to be displayed: enlarged or reduced, hatched, crops framed."""
        zoom, by = self.zoom
        picture = self._marked(tile, np.s_[:, :], zoom, by)
        stroke = max(2, picture.shape[1] // 128)  # pages show wide pictures smaller
        for crop in self.crops:
            y, x, side = (round(pixels * zoom / by) for pixels in (crop.y, crop.x, crop.side))
            _frame(picture, y, x, side, stroke)
        return picture

    @property
    def cropped(self) -> list[tuple[Crop, list[tuple[Tile, Bytes]]]]:
        """Crops of the tiles :attr:`crop_keys`, enlarged by a whole number to at most :data:`CROP_WIDTH` pixels."""
        found = []
        for crop in self.crops if self.crop_keys else ():
            square = np.s_[crop.y : crop.y + crop.side, crop.x : crop.x + crop.side]
            by = max(1, -(-crop.side // CROP_WIDTH))
            zoom = max(1, CROP_WIDTH * by // crop.side)
            tiles = [tile for tile in self.tiles if tile.key in self.crop_keys]
            found.append((crop, [(tile, self._marked(tile, square, zoom, by)) for tile in tiles]))
        return found

    def _marked(self, tile: Tile, part: tuple[slice, slice], zoom: int, by: int) -> Bytes:
        """A part of a tile, enlarged or reduced, with what is not known in it."""
        picture = enlarged(reduced(tile.picture[part], by), zoom)
        for mask, mark in ((tile.doubtful, veiled), (self.unseen, hatched)):
            if mask is not None:
                picture = mark(picture, _fitting(mask[part], zoom, by, picture))
        return picture


def worst_squares(errors: Sequence[tuple[str, FloatArray]], count: int = 2) -> list[Crop]:
    """Squares where errors are largest, a square an error, apart from each other.

    Args:
        errors: what an error is of, in words, and its squares [h, w], 0 where it does not count; in order of weight.
    """
    crops: list[Crop] = []
    for meaning, error in errors:
        if len(crops) == count:
            break
        side = max(1, round(CROP * min(error.shape)))
        sums = np.pad(error.astype(np.float64), ((1, 0), (1, 0))).cumsum(0).cumsum(1)
        total = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
        for crop in crops:
            apart = np.s_[max(crop.y - side, 0) : crop.y + side, max(crop.x - side, 0) : crop.x + side]
            total[apart] = 0.0
        if total.max(initial=0.0) > 0:
            y, x = divmod(int(total.argmax()), total.shape[1])
            crops.append(Crop("ABCDEF"[len(crops)], y, x, side, meaning))
    return crops


def _fitting(mask: BoolArray, zoom: int, by: int, picture: Bytes) -> BoolArray:
    """A mask for a picture that was reduced and enlarged: of each block the pixel in its middle counts."""
    large: BoolArray = enlarged(without_specks(mask, -(-SPECK * by // zoom))[by // 2 :: by, by // 2 :: by], zoom)
    return large[: picture.shape[0], : picture.shape[1]]


def _frame(picture: Bytes, y: int, x: int, side: int, stroke: int) -> None:
    end_y, end_x = min(y + side, picture.shape[0]), min(x + side, picture.shape[1])
    picture[y:end_y, x : x + stroke] = picture[y:end_y, max(end_x - stroke, 0) : end_x] = BOX
    picture[y : y + stroke, x:end_x] = picture[max(end_y - stroke, 0) : end_y, x:end_x] = BOX
