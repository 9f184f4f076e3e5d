"""Lamps in parts: what is connected, and that nothing moves."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.lamp_room import lamp_room

from neurad.core.errors import InputError
from neurad.scene import lamp_parts
from neurad.scene.builtin.shapes import ball, join
from neurad.scene.lamp_parts import lamps_in_parts

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
