"""Connected parts: whole lamps of a chandelier, chains of any length, and the nearest part of a position."""

import numpy as np
import torch

from neurad.scene.builtin import build
from neurad.scene.builtin.shapes import ball, join, quad
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts, connected_parts

CENTRES = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.3)]


def balls():
    """Balls in one mesh, whose triangles come in random order."""
    mesh = join(*(ball(centre, 0.05, 1.0) for centre in CENTRES)).mesh("balls", 0, smooth_shading=True)
    return mesh, np.random.default_rng(0).permutation(mesh.faces)


def test_each_ball_is_a_part_and_they_are_counted_as_they_come():
    mesh, faces = balls()
    centre = mesh.vertices[faces].mean(1)
    nearest = np.linalg.norm(centre[:, None] - np.array(CENTRES), axis=-1).argmin(1)
    part = connected_parts(mesh.vertices, faces)
    assert len(np.unique(np.stack((part, nearest), 1), axis=0)) == len(CENTRES)
    first = [int(np.flatnonzero(part == index)[0]) for index in range(len(CENTRES))]
    assert first == sorted(first)


def test_vertices_at_one_place_connect_and_a_long_strip_is_one():
    quads = join(*(quad((0.1 * i, 0, 0), (0.1, 0, 0), (0, 0, 0.1)) for i in range(200)))
    mesh = quads.mesh("strip", 0, smooth_shading=False)
    vertices = np.round(mesh.vertices, 3)  # neighbours' sums differ in the last bit
    assert (connected_parts(vertices, mesh.faces) == 0).all()
    apart = vertices + np.repeat(np.arange(200), 4)[:, None] * np.float32(0.01)
    np.testing.assert_array_equal(connected_parts(apart, mesh.faces), np.repeat(np.arange(200), 2))


def test_positions_find_their_part():
    geometry = Geometry(build("kitchen"))
    parts = SurfaceParts(geometry)
    assert 1 <= parts.count <= len(geometry.faces)
    prim = torch.arange(len(geometry.faces))
    middle = geometry.vertices[geometry.faces].mean(1)
    assert torch.equal(parts.at(middle), parts.of(prim))
    assert int(parts.of(torch.tensor([-1]))) == int(parts.of(torch.tensor([0])))
