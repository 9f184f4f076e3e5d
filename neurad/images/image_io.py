"""Pictures in files: EXR pictures, bitmaps for textures, masks, and PNG previews."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import BoolArray, Bytes, FloatArray
from neurad.core.scene_records import Camera, View
from neurad.images.picture_headers import check_size, exr_parts, in_display, known_in_display, picture_in, to_rec709
from neurad.images.picture_notes import note
from neurad.runtime.files import replacing
from neurad.runtime.reading import native, regular_file, shown

MAX_NEGATIVE = 0.01
"""Fraction of a picture's mean: a value that is no further below 0 is rounding, and taken as 0."""
MAX_RINGING = 0.25
"""How far below 0 Lanczos' filter takes the pixel beside a point or line of light, as a fraction of the brightest pixel
around."""
_LOBES = 3  # pixels that the filter reaches
_HALF_MAX, _HALF_NORMAL = 65504.0, 2.0**-14
_PNG_LEVEL = 5  # how hard files are compressed, of 9
_FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "TGA", "WEBP", "GIF", "PPM", "JPEG2000", "DDS", "PCX", "SGI", "ICO")
"""What Pillow decodes itself: for others, such as EPS, it starts programs."""
_AT_ONCE = 1 << 22  # pixels that are decoded
_DEPTH16 = ("I;16", "I;16L", "I;16B", "I")  # what Pillow calls a grey PNG of 16 bits; "I" in older versions


def to_srgb(linear: FloatArray) -> FloatArray:
    """The sRGB curve of linear values, clipped to [0, 1] (IEC 61966-2-1)."""
    x = np.clip(np.asarray(linear, np.float32), 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, dtype=np.float32) - 0.055)


def from_srgb(encoded: FloatArray) -> FloatArray:
    """Linear values of sRGB-encoded ones in [0, 1]."""
    x = np.asarray(encoded, np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)


def read_exr(path: str | Path, raw: bool = False) -> FloatArray:
    """The picture of an EXR file [h, w, c] over its display window: RGB, RGBA or a single channel of any name, see
    :func:`neurad.images.picture_headers.picture_in`. Pixels outside the data window are those of its edge.

    Colours by other primaries become linear Rec.709, and tiny negatives 0; both are noted. What is left below 0 is for
    the caller to refuse.

    Args:
        raw: its values are no light and no colours, and stay as they are.

    Raises:
        InputError: the file is missing or unreadable, or holds other channels.
    """
    import OpenEXR

    path = regular_file(path)
    parts = exr_parts(path)
    index, names = picture_in(parts, path)
    with native(path, "it cannot be read as an EXR image"):
        # By position: the name of the option that separates the channels changed between versions.
        part = OpenEXR.File(str(path), True).parts[index]
        header = part.header
        found = [np.asarray(part.channels[name].pixels) for name in names.values()]
    if len({channel.shape for channel in found}) > 1:
        raise InputError(f"{shown(path)}: its channels {', '.join(names)} differ in size")
    pixels = in_display(np.stack(found, axis=-1).astype(np.float32), parts[index])
    return pixels if raw else as_light(pixels, header, path)


def as_light(pixels: FloatArray, header: Mapping[str, Any], path: Path) -> FloatArray:
    """Pixels [h, w, c] by Rec.709's primaries, without negatives that filters and other primaries leave; may be the
    same array.

    Args:
        pixels: RGB, RGBA or a single channel.
        header: as :func:`neurad.images.picture_headers.to_rec709` reads it.
    """
    colours = pixels[..., :3]
    for values in (colours, pixels[..., 3:]):
        _cut_ringing(values, path)
    try:
        converted = to_rec709(header) if pixels.shape[2] > 1 else None
    except (ValueError, np.linalg.LinAlgError):
        note("its chromaticities are those of no primaries, and Rec.709 is taken", path)
        converted = None
    if converted is None:
        return pixels
    matrix, primaries = converted
    note(f"colours by the primaries of {primaries} are converted to linear Rec.709", path)
    good = colours.min(initial=0.0) >= 0.0
    colours[:] = colours @ matrix.T.astype(np.float32)
    outside = (colours < 0.0).any(-1)
    if good and outside.any():  # of bad values none are made good
        np.maximum(colours, 0.0, out=colours)
        note("{} pixels have colours outside of Rec.709, whose negative parts are taken as 0", path, int(outside.sum()))
    return pixels


