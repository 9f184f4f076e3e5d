"""Mutations of images, where something of their form stays."""

import io
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from helpers.fuzzing.odd import FLOATS, pick
from helpers.fuzzing.seeds import Files, file_of

CHANNELS = (
    ("R", "G", "B"), ("R", "G", "B", "A"), ("Y",), ("Z",), ("R", "G"), ("B", "A"), ("R", "G", "B", "A", "Z"),
    ("x.R", "x.G", "x.B"), ("a.R", "b.G", "c.B"), ("r", "g", "b"), ("X" * 200,), ("R", "G", "B", "Y"), ("",), ("é",),
    ("Y", "RY", "BY"),
)  # fmt: skip
MODES = (
    ("1", "PNG"), ("L", "PNG"), ("LA", "PNG"), ("P", "PNG"), ("RGB", "PNG"), ("RGBA", "PNG"), ("I;16", "PNG"),
    ("I", "TIFF"), ("F", "TIFF"), ("CMYK", "JPEG"), ("RGB", "GIF"), ("RGB", "BMP"), ("RGB", "TGA"), ("RGB", "JPEG"),
    ("RGB", "WEBP"), ("YCbCr", "TIFF"), ("LAB", "TIFF"), ("RGB", "PPM"), ("RGB", "PDF"), ("RGB", "ICO"),
)  # fmt: skip
SIZES = ((8, 8), (4, 8), (1, 1), (8, 9), (300, 1), (64, 64))


def exr_pixels(files: Files, i: int, j: int, k: int) -> None:
    """Odd values in one pixel, one channel or all of them; other channels, numbers of other types, another size."""
    name = file_of(files, (".exr",), i)
    if name is None:
        return
    pixels = np.full((*pick(SIZES, k // 5), 3), 0.5, np.float32) if k % 2 else _pixels(files[name])
    if pixels is None:
        return
    rows, _, channels = pixels.shape
    where = pick((..., (..., k // 6 % channels), (k // 6 % rows, -1)), k)
    pixels[where] = pick(FLOATS, j)
    names = pick(CHANNELS, k // 3) if k % 2 else {1: ("Y",), 3: ("R", "G", "B")}.get(channels, CHANNELS[1])
    kind = pick((np.float32, np.float32, np.float16, np.uint32), k // 7)
    with np.errstate(all="ignore"):
        files[name] = exr({n: pixels[..., c % channels].astype(kind) for c, n in enumerate(names)})


def bitmap_kind(files: Files, i: int, j: int, k: int) -> None:
    """A picture of another kind, whatever its ending says."""
    from PIL import Image

    name, file = file_of(files, (".png", ".hdr", ".pfm", ".exr"), i), io.BytesIO()
    if name is not None:
        mode, kind = pick(MODES, j)
        try:
            Image.new("L", pick(SIZES, k), 130).convert(mode).save(file, kind)
        except (OSError, ValueError, KeyError):
            return  # the library does not write such a thing
        files[name] = file.getvalue()


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


IMAGES = {f.__name__: f for f in (exr_pixels, bitmap_kind)}
