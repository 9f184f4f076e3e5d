"""Numbers as colours: the sRGB curve, and perceptual maps of roughness, of errors and of uncertainty; hatching."""

import numpy as np

from neurad.core.parameters import SurfaceParameter
from neurad.core.records import Array, BoolArray, Bytes, FloatArray
from neurad.images.image_io import to_srgb

BRIGHTEST = 0.25
"""Error, in albedo, roughness or display white, that is the brightest in an error map."""
NUMBERS, ERRORS, BARS = "viridis", "magma", "cividis"
"""Matplotlib's names of the colour maps of roughness and metalness, of errors, and of error bars: equal steps look
equal, also to colour-blind readers, and they must not be taken for each other."""
PERIOD, STROKE = 10, 2
"""Hatching in pixels: from line to line, and the width of each of its two colours."""


def encode(image: FloatArray) -> Bytes:
    """Linear values in [0, 1] as sRGB bytes [h, w, 3]; one channel becomes grey."""
    return np.round(to_srgb(np.broadcast_to(image, (*image.shape[:2], 3))) * 255).astype(np.uint8)


def encode_parameter(parameter: SurfaceParameter, values: FloatArray) -> Bytes:
    """A map of a surface parameter [h, w, c] as people look at it: a colour by the sRGB curve, a number by a scale."""
    return encode(values) if parameter.ends is None else false_colour(values, 1.0, NUMBERS)


def false_colour(error: FloatArray, scale: float, colours: str = ERRORS) -> Bytes:
    """The mean over channels of ``error`` [h, w, c], black at 0 and bright at ``1 / scale``."""
    from matplotlib import colormaps

    return np.asarray(colormaps[colours](np.clip(error.mean(axis=-1) * scale, 0, 1), bytes=True)[..., :3])


def ramp(colours: str, steps: int = 64) -> Bytes:
    """The colours of a map from low to high [steps, 3]."""
    return np.asarray(false_colour(np.linspace(0.0, 1.0, steps, dtype=np.float32)[None, :, None], 1.0, colours)[0])


def enlarged(picture: Array, zoom: int) -> Array:
    """Every pixel of [h, w, ...] as ``zoom`` x ``zoom`` equal ones: nothing is blurred."""
    return picture.repeat(zoom, axis=0).repeat(zoom, axis=1)


def reduced(picture: Bytes, by: int) -> Bytes:
    """Means over blocks of ``by`` x ``by`` pixels; what is left over at the right and lower edge is cut off."""
    if by == 1:
        return picture
    h, w = (side // by * by for side in picture.shape[:2])
    blocks = picture[:h, :w].reshape(h // by, by, w // by, by, -1)
    return np.asarray(np.round(blocks.mean((1, 3), dtype=np.float32)), np.uint8)


def hatched(picture: Bytes, mask: BoolArray) -> Bytes:
    """Diagonal lines, white beside black so that they show on any colour, over the pixels of a mask [h, w]."""
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    place = (x + y) % PERIOD
    out = picture.copy()
    out[mask & (place < STROKE)] = 255
    out[mask & (place >= STROKE) & (place < 2 * STROKE)] = 0
    return out


def without_specks(mask: BoolArray, side: int) -> BoolArray:
    """Those pixels of a mask [h, w] that lie in a square of ``side`` x ``side`` of it: in less no pattern shows, and it
    would look like broken pixels.
    """
    from scipy.ndimage import binary_opening

    return np.asarray(binary_opening(mask, np.ones((side, side))))


def veiled(picture: Bytes, mask: BoolArray) -> Bytes:
    """Thin pale lines the other way, through which the picture shows, over the pixels of a mask [h, w]."""
    y, x = np.ogrid[: mask.shape[0], : mask.shape[1]]
    lines = mask & ((x - y) % (PERIOD // 2) == 0)
    out = picture.copy()
    out[lines] = 255 - (255 - out[lines]) // 3
    return out