def _cut_ringing(values: FloatArray, path: Path) -> None:
    """Set to 0 what is negative in values [h, w, c] by rounding or by a filter with negative lobes."""
    negative = values < 0.0
    if not negative.any() or not np.isfinite(values).all():
        return
    from scipy.ndimage import maximum_filter  # imported where it is needed: it loads slowly

    side = 2 * _LOBES + 1
    around = maximum_filter(values, (side, side, 1))
    bound = np.maximum(MAX_RINGING * around, MAX_NEGATIVE * np.maximum(values, 0.0).mean())
    if not (values[negative] >= -bound[negative]).all():
        return
    count, low = int(negative.any(-1).sum()), float(values.min())
    values[negative] = 0.0
    note(f"{{}} pixels are negative by rounding or filters (down to {low:.1g}), and are taken as 0", path, count)


def write_exr(path: str | Path, pixels: FloatArray, half: bool = True) -> None:
    """Write [h, w, c] (c = 1, 3 or 4) as Y, RGB or RGBA; the same pixels give the same bytes.

    Args:
        half: 16 bits a value instead of 32, where these hold the values: none is above 65504, and the picture is not so
            dark that bits are lost below 6.1e-5.

    Raises:
        InputError: the file cannot be written.
    """
    import OpenEXR

    image = np.asarray(pixels, np.float32)
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4):
        raise ValueError(f"an image is [h, w, 1, 3 or 4], not {image.shape}")
    image = np.ascontiguousarray(image.astype(np.float16) if half and _fits_half(image[..., :3]) else image)
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


def _fits_half(values: FloatArray) -> bool:
    """Whether half floats hold values: none is too large, and below their normal range, where bits are lost, no more
    is than the rounding of the median.
    """
    size = np.abs(values[values != 0])
    if size.max(initial=0.0) > _HALF_MAX:
        return False
    small = size[size < _HALF_NORMAL]
    if len(small) == 0:
        return True
    lost = np.abs(small.astype(np.float16).astype(np.float32) - small).max()
    return bool(lost <= np.median(size) * 2.0**-11)


def write_png(path: str | Path, pixels: Bytes) -> None:
    """Write bytes [h, w, 3] as PNG."""
    with replacing(path) as part:
        part.write_bytes(png(pixels))


