"""Borders of charts in a whole room: no seam where there is none, and one where the gutter is missing."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.exported import GREY

from neurad.core.records import Surface
from neurad.export import bake as baking
from neurad.export import texel_means
from neurad.export.bake import BakedRoom, bake
from neurad.export.charts import edge_keys, find_borders
from neurad.export.seams import BOUND, along, bilinear, find_seams
from neurad.export.texel_means import TexelMeans
from neurad.export.unwrap import unwrap
from neurad.formats.load import load_scene
from neurad.scene.geometry import Geometry

pytest.importorskip("xatlas")


class Waves:
    """Materials that vary over a decimetre in every direction, or ``times`` as fast."""

    def __init__(self, times=1.0):
        self.along = times * torch.tensor([[7.0, 1.0, 2.5], [2.0, 8.0, 0.5], [3.0, 0.5, 6.5]])

    def __call__(self, si):
        waves = 0.5 + 0.4 * torch.sin(si.p @ self.along)
        return Surface(waves, waves[:, :1])


@pytest.fixture(scope="module")
def kitchen():
    """Every third mesh of the built-in patterned kitchen, their geometry, and each with a texture."""
    scene = load_scene(None, "patterns")
    scene = replace(scene, meshes=scene.meshes[::3])
    charts = unwrap(scene.meshes, np.full(len(scene.meshes), 100.0), 270_000)
    return scene, Geometry(scene), charts


@pytest.fixture(scope="module")
def baked(kitchen):
    """It with its textures."""
    return room(*kitchen)


def room(scene, geometry, charts, waves=1.0):
    first = np.cumsum([0, *(len(mesh.faces) for mesh in scene.meshes)])
    baked = [
        bake(TexelMeans(chart, int(start), geometry, Waves(waves)))
        for chart, start in zip(charts, first[:-1], strict=True)
    ]
    return BakedRoom(scene, [mesh.name for mesh in scene.meshes], charts, baked, "y", False)


def across(room):
    """Differences between lookups on both sides of borders at one point in space [n]: what an eye would see."""
    found = []
    for chart, baked in zip(room.charts, room.baked, strict=True):
        border = find_borders(chart.mesh)
        part = np.random.default_rng(0).random(len(border))
        off = bilinear(baked.pixels, *along(chart, border, part))
        off = off - bilinear(baked.pixels, *along(chart, *other_side(chart.mesh, border, part)))
        found.append(np.abs(off).max(1, initial=0.0))
    return np.concatenate(found)


def other_side(mesh, border, part):
    """The other side of borders [k], and how far along it the same points in space lie."""
    key = edge_keys(mesh.vertices, mesh.faces)[border]
    order = np.argsort(key, kind="stable")
    last = np.append(key[order[1:]] != key[order[:-1]], True)
    begin = np.maximum.accumulate(np.where(np.append(True, last[:-1]), np.arange(len(order)), 0))
    following = np.empty_like(order)
    following[order] = order[np.where(last, begin, np.arange(len(order)) + 1)]
    there = border[following]
    starts = (mesh.vertices[mesh.faces[side // 3, side % 3]] for side in (border, there))
    return there, np.where(np.equal(*starts).all(-1), part, 1.0 - part)


def test_no_border_of_the_built_in_kitchen_is_a_seam(kitchen, baked):
    found = find_seams(baked, kitchen[1], Waves())
    assert found.points == found.sides > 1500
    assert found.largest <= BOUND, found
    assert found.beyond == 0.0
    assert across(baked).max() <= 4 * BOUND  # these waves bend within a texel, and the two sides bend apart


def test_without_a_gutter_seams_are_found(kitchen, monkeypatch):
    scene, geometry, charts = kitchen
    with monkeypatch.context() as patch:
        patch.setattr(texel_means, "GUTTER", 0.0)
        bare = room(scene, geometry, charts)
    found = find_seams(bare, geometry, Waves(), points=1024)
    assert found.points < found.sides
    assert found.largest > 5 * BOUND
    assert found.beyond > 0.05
    assert (across(bare) > BOUND).mean() > 0.05


@pytest.mark.parametrize(("per", "seen"), [(2, True), (32, False)])
def test_texels_on_borders_are_asked_at_more_positions(monkeypatch, per, seen):
    """In a large texture, where fields bend within a texel."""
    import trimesh

    from neurad.core.scene_records import Mesh
    from neurad.scene.description import Scene

    box = trimesh.creation.box((3.0, 3.0, 3.0))
    mesh = Mesh("box", np.asarray(box.vertices, np.float32), np.asarray(box.faces, np.int64), 0)
    scene = Scene("box", [mesh], [GREY])
    geometry, charts = Geometry(scene), unwrap([mesh], np.array([12.0]), 1 << 16)
    monkeypatch.setattr(baking, "CHEAP", 0)
    monkeypatch.setattr(baking, "AFFORDABLE", 0)
    monkeypatch.setattr(baking, "MAX_PER_BORDER_TEXEL", per)
    found = find_seams(room(scene, geometry, charts, 3.0), geometry, Waves(3.0))
    assert (found.largest > BOUND) == seen, found
