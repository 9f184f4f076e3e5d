"""A small Cornell box whose lamp is of radiance 1 in the scene, and of its true radiance in the photographs."""

from dataclasses import replace
from functools import partial

import numpy as np

from helpers.small_fit import photographed_cornell
from neurad.assembly.build import build_world
from neurad.assembly.lighting import recovered_lamps, unknown_lamps
from neurad.assembly.settings import Lighting
from neurad.core.scene_records import Camera
from neurad.emitters.lights import make_lights

TRUTH = np.array([17.0, 12.0, 4.0])
"""Radiance in the photographs."""
LAMPS = Lighting(emitters="fit")


def with_lamps(scene, sky=None):
    """A world whose lamps are recovered, and these."""
    scene = scene if sky is None else replace(scene, environment=sky)
    world = build_world(scene)
    world.lights = make_lights(scene, world.geometry, None, unknown_lamps(scene, world.geometry, LAMPS))
    return world, recovered_lamps(world)


def looking_up(scene, distance):
    """A camera below the lamp, which covers a part of its picture."""
    lamp = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks up: -z of the camera is +y
    pose[:3, 3] = lamp.vertices.mean(0) - [0.0, distance, 0.0]
    return Camera(pose, 1.0, 24, 24)


def unmeasured(folder, distance=0.9):
    """The box, its photographs in ``folder``; the last one is of the lamp."""
    return declared(photographed_cornell(folder, False, more=[partial(looking_up, distance=distance)]), 1.0)


def declared(scene, radiance):
    """The scene with lamps that are said to be of another radiance; its photographs stay."""
    value = np.broadcast_to(radiance, 3).astype(np.float32)
    return replace(scene, meshes=[m if m.radiance is None else replace(m, radiance=value) for m in scene.meshes])
