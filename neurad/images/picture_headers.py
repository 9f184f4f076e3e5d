"""What picture files say of their size, read before a library allocates that much."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neurad.core.errors import InputError
from neurad.runtime.memory import reserve
from neurad.runtime.reading import native, regular_file, shown

SIDE = 1 << 16
"""Most pixels along a side."""
_RATIO = 1032  # of deflate at most
_DEFLATE = (0, 1, 2, 3, 5)  # compressions that are no better: none, RLE, ZIPS, ZIP, PXR24
_MAX_CHANNELS = 1024  # in all parts
_SAID = "it cannot be read as an EXR image"


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
        width: in pixels.
        height: in pixels.
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
