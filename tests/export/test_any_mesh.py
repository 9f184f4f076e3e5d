"""Meshes of all kinds are baked, valid for others and rendered again."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.exported import Glb, exported
from helpers.pathtraced import picture
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, Material, Mesh
from neurad.formats.mitsuba.read import read_xml
from neurad.scene.builtin.plain import views
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene


def _mesh(vertices, faces, uvs=None):
    uvs = None if uvs is None else np.asarray(uvs, np.float32)
    return Mesh("m", np.asarray(vertices, np.float32), np.asarray(faces, np.int64), 0, uvs=uvs)


def _sheet(rng, count=8):
    """A wavy square of 2 count² triangles with coordinates of its own, some of them drawn in the other order."""
    x, y = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1))
    points = np.stack((x.ravel(), y.ravel(), 0.2 * rng.standard_normal(x.size)), 1)
    corner = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    faces = [np.stack((corner, corner + 1, corner + count + 2), 1)]
    faces += [np.stack((corner, corner + count + 2, corner + count + 1), 1)]
    return _mesh(points, np.concatenate(faces), points[:, :2])


def no_coordinates(rng):
    return replace(_sheet(rng), uvs=None)


def overlapping(rng):
    sheet = _sheet(rng)
    return replace(sheet, uvs=(sheet.uvs * rng.integers(2, 40)).astype(np.float32))


def mirrored(rng):
    sheet = _sheet(rng)
    return replace(sheet, uvs=np.stack((np.abs(sheet.uvs[:, 0] - 0.5), sheet.uvs[:, 1]), 1))


def wild_coordinates(rng):
    sheet = _sheet(rng)
    uvs = rng.standard_normal(sheet.uvs.shape).astype(np.float32) * 1e6
    uvs[rng.integers(len(uvs))] = 0.0
    return replace(sheet, uvs=uvs)


def one_triangle(rng):
    return _mesh(rng.standard_normal((3, 3)), [[0, 1, 2]])


def slivers(rng):
    sheet = _sheet(rng)
    return replace(sheet, vertices=sheet.vertices * np.float32([1, 10.0 ** -rng.integers(2, 8), 0]))


def no_area(rng):
    """A point, a line, and a triangle that has a corner twice."""
    points = np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2], [0.5, 1, 0.3]]) * rng.uniform(0.1, 2)
    return _mesh(points, [[0, 0, 0], [0, 1, 2], [0, 1, 1], [0, 3, 2]])


def loose(rng, count=300):
    points = rng.random((count, 1, 3)) + 0.05 * rng.standard_normal((count, 3, 3))
    return _mesh(points.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def flipped(rng):
    sheet = _sheet(rng)
    return replace(
        sheet, faces=np.where((np.arange(len(sheet.faces)) % 2 == 0)[:, None], sheet.faces, sheet.faces[:, ::-1])
    )


def non_manifold(rng):
    """Many triangles around one edge, and two sheets that meet in a point."""
    fan = [[0, 1, k] for k in range(2, 9)]
    return _mesh(rng.random((11, 3)), [*fan, [2, 9, 10]])


def coincident(rng):
    """The same triangles three times, once turned over."""
    sheet = _sheet(rng, 3)
    return replace(sheet, faces=np.concatenate((sheet.faces, sheet.faces, sheet.faces[:, ::-1])))


def unused_vertices(rng):
    sheet = _sheet(rng)
    vertices = np.concatenate((sheet.vertices, 100 * rng.standard_normal((5, 3))), dtype=np.float32)
    return replace(sheet, vertices=vertices, uvs=np.concatenate((sheet.uvs, np.full((5, 2), 7.0, np.float32))))


def bad_normals(rng):
    """Normals of no length, of a wrong length and against the triangle."""
    sheet = _sheet(rng)
    normals = rng.standard_normal(sheet.vertices.shape).astype(np.float32)
    normals[rng.random(len(normals)) < 0.3] = 0.0
    return replace(sheet, normals=normals * np.float32(10.0 ** rng.integers(-20, 20)))


def far_and_small(rng):
    sheet = _sheet(rng)
    return replace(sheet, vertices=sheet.vertices * np.float32(1e-3) + np.float32([3, 0, 0]))


KINDS = {
    f.__name__: f
    for f in (
        no_coordinates, _sheet, overlapping, mirrored, wild_coordinates, one_triangle, slivers, no_area, loose,
        flipped, non_manifold, coincident, unused_vertices, bad_normals, far_and_small,
    )
}  # fmt: skip
"""Functions of a random generator, by name."""


pytest.importorskip("xatlas")
pytest.importorskip("mitsuba")

SEEDS = st.integers(0, 1 << 16)
SOME = settings(max_examples=4, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))


def scene_of(meshes):
    """The meshes below a lamp, seen by two cameras."""
    half, rough = Constant(np.full(3, 0.5, np.float32)), Constant(np.full(1, 0.4, np.float32))
    paint = Material("paint", PrincipledModel(), half, rough)
    lamp = quad((-1, 3, -1), (2, 0, 0), (0, 0, 2)).mesh("lamp", 0, radiance=np.array([1.5, 2.0, 3.0], np.float32))
    named = [replace(mesh, name=f"{i}/ä {mesh.name}") for i, mesh in enumerate(meshes)]  # no name of a file
    eyes = [((0.5, 1.0, 4.0), (0.5, 0.5, 0.0)), ((-3.0, 1.5, 1.0), (0.5, 0.5, 0.0))]
    seen = {"train": views("train", eyes, 60.0, 16), "test": views("test", eyes[:1], 60.0, 16)}
    return Scene("odd", [*named, lamp], [paint], max_depth=4, **seen).check()


def check(meshes, folder, validator):
    """Export a scene of these meshes, and look at what came out."""
    scene = scene_of(meshes)
    room = exported(scene, folder / "room", overwrite=True)
    assert validator.issues(room / "scene.glb") == []
    found = list(Glb(room / "scene.glb").meshes())
    again = read_xml(room / "scene.xml").check()
    for mesh, (_, corners, _), read in zip(scene.meshes, found, again.meshes, strict=True):
        assert np.array_equal(corners.view(np.uint32), mesh.vertices[mesh.faces].view(np.uint32)), mesh.name
        assert np.array_equal(read.vertices[read.faces], mesh.vertices[mesh.faces]), mesh.name
    shown = picture(again, scene.test[0].camera, 1, 7)
    assert np.isfinite(shown).all()
    assert shown.min() >= 0.0


def test_every_kind_together(tmp_path, validator):
    rng = np.random.default_rng(0)
    meshes = [replace(make(rng), name=name) for name, make in KINDS.items()]
    check([*meshes, replace(loose(rng, 2000), name="many")], tmp_path, validator)


@SOME
@given(SEEDS, st.lists(st.sampled_from(sorted(KINDS)), min_size=1, max_size=4))
def test_any_few(tmp_path, validator, seed, kinds):
    rng = np.random.default_rng(seed)
    check([replace(KINDS[kind](rng), name=kind) for kind in kinds], tmp_path, validator)
