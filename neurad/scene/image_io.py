"""Pictures in files: EXR pictures, bitmaps for textures, masks, and PNG previews."""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, View
from neurad.runtime.files import replacing
from neurad.runtime.reading import native, regular_file, shown
from neurad.scene.picture_headers import check_exr, check_size

_HALF_MAX = 65504.0
_ORDER = "RGBA"
_PNG_LEVEL = 5  # how hard files are compressed, of 9
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP", "GIF", "PPM", "JPEG2000", "DDS", "PCX", "SGI", "ICO")
"""What Pillow decodes itself: for others, such as EPS, it starts programs."""
_ROWS = 1 << 22  # pixels that are decoded at once
_DEPTH16 = ("I;16", "I;16L", "I;16B", "I")  # what Pillow calls a grey PNG of 16 bits; "I" in older versions


def to_srgb(linear: FloatArray) -> FloatArray:
    """The sRGB curve of linear values, clipped to [0, 1] (IEC 61966-2-1)."""
    x = np.clip(np.asarray(linear, np.float32), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, dtype=np.float32) - 0.055)


def from_srgb(encoded: FloatArray) -> FloatArray:
    """Linear values of sRGB-encoded ones in [0, 1]."""
    x = np.asarray(encoded, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def read_exr(path: str | Path) -> FloatArray:
    """The pixels of an EXR file [h, w, c] over its display window.

    Channels are RGB, RGBA, Y or a single one of any name, in a layer or not; half and float alike. Pixels outside the
    data window are 0.

    Raises:
        InputError: the file is missing or unreadable, or holds other channels.
    """
    import OpenEXR

    path = regular_file(path)
    check_exr(path)
    with native(path, "it cannot be read as an EXR image"):
        # The name of the option that separates the channels changed between versions: accept both.
        part = OpenEXR.File(str(path))
        header = part.header()
        found = {name: np.asarray(channel.pixels) for name, channel in part.channels().items()}
        return _displayed(_stacked(found, path), header)


def _stacked(found: Mapping[str, Any], path: Path) -> FloatArray:
    """Channels by name, each [h, w] or several interleaved [h, w, c], as one float32 array [h, w, c]."""
    layers = {name.rpartition(".")[0] for name in found}
    if len(found) == 1:
        pixels = np.ascontiguousarray(next(iter(found.values())), np.float32)
        return pixels if pixels.ndim == 3 else pixels[..., None]
    plain = {name.rpartition(".")[2]: pixels for name, pixels in found.items()}
    names = "".join(name for name in _ORDER if name in plain)
    shapes = {pixels.shape for pixels in plain.values()}
    if len(layers) > 1 or len(names) != len(found) or names not in ("RGB", "RGBA") or len(shapes) != 1:
        raise InputError(f"{path}: its channels are {', '.join(sorted(found))}, not RGB, RGBA or a single one")
    return np.stack([plain[name] for name in names], axis=-1).astype(np.float32)


def _displayed(pixels: FloatArray, header: Mapping[str, Any]) -> FloatArray:
    """Move pixels from the data window to the display window."""
    (dx0, dy0), (wx0, wy0) = (np.asarray(header[k][0], int) for k in ("dataWindow", "displayWindow"))
    wx1, wy1 = np.asarray(header["displayWindow"][1], int)
    shape = (int(wy1 - wy0 + 1), int(wx1 - wx0 + 1))
    if (dx0, dy0) == (wx0, wy0) and pixels.shape[:2] == shape:
        return pixels
    out = np.zeros((*shape, pixels.shape[2]), np.float32)
    y, x = int(dy0 - wy0), int(dx0 - wx0)
    y0, x0 = max(y, 0), max(x, 0)
    y1, x1 = min(y + pixels.shape[0], shape[0]), min(x + pixels.shape[1], shape[1])
    if y1 > y0 and x1 > x0:
        out[y0:y1, x0:x1] = pixels[y0 - y : y1 - y, x0 - x : x1 - x]
    return out


def write_exr(path: str | Path, pixels: FloatArray, half: bool = True) -> None:
    """Write [h, w, c] (c = 1, 3 or 4) as Y, RGB or RGBA; the same pixels give the same bytes.

    Args:
        path: file to write.
        pixels: linear values; as half floats what exceeds 65504 is written as 65504.
        half: 16 bits a value instead of 32.

    Raises:
        InputError: the file cannot be written.
    """
    import OpenEXR

    image = np.asarray(pixels, np.float32)
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise ValueError(f"an image is [h, w, 1, 3 or 4], not {image.shape}")
    if half:
        image = np.clip(image, -_HALF_MAX, _HALF_MAX).astype(np.float16)
    image = np.ascontiguousarray(image)
    name = {1: "Y", 3: "RGB", 4: "RGBA"}[image.shape[2]]
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    file = OpenEXR.File(header, {name: image[..., 0].copy() if name == "Y" else image})
    with replacing(path) as part:
        try:
            file.write(str(part))
        except RuntimeError as error:
            with part.open("ab", buffering=0) as again:
                again.write(b"\0")  # the system says again what is wrong, in a form that is known
            raise InputError(f"{path}: it cannot be written ({' '.join(str(error).split())})") from error


def write_png(path: str | Path, pixels: npt.NDArray[np.uint8]) -> None:
    """Write bytes [h, w, 3] as PNG.

    Raises:
        InputError: the file cannot be written.
    """
    with replacing(path) as part:
        part.write_bytes(png(pixels))


def png(pixels: npt.NDArray[np.uint8]) -> bytes:
    """An image [h, w, 3] or [h, w] as a PNG file, without a colour profile or alpha."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", compress_level=_PNG_LEVEL)
    return out.getvalue()


def read_bitmap(path: str | Path, raw: bool = False) -> FloatArray:
    """A texture as linear values [h, w, 1 or 3]; row 0 is the first of the file, alpha is dropped.

    8-bit and grey 16-bit files are divided by their largest value, and sRGB-decoded unless ``raw``; EXR files are
    linear. Pillow reads colour PNG files of 16 bits with 8.

    Raises:
        InputError: the file is missing or unreadable.
    """
    path = regular_file(path, "there is no such texture file")
    if path.suffix.lower() == ".exr":
        pixels = read_exr(path)
        return pixels[..., :3] if pixels.shape[2] > 1 else pixels
    return _decoded(path, raw)


def read_mask(view: View) -> npt.NDArray[np.bool_]:
    """What the mask of a view keeps of its photograph [h, w]: all that is not black.

    Raises:
        InputError: the file is missing, no picture, or of another size than the camera.
    """
    assert view.mask is not None
    path, camera = regular_file(view.mask), view.camera
    pixels = read_bitmap(path, raw=True)
    if pixels.shape[:2] != (camera.height, camera.width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        raise InputError(
            f"{shown(path)}: it has {size} pixels, its camera {camera.width} x {camera.height}; "
            "a mask is as large as its photograph"
        )
    return np.asarray((pixels > 0).any(-1))


def _decoded(path: Path, raw: bool) -> FloatArray:
    """The linear values [h, w, 1 or 3] of a file that Pillow reads."""
    said = "it cannot be read as an image"
    with native(path, said), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        image = opened(path)
    with image:
        grey = image.mode in ("1", "L", "LA", "F", *_DEPTH16)
        width, height = image.size
        check_size(path, width, height, 12 if grey else 20, 4 if grey else 12)
        with native(path, said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image.load()
            return _linear(image, raw)


def opened(path: Path) -> Any:
    """The picture of a file, not yet decoded."""
    from PIL import Image

    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # large textures are honest; check_size looks at the memory
    try:
        return Image.open(path, formats=_FORMATS)
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _linear(image: Any, raw: bool) -> FloatArray:
    """Linear values [h, w, 1 or 3] of a picture of Pillow's; of a large one strip by strip, as Pillow has copies."""
    width, height = image.size
    rows = max(_ROWS // width, 1)
    if rows >= height:
        return _strip(image, raw)
    first = _strip(image.crop((0, 0, width, rows)), raw)
    out = np.empty((height, *first.shape[1:]), np.float32)
    out[:rows] = first
    for top in range(rows, height, rows):
        bottom = min(top + rows, height)
        out[top:bottom] = _strip(image.crop((0, top, width, bottom)), raw)
    return out


def _strip(image: Any, raw: bool) -> FloatArray:
    if image.mode in _DEPTH16:
        value = np.asarray(image).astype(np.float32)[..., None] / 65535.0
        return value if raw else from_srgb(value)
    if image.mode == "F":
        return np.asarray(image, np.float32)[..., None].copy()
    grey = image.mode in ("1", "L", "LA")
    mode = "L" if grey else "RGB"
    coded = np.asarray(image if image.mode == mode else image.convert(mode))
    levels = np.arange(256, dtype=np.float32) / 255.0
    decoded: FloatArray = (levels if raw else from_srgb(levels))[coded]
    return decoded[..., None] if grey else decoded
