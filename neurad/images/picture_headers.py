"""What picture files say of themselves: their size, read before a library allocates that much, which channels of an EXR
file are its picture, and what its primaries make of them, linear Rec.709 colours.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import BoolArray, Float64Array, FloatArray
from neurad.runtime.memory import reserve
from neurad.runtime.reading import native, regular_file, shown

SIDE = 1 << 16
"""Most pixels along a side."""
_RATIO = 1032  # of deflate at most
_DEFLATE = (0, 1, 2, 3, 5)  # compressions that are no better: none, RLE, ZIPS, ZIP, PXR24
_MAX_CHANNELS = 1024  # in all parts
_SAID = "it cannot be read as an EXR image"
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


@dataclass(frozen=True)
class ExrPart:
    """What matters of the header of one part: windows as (x0, y0, x1, y1), the names of channels, the compression."""

    name: str
    data: tuple[int, int, int, int]
    display: tuple[int, int, int, int]
    channels: tuple[str, ...]
    compression: int


def check_size(path: Path, width: int, height: int, needed: int, kept: int) -> None:
    """Check the size of a picture.

    Args:
        needed: bytes a pixel while it is read.
        kept: bytes a pixel afterwards.

    Raises:
        InputError: it has no pixels, too many, or more than there is memory for.
    """
    if not (1 <= width <= SIDE and 1 <= height <= SIDE):
        raise InputError(f"{shown(path)}: it says that it has {width} x {height} pixels; a side has 1 to {SIDE}")
    what = f"{shown(path)}: {width} x {height} pixels"
    reserve(what, needed * width * height, kept * width * height)


def check_exr(path: Path) -> tuple[int, int]:
    """Check the header of an EXR file, and return the width and height of what it displays."""
    x0, y0, x1, y1 = exr_parts(path)[0].display
    return x1 - x0 + 1, y1 - y0 + 1


def exr_parts(path: Path) -> list[ExrPart]:
    """The headers of an EXR file, of which there is one in most files.

    Raises:
        InputError: it is no flat EXR image, its windows are too large, or the file too short for them.
    """
    import OpenEXR

    regular_file(path)
    with native(path, _SAID):
        headers = [part.header for part in OpenEXR.File(str(path), header_only=True).parts]
        if any(header["type"] in (OpenEXR.deepscanline, OpenEXR.deeptile) for header in headers):
            raise InputError(f"{shown(path)}: it is a deep image, which is not supported")
        parts = [
            ExrPart(
                header.get("name", ""), _window(header["dataWindow"]), _window(header["displayWindow"]),
                tuple(channel.name for channel in header["channels"]), int(header["compression"]),
            )
            for header in headers
        ]  # fmt: skip
    count = sum(len(part.channels) for part in parts)
    if not 1 <= count <= _MAX_CHANNELS or not all(part.channels for part in parts):
        raise InputError(f"{shown(path)}: {_SAID}")
    least = 0
    for part in parts:
        for x0, y0, x1, y1 in (part.data, part.display):
            check_size(path, x1 - x0 + 1, y1 - y0 + 1, 8 * count, 4 * count)
        x0, y0, x1, y1 = part.data
        if part.compression in _DEFLATE:
            least += (x1 - x0 + 1) * (y1 - y0 + 1) * 2 * len(part.channels) // _RATIO
    if path.stat().st_size < least:
        raise InputError(f"{shown(path)}: {_SAID}")
    return parts


def _window(corners: tuple[Any, Any]) -> tuple[int, int, int, int]:
    (x0, y0), (x1, y1) = (corner.tolist() for corner in corners)
    return x0, y0, x1, y1


def check_hdr(path: Path, data: bytes) -> tuple[int, int]:
    """Check the first bytes of a Radiance picture, and return its width and height.

    Raises:
        InputError: it is none, too large, or the file is too short for its size.
    """
    head, separator, rest = data.partition(b"\n\n")
    line = rest.partition(b"\n")[0].split()
    if not head.startswith(b"#?") or not separator or len(line) != 4 or (line[0], line[2]) != (b"-Y", b"+X"):
        raise InputError(f"{shown(path)}: it is not a Radiance picture with rows from the top (-Y height +X width)")
    height, width = (_digits(path, word) for word in (line[1], line[3]))
    check_size(path, width, height, 32, 12)
    packed = 4 + 8 * -(-width // 127) if 8 <= width < 1 << 15 else 4 * width
    if path.stat().st_size < len(head) + height * packed:
        raise InputError(f"{shown(path)}: it ends before its {width} x {height} pixels")
    return width, height


def check_pfm(path: Path, data: bytes) -> None:
    """Check the first bytes of a PFM picture.

    Raises:
        InputError: it is none, too large, or the file is too short for its size.
    """
    words = data[:256].split(None, 4)
    if len(words) < 4 or words[0] not in (b"PF", b"Pf"):
        raise InputError(f"{shown(path)}: it is not a PFM picture")
    width, height = (_digits(path, word) for word in words[1:3])
    try:
        scale = float(words[3])
    except ValueError as error:
        raise InputError(f"{shown(path)}: the scale in its header is not a number") from error
    if not 0 < abs(scale) < 1e30:
        raise InputError(f"{shown(path)}: the scale in its header is {scale:g}")
    check_size(path, width, height, 32, 12)
    if path.stat().st_size < width * height * 4 * (3 if words[0] == b"PF" else 1):
        raise InputError(f"{shown(path)}: it ends before its {width} x {height} pixels")


def _digits(path: Path, word: bytes) -> int:
    if not word.isdigit() or len(word) > 9:
        raise InputError(f"{shown(path)}: its header says {shown(word.decode('ascii', 'backslashreplace'))} pixels")
    return int(word)


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
