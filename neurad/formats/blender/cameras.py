"""Blender's cameras."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Camera, FloatArray
from neurad.formats.cameras.intrinsics import FAR, SHAPE, make_camera, rigid
from neurad.runtime.numbers import LENGTH, matrix, number
from neurad.runtime.reading import shown


@dataclass(frozen=True)
class BlenderCamera:
    """A camera of a scene, or a frame of one that moves."""

    names: tuple[str, ...]
    """Its own name, and others that its photograph may have: the number of a frame."""
    to_world: FloatArray
    film: tuple[int, int]
    """Width and height of the pictures that Blender renders."""
    focal: tuple[float, float]
    """Focal lengths in pixels, along x and y."""
    centre: tuple[float, float]
    """Where its axis meets the film, in pixels from the upper left corner."""
    where: str
    """File and camera, for sentences."""

    def seen(self, width: int, height: int, what: str = "") -> Camera:
        """The camera with a film of so many pixels.

        Raises:
            InputError: it has other proportions, or sees an angle that is none of a pinhole.
        """
        x, y = width / self.film[0], height / self.film[1]
        if abs(x / y - 1.0) > SHAPE:
            raise InputError(
                f"{self.where} renders {self.film[0]} x {self.film[1]} pixels, but {what} has {width} x {height}"
            )
        values = {"fl_x": self.focal[0] * x, "fl_y": self.focal[1] * y}
        values |= {"cx": self.centre[0] * x, "cy": self.centre[1] * y}
        return make_camera(self.to_world, (width, height), "PINHOLE", values, self.where)


def camera_of(
    described: Mapping[str, Any], film: tuple[int, int], pixel_aspect: tuple[float, float], where: str
) -> BlenderCamera:
    """A perspective camera from Blender's numbers.

    The film is ``sensor`` mm wide along the side that the fit says, for AUTO the longer one; shifts are in units of
    that side.

    Args:
        described: ``names``, ``to_world``, ``lens``, ``sensor_width``, ``sensor_height``, ``sensor_fit``, ``shift_x``
            and ``shift_y``.
        film: width and height in pixels.
        pixel_aspect: width and height of a pixel.
        where: file and camera, for sentences.

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
    return BlenderCamera(
        tuple(described["names"]),
        rigid(pose.tolist(), f"{where}: its transform"),
        film,
        (focal, focal / tall),
        (0.5 * film[0] - shift[0] * across, 0.5 * film[1] + shift[1] * across / tall),
        where,
    )
