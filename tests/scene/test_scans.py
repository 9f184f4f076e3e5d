"""Meshes of scans: holes are closed and what has to be open stays so; planes are flat and nothing else is moved."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from neurad.core.scene_records import Mesh
from neurad.images.development import Photography
from neurad.scene.connected import welded_corners
from neurad.scene.description import Scene
from neurad.scene.flatten import flatten_planes, flattened
from neurad.scene.holes import close_holes

# ---- holes


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


# ---- planes


SIZE = np.array([4.0, 3.0, 2.5])
"""Of the room in metres."""


def room(longest=0.15):
    """A box seen from within, with vertex normals of its walls, finely divided."""
    whole = trimesh.creation.box(SIZE)
    whole.invert()
    vertices = whole.triangles.reshape(-1, 3)
    vertices, faces = trimesh.remesh.subdivide_to_size(vertices, np.arange(len(vertices)).reshape(-1, 3), longest)
    nearest, lanes = (0.5 * SIZE - np.abs(vertices)).argmin(-1), np.arange(len(vertices))
    normals = np.zeros_like(vertices, np.float32)
    normals[lanes, nearest] = -np.sign(vertices[lanes, nearest])
    return Mesh("room", vertices.astype(np.float32), faces, 0, normals=normals)


def bent(mesh):
    """With displacements of 5 mm along all axes, in waves half a metre long."""
    p = np.asarray(mesh.vertices, np.float64)
    waves = 0.005 * np.sin(4.0 * math.pi * p[:, [1, 2, 0]] + np.array([0.3, 1.0, 2.0]))
    return replace(mesh, vertices=(p + waves).astype(np.float32))


def to_walls(vertices):
    return np.asarray(np.abs(0.5 * SIZE - np.abs(vertices)).min(-1))


def test_walls_of_a_waved_room_are_flat_again():
    scan = bent(room())
    found = flatten_planes([scan])
    (mesh,) = found.meshes
    assert found.planes == 6
    assert found.share > 0.95
    # its displacements along a wall's normal have a root mean square of 3.5 mm
    assert found.moved == pytest.approx(0.005 / math.sqrt(2.0), rel=0.15)
    assert found.farthest < 0.015
    assert np.sqrt(np.square(to_walls(scan.vertices)).mean()) > 0.003
    assert np.sqrt(np.square(to_walls(mesh.vertices)).mean()) < 0.0006
    assert to_walls(mesh.vertices).max() < 0.002
    # what is of two walls is on both
    depth = np.abs(0.5 * SIZE - np.abs(np.asarray(mesh.vertices, np.float64)))
    before = np.sort(0.5 * SIZE - np.abs(room().vertices.astype(np.float64)), -1)
    edge = np.flatnonzero(before[:, 1] < 1e-6)
    assert len(edge) > 50
    assert np.sort(depth[edge], -1)[:, 1].max() < 0.002


def test_noise_is_taken_out_as_waves_are():
    mesh, rng = room(), np.random.default_rng(0)
    places, same = np.unique(mesh.vertices, axis=0, return_inverse=True)
    noise = 0.003 * rng.normal(size=places.shape)
    scan = replace(mesh, vertices=(mesh.vertices + noise[same.reshape(-1)]).astype(np.float32))
    found = flatten_planes([scan])
    assert found.planes == 6
    assert np.sqrt(np.square(to_walls(found.meshes[0].vertices)).mean()) < 0.0015  # beyond three deviations it stays


def test_normals_are_those_of_planes_and_triangles_stay_in_their_order():
    scan = bent(room())
    uvs = np.random.default_rng(0).random((len(scan.vertices), 2)).astype(np.float32)
    scan = replace(scan, uvs=uvs, attributes={"number": np.arange(len(scan.vertices), dtype=np.float32)[:, None]})
    (mesh,) = flatten_planes([scan]).meshes
    assert mesh.faces.shape == scan.faces.shape
    assert mesh.normals is not None
    assert mesh.uvs is not None
    assert np.array_equal(mesh.uvs[mesh.faces], uvs[scan.faces])
    assert np.array_equal(mesh.attributes["number"][mesh.faces][..., 0], scan.faces)
    assert np.abs(mesh.vertices[mesh.faces] - scan.vertices[scan.faces]).max() < 0.02
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    across /= np.linalg.norm(across, axis=-1, keepdims=True)
    cosine = (across[:, None] * mesh.normals[mesh.faces]).sum(-1).min(1)
    assert np.quantile(cosine, 0.03) > 0.9999  # but for slivers along edges


def test_modelled_rooms_stay_as_they_are():
    meshes = [room(9.0), room()]
    found = flatten_planes(meshes)
    assert found.planes == 0
    assert all(one is other for one, other in zip(found.meshes, meshes, strict=True))


@pytest.mark.parametrize("shape", ["ball", "pipe", "figure"])
def test_curved_scans_stay_as_they_are(shape):
    whole = trimesh.creation.icosphere(4) if shape != "pipe" else trimesh.creation.cylinder(1.0, 4.0, sections=48)
    if shape == "figure":  # bumps as large as a patch
        whole = whole.subdivide()
        whole.vertices *= 1.0 + 0.05 * np.sin(7.0 * whole.vertices).sum(-1, keepdims=True)
    vertices, faces = trimesh.remesh.subdivide_to_size(whole.vertices, whole.faces, 0.15)
    if shape == "pipe":  # without its ends
        faces = faces[np.abs(vertices[faces][..., 2]).min(1) < 1.99]
    scan = bent(Mesh(shape, vertices.astype(np.float32), faces, 0))
    found = flatten_planes([scan])
    assert found.share < 0.1


def test_a_shallow_dish_in_a_room_stays_one():
    """It is nowhere farther from a plane than the errors of the walls."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 21)))
    corner = (np.arange(20)[:, None] * 21 + np.arange(20)).ravel()
    faces = np.stack((corner, corner + 1, corner + 22, corner, corner + 22, corner + 21), -1).reshape(-1, 3)
    x = x + np.random.default_rng(0).uniform(-0.01, 0.01, x.size)  # no two triangles are one polygon
    dish = Mesh("dish", np.stack((x, y, 0.03 * (x * x + y * y)), -1).astype(np.float32), faces, 0)
    found = flatten_planes([bent(room()), dish])
    assert found.planes == 6
    assert np.array_equal(found.meshes[1].vertices, dish.vertices)


