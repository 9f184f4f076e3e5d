"""A white room with two lamps, a bright card below one of them and a table, and photographs of it in memory."""

from dataclasses import replace

import numpy as np
import torch
import trimesh

from helpers.pathtraced import paths
from neurad.core.protocols import PhotoSource
from neurad.core.reflection import DiffuseModel
from neurad.core.scene_records import Constant, Material, Mesh, View
from neurad.integrators.film import render
from neurad.scene.builtin.plain import room
from neurad.scene.builtin.shapes import box, look_at, quad
from neurad.scene.description import Scene

SIZE = 28
CEILING, STRIP = np.array([6.0, 5.0, 4.0], np.float32), np.array([0.4, 1.2, 3.0], np.float32)
"""Radiance of the lamps."""
EVERYWHERE = (
    look_at((-0.8, 0.8, 0.8), (0.3, -0.3, -0.3), 80.0, SIZE),
    look_at((0.8, 0.7, 0.8), (-0.6, 0.0, -0.2), 80.0, SIZE),
    look_at((0.7, -0.6, -0.8), (-0.4, 0.5, 0.4), 80.0, SIZE),
    look_at((-0.7, 0.9, -0.8), (0.2, 0.3, 0.3), 80.0, SIZE),
    look_at((-0.3, -0.2, 0.8), (0.0, 1.0, -0.2), 80.0, SIZE),
)
DOWNWARDS = tuple(look_at((0.6, y, z), (0.7, -1.0, 0.2 * z), 60.0, SIZE) for y in (0.4, 0.9) for z in (-0.7, 0.7))
"""Cameras that see no lamp."""


class Photographs(PhotoSource):
    """Pixels [views, pixels, 3] in memory, at most of a ceiling."""

    has_alpha = False

    def __init__(self, pixels, ceiling=None):
        self.pixels = pixels if ceiling is None else pixels.clamp_max(ceiling)
        self.ceiling = ceiling

    def colors(self, view, pixel):
        return self.pixels[view, pixel]

    def clipped(self, view, pixel):
        return None if self.ceiling is None else self.colors(view, pixel) >= self.ceiling


def lamp_room(ceiling=CEILING, strip=STRIP, cameras=EVERYWHERE, **more):
    """The room; ``more`` are further parts of the scene."""

    def paint(name, albedo):
        return Material(
            name, DiffuseModel(), Constant(np.full(3, albedo, np.float32)), Constant(np.ones(1, np.float32))
        )

    materials = [paint("white", 0.85), paint("card", 0.95), paint("wood", 0.4), paint("black", 0.05)]
    parts = {name: (solid, 0, None) for name, solid in room((-1, -1, -1), (1, 1, 1)).items()}
    parts["card"] = (quad((-0.1, 0.6, -0.1), (0, 0, 0.2), (0.2, 0, 0)), 1, None)
    parts["table"] = (box((0.1, -1.0, -0.6), (0.7, -0.5, 0.1)), 2, None)
    parts["ceiling lamp"] = (quad((-0.3, 0.99, -0.3), (0.6, 0, 0), (0, 0, 0.6)), 3, ceiling)
    parts["strip"] = (quad((-0.99, -0.2, 0.2), (0, 0.4, 0), (0, 0, 0.5)), 3, strip)
    meshes = [s.mesh(name, m, smooth_shading=False, radiance=light) for name, (s, m, light) in parts.items()]
    views = [View(f"view_{i}", camera) for i, camera in enumerate(cameras)]
    return Scene("room", meshes, materials, train=views, **more)


def photographed(scene, spp=32, ceiling=None):
    tracer = paths(scene)
    pictures = [render(view.camera, tracer, spp, i).view(-1, 3) for i, view in enumerate(scene.train)]
    return Photographs(torch.stack(pictures), ceiling)


def in_one_mesh(scene):
    """The dark scene with all meshes joined, of one material, and the index of the mesh that each triangle was of."""
    first = np.cumsum([0, *(len(m.vertices) for m in scene.meshes)])
    faces = np.concatenate([m.faces + k for m, k in zip(scene.meshes, first, strict=False)])
    scan = Mesh("scan", np.concatenate([m.vertices for m in scene.meshes]), faces, 0)
    return replace(scene, meshes=[scan]), np.repeat(np.arange(len(scene.meshes)), [len(m.faces) for m in scene.meshes])


def scanned(cells):
    """A room as a scanner has it, in one welded mesh of many triangles: a round lamp in the ceiling and a square one in
    a wall end along triangles. Returns the dark scene, that which photographs are made of, and the lamps' triangles.
    """
    made = box((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)).mesh("scan", 0, smooth_shading=False)
    vertices, faces = made.vertices, made.faces[:, [0, 2, 1]]
    vertices, faces = trimesh.remesh.subdivide_to_size(vertices, faces, 2.0 * 2**0.5 / cells)
    vertices, weld = np.unique(vertices.round(6), axis=0, return_inverse=True)
    faces = weld[faces]
    rng, inside = np.random.default_rng(0), np.abs(vertices) < 0.999
    vertices = (vertices + inside * rng.uniform(-0.3, 0.3, vertices.shape) / cells).astype(np.float32)
    x, y, z = vertices[faces].mean(1).T
    lit = np.where((y > 0.99) & (np.hypot(x - 0.1, z + 0.1) < 0.4), 1, 0)
    lit[(x < -0.99) & (np.abs(y) < 0.2) & (np.abs(z - 0.4) < 0.25)] = 2
    scene = lamp_room()
    scan = Mesh("scan", vertices, faces, 0)
    parts = [replace(scan.of_triangles(np.flatnonzero(lit == k)), name=str(k), radiance=light)
             for k, light in enumerate((None, CEILING, STRIP))]  # fmt: skip
    return replace(scene, meshes=[scan]), replace(scene, meshes=parts), lit


def shining_area(scene, lamps):
    """Area of the triangles of a scene of one mesh [f], and whether each shines [f]."""
    (mesh,) = scene.meshes
    shines = np.zeros(len(mesh.faces), bool)
    for lamp in lamps:
        shines[slice(None) if lamp.triangles is None else list(lamp.triangles)] = True
    return trimesh.triangles.area(mesh.vertices[mesh.faces].astype(float)), shines


def names(scene, lamps):
    """Of the meshes that shine, with a minus before those that do to their backs."""
    return {("-" if lamp.turned else "") + scene.meshes[lamp.mesh].name for lamp in lamps}


def turned(scene, name):
    """The scene with one mesh inside out, and dark."""
    return replace(
        scene,
        meshes=[replace(m, faces=m.faces[:, [0, 2, 1]], radiance=None) if m.name == name else m for m in scene.meshes],
    )
