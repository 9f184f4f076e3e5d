"""What picture files say of their size, read before a library allocates that much."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from neurad.core.errors import InputError
from neurad.runtime.memory import reserve
from neurad.runtime.reading import failure, shown

SIDE = 1 << 16
"""Most pixels along a side."""
_MAGIC = 0x01312F76
_DEEP, _PARTS = 0x800, 0x1000  # flags of the version
_RATIO = 1032  # of deflate at most
_DEFLATE = (0, 1, 2, 3, 5)  # compressions that are no better: none, RLE, ZIPS, ZIP, PXR24
_NAME = 256  # longest name of an attribute
_MAX_PARTS = 1024


@dataclass
class ExrPart:
    """What matters of the header of one part: windows as (x0, y0, x1, y1), the names of channels, the compression."""

    name: str = ""
    data: tuple[int, int, int, int] = (0, 0, -1, -1)
    display: tuple[int, int, int, int] = (0, 0, -1, -1)
    channels: tuple[str, ...] = ()
    compression: int = 0


def check_size(path: Path, width: int, height: int, needed: int, kept: int) -> None:
    """Check the size of a picture.

    Args:
        path: of the file.
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
    """Check the header of an EXR file, and return the width and height of what it displays.

    Raises:
        InputError: as :func:`exr_parts`.
    """
    x0, y0, x1, y1 = exr_parts(path)[0].display
    return x1 - x0 + 1, y1 - y0 + 1


def exr_parts(path: Path) -> list[ExrPart]:
    """The headers of an EXR file, of which there is one in most files.

    Raises:
        InputError: it is no flat EXR image, its windows are too large, or the file too short for them.
    """
    try:
        with path.open("rb") as stream:
            parts = _exr_headers(path, stream)
    except (struct.error, EOFError, UnicodeError) as error:
        raise _unreadable(path) from error
    except OSError as error:
        raise failure(path, error) from error
    count = sum(len(part.channels) for part in parts)
    if not 1 <= count <= 1024 or not all(part.channels for part in parts):
        raise _unreadable(path)
    least = 0
    for part in parts:
        for x0, y0, x1, y1 in (part.data, part.display):
            check_size(path, x1 - x0 + 1, y1 - y0 + 1, 8 * count, 4 * count)
        x0, y0, x1, y1 = part.data
        if part.compression in _DEFLATE:
            least += (x1 - x0 + 1) * (y1 - y0 + 1) * 2 * len(part.channels) // _RATIO
    if path.stat().st_size < least:
        raise _unreadable(path)
    return parts


def _unreadable(path: Path) -> InputError:
    return InputError(f"{shown(path)}: it cannot be read as an EXR image")


def _exr_headers(path: Path, stream: BinaryIO) -> list[ExrPart]:
    magic, version = struct.unpack("<II", stream.read(8))
    if magic != _MAGIC or version & 0xFF != 2:
        raise _unreadable(path)
    if version & _DEEP:
        raise InputError(f"{shown(path)}: it is a deep image, which is not supported")
    parts: list[ExrPart] = []
    while (part := _attributes(stream)) is not None and len(parts) < _MAX_PARTS:
        parts.append(part)
        if not version & _PARTS:
            break
    return parts


def _attributes(stream: BinaryIO) -> ExrPart | None:
    """The attributes of one part, up to the empty name that ends them; None where there is no further part."""
    header = None
    while name := _word(stream):
        header = header or ExrPart()
        kind = _word(stream)
        (size,) = struct.unpack("<I", stream.read(4))
        if (name, kind) in ((b"dataWindow", b"box2i"), (b"displayWindow", b"box2i")):
            window = struct.unpack("<4i", stream.read(size))
            if name == b"dataWindow":
                header.data = window
            else:
                header.display = window
        elif (name, kind) == (b"compression", b"compression"):
            header.compression = stream.read(size)[0] if size == 1 else -1
        elif (name, kind) == (b"name", b"string") and size <= _NAME:
            header.name = stream.read(size).decode()
        elif (name, kind) == (b"channels", b"chlist"):
            end, found = stream.tell() + size, []
            while channel := _word(stream):
                found.append(channel.decode())
                stream.seek(16, 1)
            header.channels = tuple(found)
            stream.seek(end)
        else:
            stream.seek(size, 1)
    return header


def _word(stream: BinaryIO) -> bytes:
    """Bytes up to the next 0."""
    found = bytearray()
    while (byte := stream.read(1)) != b"\0":
        if not byte or len(found) >= _NAME:
            raise EOFError
        found += byte
    return bytes(found)


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
