"""The paper's closed cube: uniform diffuse walls, one ceiling light, cameras in the corners."""

from __future__ import annotations

import itertools

import numpy as np

from neurad.scene.builtin.plain import diffuse, room, views
from neurad.scene.builtin.shapes import join, quad
from neurad.scene.description import Scene

CORNER = 0.92


def build_cube(albedo: float = 0.5) -> Scene:
    """A closed cube of side 2 around the origin; walls and light reflect ``albedo``.

    Eight training views look inwards from the corners, two held-out ones from the middle of two edges.

    Raises:
        InputError: the albedo is not in [0, 1).
    """
    walls = join(*room((-1, -1, -1), (1, 1, 1)).values())
    light = quad((-0.4, 0.995, -0.4), (0.8, 0, 0), (0, 0, 0.8))
    meshes = [
        walls.mesh("walls", 0, smooth_shading=False),
        light.mesh("light", 1, smooth_shading=False, radiance=np.full(3, 5.0, np.float32)),
    ]
    corners = [(x * CORNER, y * CORNER, z * CORNER) for x, y, z in itertools.product((-1, 1), repeat=3)]
    train = [(eye, (0.2 * eye[2], -0.1 * eye[1], -0.2 * eye[0])) for eye in corners]
    test = [((0.0, -0.2, 0.9), (0.1, 0.0, 0.0)), ((-0.9, 0.3, 0.1), (0.0, 0.0, -0.1))]
    return Scene(
        name="cube",
        meshes=meshes,
        materials=[diffuse("walls", albedo), diffuse("light", albedo)],
        train=views("train", train, 80.0, 64),
        test=views("test", test, 80.0, 64),
        max_depth=1000,
    )