def test_what_stands_out_farther_than_the_errors_stays():
    """A panel that stands out by four centimetres is a plane of its own."""
    mesh = room(0.08)
    panel = np.abs(mesh.vertices[:, :2]).max(-1) < 0.5
    panel &= mesh.vertices[:, 2] < -1.2
    moved = np.asarray(mesh.vertices, np.float64)
    moved[panel, 2] += 0.04
    (made,) = flatten_planes([bent(replace(mesh, vertices=moved.astype(np.float32)))]).meshes
    inner = np.abs(mesh.vertices[:, :2]).max(-1) < 0.4
    inner &= mesh.vertices[:, 2] < -1.2
    x, y, z = made.vertices[: len(inner)][inner].astype(np.float64).T
    terms = np.stack((x, y, np.ones_like(x)), -1)
    plane = np.linalg.lstsq(terms, z, rcond=None)[0]
    assert terms @ plane == pytest.approx(z, abs=1e-5)
    assert z == pytest.approx(-1.21, abs=0.004)


def test_faces_of_a_board_stay_apart():
    """A table top of 8 mm, closed and in one piece, which waves bend as all else."""
    board = trimesh.creation.box((1.4, 1.0, 0.008))
    vertices, faces = trimesh.remesh.subdivide_to_size(board.vertices, board.faces, 0.1)
    board = Mesh("board", vertices.astype(np.float32), faces, 0)
    inner = (np.abs(vertices[:, :2]) < (0.65, 0.45)).all(-1)
    z = flatten_planes([bent(room()), bent(board)]).meshes[1].vertices[: len(vertices), 2]
    upper, lower = z[inner & (vertices[:, 2] > 0.0)], z[inner & (vertices[:, 2] < 0.0)]
    assert upper.min() - lower.max() == pytest.approx(0.008, abs=0.002)


def test_what_shines_plays_no_part():
    mesh = bent(room())
    lamp = mesh.of_triangles(np.arange(200))
    wall = mesh.of_triangles(np.arange(200, len(mesh.faces)))
    dark = flatten_planes([lamp, wall]).meshes
    lit = flatten_planes([replace(lamp, radiance=np.ones(3, np.float32)), wall]).meshes
    for one, other in zip(dark, lit, strict=True):
        assert np.array_equal(one.vertices, other.vertices)


def test_degenerate_triangles():
    scan = bent(room())
    scan = replace(scan, faces=np.concatenate((scan.faces, [[0, 0, 0], [1, 1, 2]])))
    empty = replace(scan, faces=scan.faces[:0])
    found = flatten_planes([empty, scan])
    assert found.meshes[0] is empty
    assert found.planes == 6
    assert np.isfinite(found.meshes[1].vertices).all()
    assert flatten_planes([]).meshes == []
    assert flatten_planes([empty]).meshes[0] is empty


def test_a_scene_says_what_was_flattened_and_only_where_asked():
    scene = Scene("room", [bent(room())], [])
    assert flattened(scene) is scene
    refined = flattened(replace(scene, photography=Photography(mesh="refine")))
    assert refined.meshes[0] is not scene.meshes[0]
    (note,) = [note for note in refined.notes if "scan" in note]
    assert "6 planes" in note
