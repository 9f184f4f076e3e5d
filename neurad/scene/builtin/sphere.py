"""The integrating sphere: one emitting patch, and the same reflected light everywhere."""

from __future__ import annotations

import math

import numpy as np

from neurad.core.records import IntArray, Mesh
from neurad.scene.builtin.plain import diffuse, views
from neurad.scene.description import Scene


def build_sphere(albedo: float = 0.5, subdivisions: int = 4, patch: float = 20.0, emission: float = 10.0) -> Scene:
    """A closed unit sphere seen from inside whose top emits; wall and patch both reflect ``albedo``.

    On a true sphere the light from the patch falls evenly on everything, so reflected radiance is
    ``emission * a * albedo / (1 - albedo)`` with ``a`` the patch's fraction of the area. Facets bias that a little.

    Args:
        albedo: of wall and patch.
        subdivisions: of the icosahedron, 20 * 4**subdivisions triangles.
        patch: half angle of the emitting cap in degrees.
        emission: radiance of the patch.

    Raises:
        InputError: the albedo is not in [0, 1).
    """
    import trimesh  # imported here: it loads slowly

    solid = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.round(np.asarray(solid.vertices), 6).astype(np.float32)
    faces = np.asarray(solid.faces, np.int64)[:, ::-1].copy()  # facing inwards
    height = vertices[faces].mean(axis=1)
    lit = height[:, 1] > math.cos(math.radians(patch)) * np.linalg.norm(height, axis=1)

    def part(name: str, triangles: IntArray, material: int, radiance: float | None) -> Mesh:
        used, index = np.unique(triangles, return_inverse=True)
        return Mesh(
            name=name,
            vertices=vertices[used],
            faces=index.reshape(-1, 3).astype(np.int64),
            material=material,
            radiance=None if radiance is None else np.full(3, radiance, np.float32),
        )

    train = [((0.5, 0.0, 0.0), (-1.0, 0.0, 0.0)), ((0.0, -0.3, 0.4), (0.2, 0.1, -1.0))]
    test = [((-0.2, 0.1, -0.4), (0.4, -0.6, 1.0))]
    return Scene(
        name="sphere",
        meshes=[part("wall", faces[~lit], 0, None), part("patch", faces[lit], 1, emission)],
        materials=[diffuse("wall", albedo), diffuse("patch", albedo)],
        train=views("train", train, 70.0, 32),
        test=views("test", test, 70.0, 32),
        max_depth=1000,
    )
