"""Holes of meshes: small ones in a surface are closed, and what has to be open stays so."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from neurad.core.scene_records import Mesh
from neurad.scene.connected import welded_corners
from neurad.scene.holes import close_holes


def of(shape, name="m", smooth=False):
    normals = np.asarray(shape.vertex_normals, np.float32) if smooth else None
    return Mesh(name, np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.int64), 0, normals=normals)


def grid(n=20, size=2.0, name="wall"):
    """A wall of ``size`` x ``size`` in the plane z = 0, of n x n quads, facing +z."""
    x, y = np.meshgrid(np.linspace(0, size, n + 1), np.linspace(0, size, n + 1), indexing="xy")
    i = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    quads = np.stack((i, i + 1, i + n + 2, i + n + 1), -1)
    vertices = np.stack((x.ravel(), y.ravel(), np.zeros(x.size)), -1).astype(np.float32)
    uvs = vertices[:, :2] / size
    return Mesh(name, vertices, np.concatenate((quads[:, [0, 1, 2]], quads[:, [0, 2, 3]])), 0, uvs=uvs)


def without(mesh, inside):
    """A mesh without the triangles whose middle is ``inside`` [f, 3] -> [f]."""
    return replace(mesh, faces=mesh.faces[~inside(mesh.vertices[mesh.faces].mean(1))])


def areas(mesh):
    """Vectors of the triangles, as long as their areas [f, 3]."""
    p = mesh.vertices[mesh.faces].astype(np.float64)
    return 0.5 * np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])


def test_holes_in_a_wall_are_closed_up_to_a_width_and_windows_stay_open():
    def inside(p):
        l_shaped = (p[:, :2] > 0.2).all(1) & (p[:, :2] < 0.5).all(1) & ((p[:, 0] < 0.4) | (p[:, 1] < 0.3))
        window = (p[:, :2] > 1.0).all(1) & (p[:, :2] < 1.8).all(1)
        touching = (np.abs(p[:, :2] - [0.65, 1.45]) < 0.05).all(1) | (np.abs(p[:, :2] - [0.75, 1.55]) < 0.05).all(1)
        return l_shaped | window | touching

    pierced = without(grid(), inside)
    closed = close_holes([pierced], 0.5)
    (mesh,) = closed.meshes
    assert closed.count == 3  # two touch in a vertex
    assert closed.area == pytest.approx(np.linalg.norm(areas(mesh).sum(0)) - np.linalg.norm(areas(pierced).sum(0)))
    assert np.linalg.norm(areas(mesh), axis=1).sum() == pytest.approx(4.0 - 0.64, abs=1e-5)  # no triangle twice
    assert (areas(mesh)[:, 2] >= 0).all()  # it faces as the wall does
    assert closed.open == pytest.approx([0.8 * np.sqrt(2.0)], abs=1e-5)
    np.testing.assert_allclose(mesh.uvs, mesh.vertices[:, :2] / 2.0, atol=1e-6)
    assert close_holes([pierced], 1.2).count == 4
    assert close_holes([pierced], 0.05).meshes[0] is pierced


@pytest.mark.parametrize("cut", ["side", "edge", "corner"])
def test_a_pierced_box_is_closed_again(cut):
    box = trimesh.creation.box((2.0, 2.0, 2.0))
    for _ in range(5):
        box = box.subdivide()
    centre = {"side": (0.1, 0.2, 1.0), "edge": (0.1, 1.0, 1.0), "corner": (1.0, 1.0, 1.0)}[cut]
    pierced = without(of(box), lambda p: np.linalg.norm(p - centre, axis=1) < 0.3)
    (mesh,) = close_holes([pierced], 0.9).meshes
    corners = welded_corners(mesh.vertices, mesh.faces)
    assert trimesh.Trimesh(np.arange(3 * (corners.max() + 1)).reshape(-1, 3), corners, process=False).is_watertight
    assert np.abs(areas(mesh).sum(0)).max() < 1e-4
