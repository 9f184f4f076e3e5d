"""Which channels of an EXR file are its picture, and what its primaries make of them: linear Rec.709 colours."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import BoolArray, Float64Array, FloatArray
from neurad.images.picture_headers import ExrPart
from neurad.runtime.reading import shown

_COMBINED = "Combined"  # Blender's name of the picture among its passes
_COMPOSITE = "Composite.Combined"  # of what its compositor makes of them
_D65 = (0.3127, 0.3290)
_ACES = (0.32168, 0.33767)
REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *_D65)
"""Chromaticities x, y of red, green, blue and white that a file without any has."""
_XYZ = (1.0, 0.0, 0.0, 1.0, 0.0, 0.0)
_KNOWN = {
    "ACEScg (AP1)": (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, *_ACES),
    "ACES2065-1 (AP0)": (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.0770, *_ACES),
    "Rec.2020": (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *_D65),
    "P3 D65": (0.680, 0.320, 0.265, 0.690, 0.150, 0.060, *_D65),
    "CIE XYZ": (*_XYZ, 1 / 3, 1 / 3),
}
_ROUNDED = 1e-3  # of chromaticities
_BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])


def picture_in(parts: Sequence[ExrPart], path: Path) -> tuple[int, dict[str, str]]:
    """Where the picture of a file is: the number of a part, and the names of its channels by what they are, ``R``,
    ``G``, ``B`` and perhaps ``A``, or the only channel of the file by its own name.

    Channels without a layer come first, then the layer ``Combined`` of Blender, then what the first of several parts
    has, then the only layer of colours. Depth, normals and other passes beside it are not looked at.

    Raises:
        InputError: there are no colours, or several layers of them.
    """
    if sum(len(part.channels) for part in parts) == 1:
        return 0, {name: name for name in parts[0].channels}
    found: dict[tuple[int, str], dict[str, str]] = {}
    for index, part in enumerate(parts):
        for name in part.channels:
            layer, _, channel = name.rpartition(".")
            found.setdefault((index, layer), {})[channel.upper() if channel in "rgba" else channel] = name
    colours = {key: names for key, names in found.items() if {"R", "G", "B"} <= names.keys()}
    title = {(i, layer): ".".join(filter(None, (parts[i].name, layer))) for i, layer in colours}
    combined = [key for key in colours if f".{title[key]}".endswith(f".{_COMBINED}")]
    combined = [key for key in combined if title[key].endswith(_COMPOSITE)] or combined
    chosen = [(0, "")] if (0, "") in colours and (len(parts) == 1 or not combined) else combined or list(colours)
    if len(chosen) > 1:
        names = ", ".join(shown(title[key]) for key in chosen)
        raise InputError(f"{shown(path)}: it has several pictures, {names}; write a file for each")
    if not chosen:
        names = ", ".join(shown(name) for part in parts for name in sorted(part.channels))
        raise InputError(f"{shown(path)}: its channels are {names}, not RGB, RGBA or a single one")
    return chosen[0][0], {name: colours[chosen[0]][name] for name in "RGBA" if name in colours[chosen[0]]}


def to_rec709(header: Mapping[str, Any]) -> tuple[Float64Array, str] | None:
    """What takes the colours of a file to linear Rec.709 [3, 3], and the name of its primaries; None where it has
    these, or says nothing.

    White is adapted by Bradford's method, as OpenEXR and OpenColorIO do, from the file's adopted neutral or white to
    D65. The coordinates of CIE XYZ are no colours relative to a white: they stay what they are.

    Raises:
        ValueError: the chromaticities are none of three primaries and a white.
    """
    said = header.get("chromaticities")
    if said is None:
        return None
    chromaticities = np.asarray(said, np.float64).reshape(8)
    if np.allclose(chromaticities, REC709, rtol=0, atol=_ROUNDED):
        return None
    is_xyz = np.allclose(chromaticities[:6], _XYZ, rtol=0, atol=_ROUNDED)
    neutral = header.get("adoptedNeutral", _D65 if is_xyz else chromaticities[6:])
    own, target = _to_xyz(chromaticities), _to_xyz(np.array(REC709))
    cones = [_BRADFORD @ _white(xy) for xy in (np.asarray(neutral, np.float64), np.array(_D65))]
    adapted = np.linalg.solve(_BRADFORD, np.diag(cones[1] / cones[0]) @ _BRADFORD)
    names = (name for name, known in _KNOWN.items() if np.allclose(chromaticities, known, rtol=0, atol=_ROUNDED))
    matrix = np.asarray(np.linalg.solve(target, adapted @ own), np.float64)
    if not np.isfinite(matrix).all():
        raise ValueError("chromaticities")
    return matrix, next(names, "other primaries")


def _white(xy: Float64Array) -> Float64Array:
    """XYZ of a chromaticity at luminance 1."""
    if not 1e-3 < xy[1] <= 1.0:
        raise ValueError("chromaticities")
    return np.asarray(np.array([xy[0], xy[1], 1.0 - xy.sum()]) / xy[1])


def _to_xyz(chromaticities: Float64Array) -> Float64Array:
    """From colours by primaries to XYZ [3, 3]: ones are white."""
    x, y = chromaticities[:6:2], chromaticities[1:6:2]
    primaries = np.stack((x, y, 1.0 - x - y))
    if abs(np.linalg.det(primaries)) < 1e-6:
        raise ValueError("chromaticities")
    return np.asarray(primaries * np.linalg.solve(primaries, _white(chromaticities[6:])))


def in_display(pixels: FloatArray, part: ExrPart) -> FloatArray:
    """Pixels [h, w, c] of the data window over the display window; outside they are those of its edge."""
    if part.data == part.display:
        return pixels
    x0, y0, x1, y1 = part.display
    rows = np.arange(y0, y1 + 1).clip(part.data[1], part.data[3]) - part.data[1]
    columns = np.arange(x0, x1 + 1).clip(part.data[0], part.data[2]) - part.data[0]
    return np.ascontiguousarray(pixels[np.ix_(rows, columns)])


def known_in_display(part: ExrPart) -> BoolArray | None:
    """Which pixels [h, w] of the display window lie in the data window; None where all do."""
    x0, y0, x1, y1 = part.display
    x, y = np.arange(x0, x1 + 1), np.arange(y0, y1 + 1)
    inside = [(axis >= low) & (axis <= high) for axis, low, high in ((y, *part.data[1::2]), (x, *part.data[::2]))]
    known: BoolArray = inside[0][:, None] & inside[1]
    return None if known.all() else known
