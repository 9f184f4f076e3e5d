"""Masks over lamps that light a room but are not in its photographs, as Blender's lamps are by default."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from neurad.core.camera import project, to_camera
from neurad.core.records import Bytes, Camera, Float64Array, Mesh

_BEFORE = 1e-4  # of the distance: what is nearer to the camera's plane is cut off
_EDGE = 3  # pixels of the line around a triangle: its edge is blurred by the filter of the picture


def mask_of(camera: Camera, lamps: Sequence[Mesh]) -> Bytes | None:
    """A picture that is black where a lamp may be [h, w], whatever stands before it; None where none is.

    Args:
        camera: without distortion.
        lamps: whose triangles are in world space.
    """
    from PIL import Image, ImageDraw

    mask = Image.new("L", (camera.width, camera.height), 255)
    draw = ImageDraw.Draw(mask)
    for lamp in lamps:
        corners: Any = to_camera(camera, torch.from_numpy(lamp.vertices.astype(np.float64))).numpy()
        for triangle in corners[lamp.faces]:
            polygon = _before(triangle, _BEFORE * float(np.abs(triangle).max()))
            if len(polygon) < 3:
                continue
            film = project(camera, torch.from_numpy(polygon)).numpy().clip(-1e6, 1e6)
            points = [(float(x) - 0.5, float(y) - 0.5) for x, y in film]
            draw.polygon(points, fill=0)
            draw.line([*points, points[0]], fill=0, width=_EDGE)
    kept = np.asarray(mask, np.uint8)
    return None if kept.all() else kept


def _before(triangle: Float64Array, near: float) -> Float64Array:
    """The part of a triangle before a camera that looks along -Z [n, 3]."""
    kept = []
    for a, b in zip(triangle, np.roll(triangle, -1, 0), strict=True):
        if a[2] < -near:
            kept.append(a)
        if (a[2] < -near) != (b[2] < -near):
            t = (-near - a[2]) / (b[2] - a[2])
            kept.append(a + t * (b - a))
    return np.array(kept).reshape(-1, 3)
