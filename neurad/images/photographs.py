"""Photographs as files: EXR and Radiance pictures, and the codes of PNG, JPEG and TIFF, as linear radiance."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.records import Array, BoolArray, Bytes, Float64Array, FloatArray
from neurad.core.scene_records import Development, View
from neurad.images.image_io import as_light, check_film, data_window, opened, read_exr, read_mask
from neurad.images.picture_headers import check_exr, check_hdr, check_size, exr_parts
from neurad.images.response import linear_value, linear_values
from neurad.runtime.extras import needed
from neurad.runtime.numbers import PIXEL
from neurad.runtime.reading import exists, native, regular_file, shown

CODED = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
"""Endings of photographs of codes, which a response curve turns into linear values."""
READABLE = (".exr", ".hdr", *CODED)
"""Endings of all photographs, in the order in which a name without ending is looked for."""
RAW = (".arw", ".cr2", ".cr3", ".nef", ".dng", ".raf", ".rw2", ".orf", ".pef")
"""Endings of what cameras write before anything is developed."""
_ALPHA = 1.01  # coverage is at most 1, but for rounding and filters
WHOLE = 0.999
"""Alpha from which on a pixel is covered: renderers and half floats round 1 down to 0.9995."""
_BITS = 258  # TIFF's tag BitsPerSample
_PLANAR, _EXTRA = 284, 338  # PlanarConfiguration, ExtraSamples
_HEAD = 1 << 16  # bytes that have the header of a picture
_AT = 1e-4  # relative rounding at a ceiling
_SAID = "it cannot be read as an image"
_OTHER_SIZE = (
    "calibrate for the photographs at their own size (w and h in the camera file), or scale them to the camera's"
)

AS_IS = Development()
"""The development of photographs whose values are linear radiance."""


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels of a photograph, by its header."""
    ending = path.suffix.lower()
    if ending == ".hdr":
        return check_hdr(path, _first_bytes(regular_file(path), _HEAD))
    if ending not in CODED:
        return check_exr(path)
    with _header(path) as image:
        width, height = image.size
    check_size(path, width, height, 20, 16)
    return width, height


def largest_code(path: Path) -> int:
    """Largest code of a photograph's format, by its header: 255 or 65535; 0 where values are floating point.

    Raises:
        InputError: it cannot be read, or is a picture of codes that are no RGB or RGBA of 8 or 16 bits.
    """
    if path.suffix.lower() not in CODED:
        return 0
    with _header(path) as image:
        mode, bits = image.mode, 8
        if image.format == "PNG":
            bits = _first_bytes(path, 25)[24]
        elif image.format == "TIFF":
            bits = max(image.tag_v2.get(_BITS, (8,)))
            if bits == 16 and (image.tag_v2.get(_PLANAR, 1) == 2 or 1 in image.tag_v2.get(_EXTRA, ())):
                raise InputError(
                    f"{shown(path)}: TIFF of 16 bits is read with interleaved channels and colours that alpha does "
                    "not multiply; save it so, or as PNG"
                )
    if mode not in ("RGB", "RGBA", "P") or bits not in (8, 16):
        raise InputError(f"{shown(path)}: a photograph has channels RGB or RGBA of 8 or 16 bits, this one is {mode}")
    return (1 << bits) - 1


def format_of(path: Path) -> str:
    """``JPEG``, ``PNG`` or ``TIFF``: what a photograph of codes is, whatever its name ends in."""
    with _header(path) as image:
        return str(image.format)


def colour_profile(path: Path) -> str | None:
    """The description of the colour profile that a photograph of codes carries; None where it has none."""
    if path.suffix.lower() not in CODED:
        return None
    with _header(path) as image:
        profile = image.info.get("icc_profile")
    if not profile:
        return None
    from PIL import ImageCms  # few photographs have one, and it loads a library of its own

    try:
        return str(ImageCms.getProfileDescription(ImageCms.ImageCmsProfile(io.BytesIO(profile)))).strip()
    except (ImageCms.PyCMSError, OSError):
        return "one that cannot be read"


_MAGIC = {
    b"\x89PNG": ".png", b"\xff\xd8\xff": ".jpg", b"II*\0": ".tif", b"MM\0*": ".tif", b"\x76\x2f\x31\x01": ".exr",
    b"#?": ".hdr",
}  # fmt: skip


