"""Lamps in parts: what is connected, and that nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import lamp_room

from benchmarks.rooms.solids import ball
from neurad.core.errors import InputError
from neurad.scene import shining
from neurad.scene.builtin import build
from neurad.scene.builtin.shapes import join, quad
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts, segments
from neurad.scene.shining import lamps_in_parts

CENTRES = [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.0, 0.3, 0.0), (0.0, 0.0, 0.3)]


def chandelier(material=0):
    """Balls in one mesh, whose triangles come in random order."""
    solid = join(*(ball(centre, 0.05, 1.0) for centre in CENTRES))
    mesh = solid.mesh("bulbs", material, smooth_shading=True, radiance=np.ones(3, np.float32))
    return replace(mesh, faces=np.random.default_rng(0).permutation(mesh.faces))


def corners(meshes):
    """Of all triangles, position, normal and texture coordinates side by side, sorted."""
    rows = [
        np.concatenate([values[mesh.faces].reshape(len(mesh.faces), -1) for values in
                        (mesh.vertices, mesh.normals, mesh.uvs)], 1)
        for mesh in meshes
    ]  # fmt: skip
    rows = np.concatenate(rows)
    return rows[np.lexsort(rows.T)]


def test_only_lamps_are_split_and_nothing_moves():
    room = lamp_room()
    plain = replace(chandelier(), name="balls", radiance=None)
    scene = replace(room, meshes=[plain, *room.meshes, chandelier(3)])
    made = lamps_in_parts(scene)
    names = [mesh.name for mesh in made.meshes]
    assert names == [*(m.name for m in scene.meshes[:-1]), *(f"bulbs_{i}" for i in (1, 2, 3, 4))]
    assert all(a is b for a, b in zip(made.meshes, scene.meshes[:-1], strict=False))
    np.testing.assert_array_equal(corners(made.meshes[-4:]), corners(scene.meshes[-1:]))
    assert {(mesh.material, *mesh.radiance) for mesh in made.meshes[-4:]} == {(3, 1.0, 1.0, 1.0)}


def test_more_parts_than_photographs_tell_from_each_other_are_refused(monkeypatch):
    monkeypatch.setattr(shining, "MAX_PARTS", 3)
    scene = lamp_room()
    with pytest.raises(InputError, match=r"room: model.lighting.split_lamps is true, but mesh bulbs has 4 parts"):
        lamps_in_parts(replace(scene, meshes=[*scene.meshes, chandelier()]))


# ---- connected parts: whole lamps of a chandelier, chains of any length, and the nearest part of a position


def test_positions_find_their_part():
    geometry = Geometry(build("kitchen"))
    parts = SurfaceParts(geometry)
    assert 1 <= parts.count <= len(geometry.faces)
    prim = torch.arange(len(geometry.faces))
    middle = geometry.vertices[geometry.faces].mean(1)
    assert torch.equal(parts.at(middle), parts.of(prim))
    assert int(parts.of(torch.tensor([-1]))) == int(parts.of(torch.tensor([0])))


def test_segments_end_at_creases_and_small_ones_count_as_one():
    box = join(*(quad(*corner) for corner in [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0)), ((0, 0, 1), (1, 0, 0), (0, 1, 0)), ((0, 0, 0), (0, 0, 1), (0, 1, 0)),
        ((1, 0, 0), (0, 0, 1), (0, 1, 0)), ((0, 0, 0), (1, 0, 0), (0, 0, 1)), ((0, 1, 0), (1, 0, 0), (0, 0, 1)),
    ]))  # fmt: skip
    round_one = ball((5.0, 0.0, 0.0), 0.5, 1.0)
    scene = build("kitchen")
    meshes = [box.mesh("box", 0, smooth_shading=False), round_one.mesh("ball", 0, smooth_shading=True)]
    geometry = Geometry(replace(scene, meshes=meshes))
    found = segments(geometry, 0.5)
    sides, surface = found[:12], found[12:]
    assert len(sides.unique()) == 6
    assert torch.equal(sides[::2], sides[1::2])  # both triangles of a side
    assert len(surface.unique()) == 1
    assert not np.intersect1d(sides, surface).size
    assert len(segments(geometry, 1.5).unique()) == 2  # each side has an area of 1, the ball has more
