"""Mutations of images, where something of their form stays."""

import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from helpers.fuzzing.odd import FLOATS, INTEGERS, NUMBERS, pick
from helpers.fuzzing.seeds import Files, file_of, picture

CHANNELS = (
    ("R", "G", "B"), ("R", "G", "B", "A"), ("Y",), ("Z",), ("R", "G"), ("B", "A"), ("R", "G", "B", "A", "Z"),
    ("x.R", "x.G", "x.B"), ("a.R", "b.G", "c.B"), ("r", "g", "b"), ("X" * 200,), ("R", "G", "B", "Y"), ("",), ("é",),
    ("Y", "RY", "BY"),
)  # fmt: skip
WINDOWS = (
    (0, 0, 7, 7), (0, 0, 0, 0), (0, 0, -1, -1), (3, 3, 12, 12), (-5, -5, 2, 2), (100, 100, 107, 107),
    (0, 0, 199_999, 199_999), (0, 0, 2**31 - 2, 2**31 - 2), (-(2**31), -(2**31), 2**31 - 1, 2**31 - 1), (7, 7, 0, 0),
    (0, 0, 7, 99), (0, 0, 15, 15),
)  # fmt: skip
ATTRIBUTES = (b"dataWindow\0box2i\0", b"displayWindow\0box2i\0", b"channels\0chlist\0", b"compression\0compression\0",
              b"lineOrder\0lineOrder\0", b"pixelAspectRatio\0float\0", b"screenWindowWidth\0float\0",
              b"screenWindowCenter\0v2f\0", b"type\0string\0")  # fmt: skip