def kind_of(path: Path) -> str | None:
    """The ending that a photograph should have by its first bytes; None where these are of no kind that is read."""
    first = _first_bytes(path, 4)
    return next((ending for magic, ending in _MAGIC.items() if first.startswith(magic)), None)


def _first_bytes(path: Path, count: int) -> bytes:
    with native(path, _SAID), path.open("rb") as stream:
        return stream.read(count)


def _header(path: Path) -> Any:
    with native(path, _SAID):
        return opened(regular_file(path))


def _codes(path: Path, levels: int) -> Bytes | npt.NDArray[np.uint16]:
    """The codes of a photograph [h, w, 3 or 4]."""
    width, height = picture_size(path)
    if levels == 255:
        with _header(path) as image, native(path, _SAID):
            return np.asarray(image.convert("RGB") if image.mode == "P" else image)
    found = _by_opencv(path)  # Pillow reads colours with 8 bits
    if found.dtype != np.uint16 or found.shape[:2] != (height, width):
        raise InputError(f"{shown(path)}: {_SAID}")
    return found


def _by_opencv(path: Path) -> Array:
    """The values of a picture [h, w, 3 or 4] as its file has them."""
    with needed("cv2", "photos", f"{shown(path)}: a Radiance picture, or one of 16 bits,"):
        import cv2
    with native(path, _SAID):
        found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if found is None or found.ndim != 3 or found.shape[2] not in (3, 4):
        raise InputError(f"{shown(path)}: {_SAID}")
    return np.ascontiguousarray(found[..., [2, 1, 0, 3][: found.shape[2]]])


def _radiance(path: Path) -> FloatArray:
    """The values of a Radiance picture [h, w, 3], the exposures and primaries that its header says undone."""
    picture_size(path)
    pixels = _by_opencv(path).astype(np.float32, copy=False)
    head = _first_bytes(path, _HEAD).partition(b"\n\n")[0]
    said = [line.split(b"=", 1) for line in head.split(b"\n") if b"=" in line]
    try:
        exposures = [float(value) for key, value in said if key.strip() == b"EXPOSURE"]
        primaries = [[float(x) for x in value.split()] for key, value in said if key.strip() == b"PRIMARIES"]
    except ValueError as error:
        raise InputError(f"{shown(path)}: the EXPOSURE or PRIMARIES in its header are no numbers") from error
    exposure = math.prod(exposures)
    if not 0.0 < exposure < math.inf:
        raise InputError(f"{shown(path)}: the EXPOSURE in its header is {exposure:g}")
    return as_light(pixels / np.float32(exposure), {"chromaticities": primaries[-1]} if primaries else {}, path)


def read_photograph(path: str | Path, development: Development = AS_IS) -> FloatArray:
    """A photograph: linear RGB or RGBA [h, w, 3 or 4], colour premultiplied by alpha, the exposure divided out. Alpha
    that is 1 everywhere says nothing, and is left out.

    Args:
        development: how its values become radiance. Of codes without a response, sRGB's curve is undone.

    Raises:
        InputError: missing or unreadable, other channels, pixels that are not finite, negative or beyond what can be
            squared, or alpha above 1.
    """
    path = regular_file(path)
    ending = path.suffix.lower()
    if ending in CODED:
        levels = development.levels or largest_code(path)
        codes = _codes(path, levels)
        pixels = linear_values(development.response or "srgb", levels)[codes]
        if codes.shape[2] == 4:
            pixels[..., 3] = codes[..., 3] / np.float32(levels)
            pixels[..., :3] *= pixels[..., 3:]
    else:
        pixels = _radiance(path) if ending == ".hdr" else read_exr(path)
        _check(path, pixels)
    if pixels.shape[2] == 4 and pixels[..., 3].min() >= WHOLE:
        pixels = np.ascontiguousarray(pixels[..., :3])
    if development.gain != 1.0:
        pixels[..., :3] /= np.float32(development.gain)
    return pixels


def read_view(view: View) -> FloatArray:
    """The photograph of a view, see :func:`read_photograph`.

    Raises:
        InputError: as there, or it has another size than the camera.
    """
    assert view.image is not None
    pixels = read_photograph(view.image, view.development)
    check_film(view.image, pixels, view.camera, _OTHER_SIZE)
    return pixels


def check_view(view: View) -> None:
    """Read a photograph, its mask and its spread as a fit does."""
    read_view(view)
    kept_pixels(view)
    if view.spread is not None:
        read_spread(view)


