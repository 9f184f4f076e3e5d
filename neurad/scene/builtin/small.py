"""Small diffuse scenes: the Cornell box, the paper's cube, the white furnace and the integrating sphere."""

import itertools
import math
from dataclasses import replace

import numpy as np

from neurad.core.scene_records import Mesh
from neurad.scene.builtin.plain import diffuse, room, views, with_files
from neurad.scene.builtin.shapes import box, join, quad, rotated
from neurad.scene.description import Scene

WHITE = (0.725, 0.71, 0.68)
RED = (0.63, 0.065, 0.05)
GREEN = (0.14, 0.45, 0.091)
CORNER = 0.92


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


def build_cube(albedo: float = 0.5) -> Scene:
    """The paper's closed cube, of side 2 around the origin with a ceiling light; walls and light reflect ``albedo``.

    Eight training views look inwards from the corners, two held-out ones from the middle of two edges.
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


def build_furnace(albedo: float = 0.5, emission: float = 1.0) -> Scene:
    """A closed box whose sides all emit ``emission`` and reflect ``albedo``.

    Reflected radiance is ``albedo * emission / (1 - albedo)`` everywhere, its derivative
    ``emission / (1 - albedo)**2``. Paths are as long as they need: ``max_depth`` is 1000, roulette from 8.
    """
    solid = join(*room((-1.0, -0.75, -0.5), (1.0, 0.75, 0.5)).values())
    mesh = solid.mesh("walls", 0, smooth_shading=False, radiance=np.full(3, emission, np.float32))
    train = [((0.5, 0.2, 0.1), (-1.0, 0.0, 0.0)), ((-0.5, -0.3, 0.2), (1.0, 0.3, -0.2))]
    test = [((0.0, 0.3, -0.2), (0.3, -0.75, 0.1))]
    return Scene(
        name="furnace",
        meshes=[mesh],
        materials=[diffuse("walls", albedo)],
        train=views("train", train, 70.0, 32),
        test=views("test", test, 70.0, 32),
        max_depth=1000,
    )


def build_sphere(albedo: float = 0.5, subdivisions: int = 4, patch: float = 20.0, emission: float = 10.0) -> Scene:
    """A closed unit sphere seen from inside whose top emits; wall and patch both reflect ``albedo``.

    On a true sphere the light from the patch falls evenly on everything, so reflected radiance is
    ``emission * a * albedo / (1 - albedo)`` with ``a`` the patch's fraction of the area. Facets bias that a little.

    Args:
        subdivisions: of the icosahedron, 20 * 4**subdivisions triangles.
        patch: half angle of the emitting cap in degrees.
    """
    import trimesh  # imported here: it loads slowly

    solid = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = np.round(np.asarray(solid.vertices), 6).astype(np.float32)
    faces = np.asarray(solid.faces, np.int64)[:, ::-1].copy()  # facing inwards
    height = vertices[faces].mean(axis=1)
    lit = height[:, 1] > math.cos(math.radians(patch)) * np.linalg.norm(height, axis=1)

    whole = Mesh("wall", vertices, faces, 0)
    wall, cap = whole.of_triangles(np.flatnonzero(~lit)), whole.of_triangles(np.flatnonzero(lit))
    cap = replace(cap, name="patch", material=1, radiance=np.full(3, emission, np.float32))
    train = [((0.5, 0.0, 0.0), (-1.0, 0.0, 0.0)), ((0.0, -0.3, 0.4), (0.2, 0.1, -1.0))]
    test = [((-0.2, 0.1, -0.4), (0.4, -0.6, 1.0))]
    return Scene(
        name="sphere",
        meshes=[wall, cap],
        materials=[diffuse("wall", albedo), diffuse("patch", albedo)],
        train=views("train", train, 70.0, 32),
        test=views("test", test, 70.0, 32),
        max_depth=1000,
    )