MODES = (
    ("1", "PNG"), ("L", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("RGB", "PNG"), ("RGBA", "PNG"), ("I;16", "PNG"),
    ("I", "TIFF"), ("F", "TIFF"), ("CMYK", "JPEG"), ("RGB", "GIF"), ("RGB", "BMP"), ("RGB", "TGA"), ("RGB", "JPEG"),
    ("RGB", "WEBP"), ("YCbCr", "TIFF"), ("LAB", "TIFF"), ("RGB", "PPM"), ("RGB", "PDF"), ("RGB", "ICO"),
)  # fmt: skip
SIZES = ((1, 1), (1, 7), (300, 1), (5, 4), (0, 0), (64, 64))
HEADERS = (
    "-Y 0 +X 0", "-Y -1 +X 8", "-Y 99999 +X 99999", "-Y 2147483647 +X 2147483647", "+Y 4 -X 8", "-Y 4", "-Y nan +X 8",
    "-Y 4 +X 8 ", "-Y 5 +X 8", "-Y 4 +X 9", "-Y 1" + "0" * 300 + " +X 8",
)  # fmt: skip


def exr_pixels(files: Files, i: int, j: int, k: int) -> None:
    """Odd values in one pixel, one channel or all of them."""
    name = file_of(files, (".exr",), i)
    if name is not None and (pixels := _pixels(files[name])) is not None:
        value = pick(FLOATS, j)
        if k % 3 == 0:
            pixels[...] = value
        elif k % 3 == 1:
            pixels[..., k // 3 % pixels.shape[2]] = value
        else:
            pixels[k // 3 % pixels.shape[0], -1] = value
        names = {1: ("Y",), 3: ("R", "G", "B"), 4: ("R", "G", "B", "A")}.get(pixels.shape[2], CHANNELS[6])
        files[name] = exr({n: pixels[..., c].copy() for c, n in enumerate(names)})


def exr_channels(files: Files, i: int, j: int, k: int) -> None:
    """Other channels, numbers of other types, another size."""
    name = file_of(files, (".exr",), i)
    if name is not None:
        size = pick(((8, 8), (8, 8), (4, 8), (1, 1), (8, 9), (16, 16)), k // 3)
        pixels = np.full(size, 0.5).astype(pick((np.float32, np.float16, np.uint32), k))
        files[name] = exr({n: pixels.copy() for n in pick(CHANNELS, j)})


def exr_parts(files: Files, i: int, j: int, k: int) -> None:
    """Several parts, tiles, or a file without pixels."""
    import OpenEXR

    name = file_of(files, (".exr",), i)
    if name is None:
        return
    half = np.full((8, 8), 0.5, np.float16)
    storage = pick((OpenEXR.scanlineimage, OpenEXR.tiledimage), k)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": storage}
    if storage == OpenEXR.tiledimage:
        header["tiles"] = OpenEXR.TileDescription()
    made = [OpenEXR.Part({**header, "name": f"p{n}"}, {c: half.copy() for c in "RGB"}, f"p{n}") for n in range(j % 3)]
    with TemporaryDirectory() as folder:
        try:
            OpenEXR.File(made).write(f"{folder}/x.exr")
        except (RuntimeError, ValueError, TypeError, OSError):
            return  # the library does not write such a thing
        files[name] = Path(f"{folder}/x.exr").read_bytes()


def exr_attribute(files: Files, i: int, j: int, k: int) -> None:
    """A number in a required attribute: of windows all four."""
    name = file_of(files, (".exr",), i)
    if name is None:
        return
    data, wanted = files[name], pick(ATTRIBUTES, j)
    at = data.find(wanted)
    if at < 0:
        return
    at += len(wanted)
    if b"box2i" in wanted:
        files[name] = data[: at + 4] + struct.pack("<4i", *pick(WINDOWS, k)) + data[at + 20 :]
    elif k % 2:
        files[name] = data[:at] + struct.pack("<i", pick(INTEGERS, k // 2)) + data[at + 4 :]  # its size
    else:
        files[name] = data[: at + 4] + struct.pack("<f", pick(FLOATS, k // 2)) + data[at + 8 :]


def bitmap_kind(files: Files, i: int, j: int, k: int) -> None:
    """A picture of another kind, whatever its ending says."""
    name = file_of(files, (".png", ".hdr", ".pfm", ".exr"), i)
    if name is None:
        return
    try:
        files[name] = picture(*pick(MODES, j), pick(SIZES, k))
    except (OSError, ValueError, KeyError, SystemError, ZeroDivisionError, MemoryError):
        files[name] = b""


def png_size(files: Files, i: int, j: int, k: int) -> None:
    """A header that promises another size, with a correct checksum."""
    name = file_of(files, (".png",), i)
    if name is None or len(files[name]) < 33:
        return
    data = bytearray(files[name])
    sizes = (0, 1, 20_000, 2**31 - 1, 5)
    data[16:24] = struct.pack(">II", pick(sizes, j), pick(sizes, k))
    data[24:26] = bytes(pick(((8, 2), (16, 2), (16, 0), (1, 3), (8, 6), (9, 9)), j // 5 + k // 5))
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    files[name] = bytes(data)


def float_map(files: Files, i: int, j: int, k: int) -> None:
    """A number in the header of an HDR or PFM file, or in its pixels."""
    name = file_of(files, (".hdr", ".pfm"), i)
    if name is None:
        return
    data = files[name]
    if name.endswith(".pfm") and k % 3:
        lines = data.split(b"\n", 3)
        if len(lines) > 3:
            odd = pick(NUMBERS, k // 3).encode()
            lines[j % 3] = pick((b"Pf", b"PF4", b"P6", b"PF "), k) if j % 3 == 0 else (odd if j % 2 else odd + b" 4")
            data = b"\n".join(lines)
    elif name.endswith(".pfm"):
        at = len(data) - 4 * (1 + j % 96)
        data = data[:at] + struct.pack("<f", pick(FLOATS, k // 3)) + data[at + 4 :]
    else:
        data = data.replace(b"-Y 4 +X 8", pick(HEADERS, j).encode()) if k % 2 else data.replace(
            b"FORMAT=32-bit_rle_rgbe", pick((b"FORMAT=32-bit_rle_xyze", b"", b"EXPOSURE=nan", b"FORMAT=x"), j)
        )  # fmt: skip
    files[name] = data


def _pixels(data: bytes) -> np.ndarray | None:
    from neurad.core.errors import InputError
    from neurad.images.image_io import read_exr

    with TemporaryDirectory() as folder:
        path = Path(folder) / "x.exr"
        path.write_bytes(data)
        try:
            return np.array(read_exr(path), np.float32)
        except (InputError, ValueError, MemoryError):
            return None  # an earlier mutation has broken it


def exr(channels: dict[str, np.ndarray]) -> bytes:
    """An EXR file; empty where the library does not write such channels."""
    import OpenEXR

    with TemporaryDirectory() as folder:
        try:
            OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(f"{folder}/x.exr")
        except (RuntimeError, ValueError, TypeError, OSError, UnicodeError):
            return b""
        return Path(f"{folder}/x.exr").read_bytes()


IMAGES = {f.__name__: f for f in (exr_pixels, exr_channels, exr_parts, exr_attribute, bitmap_kind, png_size, float_map)}