def may_have_alpha(view: View) -> bool:
    """Whether the file of a view's photograph has an alpha channel, by its header."""
    assert view.image is not None
    path = regular_file(view.image)
    ending = path.suffix.lower()
    if ending in CODED:
        with _header(path) as image:
            return "A" in image.getbands()
    return ending == ".exr" and any(name.rpartition(".")[2] in "Aa" for p in exr_parts(path) for name in p.channels)


def kept_pixels(view: View) -> BoolArray | None:
    """Pixels of a view's photograph that count [h, w]: neither its mask nor a hint leaves them out, and they lie in the
    data window of its file, outside of which nothing is known. None where all do.

    Raises:
        InputError: the mask cannot be read; mask or photograph has another size than the camera; or the data window
            shows nothing.
    """
    kept = None if view.mask is None else read_mask(view)
    known = None
    linear = view.image is not None and Path(view.image).suffix.lower() not in (".hdr", *CODED)
    if view.image is not None and linear and exists(view.image):  # what is rendered may lack its photographs
        known = data_window(Path(view.image))
        if known is not None:
            check_film(view.image, known, view.camera, _OTHER_SIZE)
    parts = [part for part in (kept, known, None if view.left_out is None else ~view.left_out) if part is not None]
    return np.logical_and.reduce(parts) if parts else None


def ceiling_of(view: View) -> float:
    """Radiance from which on a view's photograph is clipped; infinite where it is not."""
    development = view.development
    if development.ceiling is None:
        return math.inf
    return linear_value(development.response, development.ceiling) / development.gain * (1.0 - _AT)


def read_spread(view: View) -> tuple[FloatArray, BoolArray]:
    """Standard deviation of a view's photographed radiance [h, w], the mean of its finite channels, and which channels
    are infinite [h, w, 3]: every exposure was clipped there, and the radiance is that of the photograph or more.

    Raises:
        InputError: the file cannot be read, has another size than the camera, or values that are negative or NaN.
    """
    assert view.spread is not None
    pixels = read_exr(view.spread, raw=True)
    check_film(view.spread, pixels, view.camera, "the spread is as large as its photograph")
    if not bool((pixels >= 0).all()):
        raise InputError(f"{shown(view.spread)}: a standard deviation in it is negative or not a number")
    clipped = np.isinf(pixels)
    count = np.maximum((~clipped).sum(-1), 1)
    found: FloatArray = np.where(clipped, 0.0, pixels).sum(-1) / (count * np.float32(view.development.gain))
    three = clipped[..., :3] if clipped.shape[2] >= 3 else np.repeat(clipped[..., :1], 3, -1)
    return found.astype(np.float32), three


def rounding(response: str, levels: int) -> tuple[Float64Array, Float64Array]:
    """Linear value of every code [levels + 1], rising, and the variance of what is rounded to it."""
    values = linear_values(response, levels).astype(np.float64)
    step = np.gradient(values)
    return values, np.asarray(step * step / 12.0)


def _check(path: Path, pixels: FloatArray) -> None:
    """Refuse pixels [h, w, c] that cannot be computed with."""
    if pixels.shape[2] not in (3, 4):
        raise InputError(f"{shown(path)}: a photograph has channels RGB or RGBA, this one has {pixels.shape[2]} in all")
    low, high = float(pixels.min(initial=0.0)), float(pixels.max(initial=0.0))  # both NaN if any pixel is
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError(f"{shown(path)}: it has pixels that are NaN or infinite ({_share(~np.isfinite(pixels))})")
    if low < 0:
        raise InputError(f"{shown(path)}: it has negative pixels ({_share(pixels < 0)}, down to {low:.3g})")
    if high > PIXEL:
        raise InputError(
            f"{shown(path)}: it has pixels above {PIXEL:g} ({_share(pixels > PIXEL)}, up to {high:.3g}), whose squares "
            "leave 32 bits: scale the photographs and the lights"
        )
    if pixels.shape[2] == 4 and (alpha := float(pixels[..., 3].max(initial=0.0))) > _ALPHA:
        raise InputError(f"{shown(path)}: its alpha is up to {alpha:.3g}, but means coverage, from 0 to 1")


def _share(wrong: BoolArray) -> str:
    """How many pixels [h, w, c] are marked in any channel."""
    return f"{int(wrong.any(-1).sum())} of {wrong.shape[0] * wrong.shape[1]}"