def png(pixels: Bytes) -> bytes:
    """An image [h, w, 3] or [h, w] as a PNG file, without a colour profile or alpha."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG", compress_level=_PNG_LEVEL)
    return out.getvalue()


def read_bitmap(path: str | Path, raw: bool = False) -> FloatArray:
    """A texture as linear values [h, w, 1 or 3]; row 0 is the first of the file, alpha is dropped.

    8-bit and grey 16-bit files are divided by their largest value, and sRGB-decoded unless ``raw``; EXR files are
    linear, see :func:`read_exr`. Pillow reads colour PNG files of 16 bits with 8.

    Raises:
        InputError: the file is missing or unreadable.
    """
    path = regular_file(path, "there is no such texture file")
    if path.suffix.lower() == ".exr":
        pixels = read_exr(path)
        return pixels[..., :3] if pixels.shape[2] > 1 else pixels
    said = "it cannot be read as an image"
    with native(path, said):
        image = opened(path)
    with image:
        grey = image.mode in ("1", "L", "LA", "F", *_DEPTH16)
        width, height = image.size
        check_size(path, width, height, 12 if grey else 20, 4 if grey else 12)
        rows = max(_AT_ONCE // width, 1)
        out = np.empty((height, width, 1 if grey else 3), np.float32)
        with native(path, said):
            image.load()
            for top in range(0, height, rows):  # strip by strip, as Pillow has copies
                out[top : top + rows] = _strip(image.crop((0, top, width, min(top + rows, height))), raw)
        return out


def read_coded(data: bytes, where: str) -> Bytes:
    """The values [h, w, 3 or 4] of a picture in memory, PNG, JPEG or WebP, as they are coded; grey is repeated.

    Raises:
        InputError: it cannot be read, or is larger than there is memory for.
    """
    from PIL import Image

    said, stream = "it cannot be read as a PNG, JPEG or WebP picture", io.BytesIO(data)
    with native(where, said):
        image = opened(stream, ("PNG", "JPEG", "WEBP"))
    with image:
        width, height = image.size
        check_size(Path(where), width, height, 16, 4)
        with native(where, said):
            image.load()
            if image.mode in _DEPTH16:
                levels = (np.asarray(image, np.float32) / 257.0).round()
                image = Image.fromarray(levels.clip(0, 255).astype(np.uint8))
            clear = image.mode in ("LA", "PA", "RGBA", "La", "RGBa") or "transparency" in image.info
            return np.array(image.convert("RGBA" if clear else "RGB"))


def data_window(path: Path) -> BoolArray | None:
    """Which pixels [h, w] the picture of an EXR file has, of those that it displays; None where it has all.

    Raises:
        InputError: it is no EXR image, or has none of them.
    """
    parts = exr_parts(regular_file(path))
    known = known_in_display(parts[picture_in(parts, path)[0]])
    if known is not None and not known.any():
        raise InputError(f"{shown(path)}: its data window lies outside of what it displays, so it shows nothing")
    return known


def read_mask(view: View) -> BoolArray:
    """What the mask of a view keeps of its photograph [h, w]: all that is not black.

    Raises:
        InputError: the file is missing, no picture, or of another size than the camera.
    """
    assert view.mask is not None
    path = regular_file(view.mask)
    pixels = read_bitmap(path, raw=True)
    check_film(path, pixels, view.camera, "a mask is as large as its photograph")
    return np.asarray((pixels > 0).any(-1))


def check_film(path: str | Path, pixels: FloatArray | BoolArray, camera: Camera, advice: str) -> None:
    """Check that a file's picture [h, w, c] is as large as its camera's; if not, ``advice`` ends the sentence."""
    if pixels.shape[:2] != (camera.height, camera.width):
        raise InputError(
            f"{shown(path)}: it has {pixels.shape[1]} x {pixels.shape[0]} pixels, its camera {camera.width} x "
            f"{camera.height}; {advice}"
        )


def opened(file: Path | io.BytesIO, formats: tuple[str, ...] = _FORMATS) -> Any:
    """The picture of a file, not yet decoded."""
    from PIL import Image

    limit = Image.MAX_IMAGE_PIXELS
    Image.MAX_IMAGE_PIXELS = None  # large textures are honest; check_size looks at the memory
    try:
        return Image.open(file, formats=formats)
    finally:
        Image.MAX_IMAGE_PIXELS = limit


def _strip(image: Any, raw: bool) -> FloatArray:
    """Linear values [h, w, 1 or 3] of a picture of Pillow's."""
    if image.mode in _DEPTH16:
        value = np.asarray(image).astype(np.float32)[..., None] / 65535.0
        return value if raw else from_srgb(value)
    if image.mode == "F":
        return np.asarray(image, np.float32)[..., None]
    grey = image.mode in ("1", "L", "LA")
    mode = "L" if grey else "RGB"
    coded = np.asarray(image if image.mode == mode else image.convert(mode))
    levels = np.arange(256, dtype=np.float32) / 255.0
    decoded: FloatArray = (levels if raw else from_srgb(levels))[coded]
    return decoded[..., None] if grey else decoded
