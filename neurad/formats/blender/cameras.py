"""Blender's cameras."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.formats.cameras.intrinsics import FAR, SceneCamera, rigid
from neurad.runtime.numbers import LENGTH, matrix, number
from neurad.runtime.reading import shown


def camera_of(
    described: Mapping[str, Any], film: tuple[int, int], pixel_aspect: tuple[float, float], where: str
) -> SceneCamera:
    """A perspective camera from Blender's numbers.

    The film is ``sensor`` mm wide along the side that the fit says, for AUTO the longer one; shifts are in units of
    that side.

    Args:
        described: ``names``, ``to_world``, ``lens``, ``sensor_width``, ``sensor_height``, ``sensor_fit``, ``shift_x``
            and ``shift_y``.
        film: width and height in pixels.
        pixel_aspect: width and height of a pixel.

    Raises:
        InputError: a number is out of range, or its transform shears it.
    """
    lens = number(described.get("lens"), f"{where}: its lens", 1e-6, FAR)
    sides = [number(described.get(f"sensor_{side}"), f"{where}: its sensor", 1e-6, FAR) for side in ("width", "height")]
    shift = [number(described.get(f"shift_{axis}"), f"{where}: its shift", -FAR, FAR) for axis in "xy"]
    tall = pixel_aspect[1] / pixel_aspect[0]  # of a pixel, over its width
    fit = described.get("sensor_fit")
    if fit not in ("AUTO", "HORIZONTAL", "VERTICAL"):
        raise InputError(f"{where}: its sensor_fit is {shown(repr(fit))}")
    wide = film[0] >= tall * film[1] if fit == "AUTO" else fit == "HORIZONTAL"
    across = film[0] if wide else tall * film[1]  # the side that the sensor lies along, in widths of a pixel
    focal = lens / sides[1 if fit == "VERTICAL" else 0] * across
    pose = matrix(described.get("to_world"), f"{where}: its to_world", -LENGTH, LENGTH)
    length = np.linalg.norm(pose[:3, :3], axis=0)
    if not length.all():
        raise InputError(f"{where}: its transform has a scale of 0")
    pose[:3, :3] /= length  # Blender's cameras have no scale
    if np.linalg.det(pose[:3, :3]) < 0:
        raise InputError(f"{where}: its transform mirrors it, which is not supported")
    centre = 0.5 - shift[0] * across / film[0], 0.5 + shift[1] * across / tall / film[1]
    return SceneCamera(
        tuple(described["names"]),
        rigid(pose.tolist(), f"{where}: its transform"),
        focal / tall / film[1],
        film,
        film[0] / film[1],
        where,
        tall,
        centre,
    )
