"""A small Cornell box whose lamp is of radiance 1 in the scene, and of its true radiance in the photographs."""

from dataclasses import replace

import numpy as np

from helpers.small_fit import photographed_cornell
from neurad.core.records import Camera

TRUTH = np.array([17.0, 12.0, 4.0])
"""Radiance in the photographs."""


def looking_up(scene, distance=0.9):
    """A camera below the lamp, which covers a part of its picture."""
    lamp = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks up: -z of the camera is +y
    pose[:3, 3] = lamp.vertices.mean(0) - [0.0, distance, 0.0]
    return Camera(pose, 1.0, 24, 24)


def unmeasured():
    """The box; the last photograph is of the lamp."""
    return declared(photographed_cornell(False, more=[looking_up]), 1.0)


def declared(scene, radiance):
    """The scene with lamps that are said to be of another radiance; its photographs stay."""
    value = np.full(3, radiance, np.float32)
    return replace(scene, meshes=[m if m.radiance is None else replace(m, radiance=value) for m in scene.meshes])
