"""Which way is up, and the one rotation that turns it to where a format wants it."""

from __future__ import annotations

from typing import Literal

import numpy as np

from neurad.export.raster_kernels import Array
from neurad.scene.description import Scene

Up = Literal["x", "y", "z", "-x", "-y", "-z"]
UPS: tuple[Up, ...] = ("x", "y", "z", "-x", "-y", "-z")
_HALF = 0.5**0.5
TO_Y: dict[Up, tuple[float, float, float, float]] = {
    "y": (0.0, 0.0, 0.0, 1.0),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "z": (-_HALF, 0.0, 0.0, _HALF),
    "-z": (_HALF, 0.0, 0.0, _HALF),
    "x": (0.0, 0.0, _HALF, _HALF),
    "-x": (0.0, 0.0, -_HALF, _HALF),
}
"""Quaternions (x, y, z, w) that turn an up axis to +Y."""


def up_axis(scene: Scene) -> Up:
    """The axis that the cameras of a scene hold up on average; ``y`` without cameras."""
    ups = [view.camera.to_world[:3, 1] for view in (*scene.train, *scene.test)]
    mean = np.mean(ups, 0) if ups else np.array([0.0, 1.0, 0.0])
    axis = int(np.abs(mean).argmax())
    return UPS[axis + (3 if mean[axis] < 0 else 0)]


def rotation(up: Up) -> Array:
    """The matrix [3, 3] of :data:`TO_Y`."""
    x, y, z, w = TO_Y[up]
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def quaternion(matrix: Array) -> list[float]:
    """A rotation matrix [3, 3] as a unit quaternion (x, y, z, w)."""
    m = np.asarray(matrix, np.float64)
    # The largest component first: its square is at least a quarter.
    trace = np.array([m[0, 0] - m[1, 1] - m[2, 2], m[1, 1] - m[0, 0] - m[2, 2], m[2, 2] - m[0, 0] - m[1, 1], m.trace()])
    k = int(trace.argmax())
    if k == 3:
        q = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1.0 + trace[3]])
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = np.zeros(4)
        q[k], q[i], q[j], q[3] = 1.0 + trace[k], m[i, k] + m[k, i], m[j, k] + m[k, j], m[j, i] - m[i, j]
    return [float(x) for x in q / np.linalg.norm(q)]
