"""A closed Cornell box with two blocks."""

from __future__ import annotations

import numpy as np

from neurad.scene.builtin.plain import diffuse, room, views, with_files
from neurad.scene.builtin.shapes import box, quad, rotated
from neurad.scene.description import Scene

WHITE = (0.725, 0.71, 0.68)
RED = (0.63, 0.065, 0.05)
GREEN = (0.14, 0.45, 0.091)


def build_cornell() -> Scene:
    """The Cornell box of side 2 around the origin with a front wall behind the cameras; all surfaces diffuse."""
    colours = {"left": RED, "right": GREEN}
    materials, meshes = [], []
    solids = room((-1, -1, -1), (1, 1, 1))
    solids["tall block"] = rotated(box((-0.65, -1.002, -0.6), (-0.05, 0.2, 0.0)), 18.0, (-0.35, 0.0, -0.3))
    solids["short block"] = rotated(box((0.05, -1.002, -0.05), (0.65, -0.4, 0.55)), -17.0, (0.35, 0.0, 0.25))
    for name, solid in solids.items():
        materials.append(diffuse(name, colours.get(name, WHITE)))
        meshes.append(solid.mesh(name, len(materials) - 1, smooth_shading=False))
    materials.append(diffuse("light", 0.5))
    light = quad((-0.25, 0.995, -0.2), (0.5, 0, 0), (0, 0, 0.4))
    radiance = np.array([17.0, 12.0, 4.0], np.float32)
    meshes.append(light.mesh("light", len(materials) - 1, smooth_shading=False, radiance=radiance))
    train = [
        ((0.0, 0.0, 0.95), (0.0, -0.1, 0.0)),
        ((-0.8, 0.3, 0.9), (0.2, -0.4, -0.2)),
        ((0.8, 0.3, 0.9), (-0.2, -0.4, -0.2)),
        ((-0.9, -0.5, 0.9), (0.4, -0.6, -0.4)),
        ((0.9, -0.5, 0.9), (-0.4, -0.4, -0.6)),
        ((0.9, 0.7, -0.9), (0.0, -0.6, 0.5)),
        ((-0.9, 0.7, -0.9), (0.2, -0.3, 0.6)),
        ((0.0, 0.8, -0.2), (0.05, -1.0, 0.3)),
    ]
    test = [((0.4, 0.2, 0.95), (-0.1, -0.3, -0.2)), ((-0.85, 0.1, 0.6), (0.6, -0.5, -0.1))]
    return Scene(
        name="cornell",
        meshes=meshes,
        materials=materials,
        train=with_files("cornell", views("train", train, 70.0, 64)),
        test=with_files("cornell", views("test", test, 70.0, 64)),
    )
