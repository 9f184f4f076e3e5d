"""Lamps in parts: what is connected, and that nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lamp_room import lamp_room

from neurad.core.errors import InputError
from neurad.scene import lamp_parts
from neurad.scene.builtin.shapes import ball, join, quad
from neurad.scene.lamp_parts import lamps_in_parts, parts_of

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


def test_balls_are_parts_whatever_the_order_of_their_triangles():
    mesh = chandelier()
    centre = mesh.vertices[mesh.faces].mean(1)
    nearest = np.linalg.norm(centre[:, None] - np.array(CENTRES), axis=-1).argmin(1)
    part = parts_of(mesh)
    assert len(np.unique(np.stack((part, nearest), 1), axis=0)) == len(CENTRES)
    first = [int(np.flatnonzero(part == index)[0]) for index in range(len(CENTRES))]
    assert first == sorted(first)


def test_vertices_at_one_place_connect_and_a_long_strip_is_one():
    quads = join(*(quad((0.1 * i, 0, 0), (0.1, 0, 0), (0, 0, 0.1)) for i in range(200)))
    mesh = quads.mesh("strip", 0, smooth_shading=False, radiance=np.ones(3, np.float32))
    vertices = np.round(mesh.vertices, 3)  # neighbours' sums differ in the last bit
    assert (parts_of(replace(mesh, vertices=vertices)) == 0).all()
    apart = vertices + np.repeat(np.arange(200), 4)[:, None] * np.float32(0.01)
    np.testing.assert_array_equal(parts_of(replace(mesh, vertices=apart)), np.repeat(np.arange(200), 2))


def test_a_spiral_is_one_part_after_few_rounds(monkeypatch):
    """A bent tube, whose places are sorted across its turns: rounds grow with the logarithm of its length."""
    turns = np.linspace(0.0, 60.0 * np.pi, 4000)
    centre = np.stack((np.cos(turns), np.sin(turns), turns / 40.0), 1)
    side = np.concatenate((centre, centre + np.array([0.0, 0.0, 0.02]))).astype(np.float32)
    first = np.arange(3999)
    faces = np.concatenate(
        (np.stack((first, first + 1, first + 4000), 1), np.stack((first + 1, first + 4001, first + 4000), 1))
    )
    mesh = replace(chandelier(), vertices=side, faces=faces, normals=None, uvs=None)
    compared = []
    same = np.array_equal
    monkeypatch.setattr(np, "array_equal", lambda *pair: compared.append(1) or same(*pair))
    assert (parts_of(mesh) == 0).all()
    assert len(compared) < 60  # once a round and once a jump; hooked on one by one it took a round for each place


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


def test_names_that_are_taken_stay_with_whom_they_belong_to():
    scene = lamp_room()
    scene = replace(scene, meshes=[*scene.meshes, chandelier(), replace(chandelier(), name="bulbs_2", radiance=None)])
    names = [mesh.name for mesh in lamps_in_parts(scene).meshes]
    assert len(set(names)) == len(names)
    assert names[-1] == "bulbs_2"


def test_more_parts_than_photographs_tell_from_each_other_are_refused(monkeypatch):
    monkeypatch.setattr(lamp_parts, "MAX_PARTS", 3)
    scene = lamp_room()
    with pytest.raises(InputError, match=r"room: model.lighting.split_lamps is true, but mesh bulbs has 4 parts"):
        lamps_in_parts(replace(scene, meshes=[*scene.meshes, chandelier()]))
