"""Surfaces that no photograph shows take what the photographed parts of their mesh beside them have."""

import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import DOWNWARDS, EVERYWHERE, lamp_room

from neurad.assembly.build import build_materials, build_world
from neurad.core.protocols import Recovered
from neurad.core.records import Surface
from neurad.core.rng import Stream
from neurad.fields.settings import FieldConfig, GridConfig
from neurad.metrics import neighbours
from neurad.metrics.held_out import HeldOut
from neurad.metrics.neighbours import LOCAL, NEAREST, TURNED, Neighbours
from neurad.scene.textures import TrueMaterials


class Striped:
    """Recovered materials that change with the place."""

    known_meshes = frozenset()

    def __call__(self, si):
        return Surface(self.albedo(si), 0.5 + 0.4 * torch.sin(5.0 * si.p[:, :1]))

    def albedo(self, si):
        return 0.5 + 0.4 * torch.sin(7.0 * si.p)


@pytest.fixture(scope="module")
def room():
    scene = lamp_room()
    world = build_world(scene)
    prim = torch.arange(len(world.geometry.emission)).repeat_interleave(5)
    u, v = Stream(3).uniform(len(prim), 2).mul(0.5).unbind(1)
    valid = torch.ones_like(prim, dtype=torch.bool)
    si = world.geometry.interact_at(prim, u, v, world.geometry.face_normal[prim], valid)
    return scene, world, si


def of(world, cameras):
    return Neighbours(world.geometry, world.tracer.tracer, list(cameras))


def test_a_mesh_of_one_material_is_guessed_exactly_and_one_that_no_view_shows_is_not(room):
    scene, world, si = room
    found, truth = of(world, DOWNWARDS), TrueMaterials(scene, world.geometry)
    kept, guess = found.guess(truth(found.points), si, torch.arange(len(si)))
    mesh = world.geometry.mesh_index
    shown = set(mesh[found.points.prim].tolist())
    assert 0 < len(shown) < len(scene.meshes)
    assert set(mesh[si.prim[kept]].tolist()) == shown
    assert len(kept) == sum(int(m) in shown for m in mesh[si.prim])
    torch.testing.assert_close(guess.albedo, truth(si[kept]).albedo)
    torch.testing.assert_close(guess.roughness, truth(si[kept]).roughness)


def test_a_guess_is_the_mean_of_the_nearest_by_their_distance_and_of_the_mesh(room):
    """Against a plain loop."""
    _, world, si = room
    found = of(world, EVERYWHERE)
    kept, guess = found.guess(Striped()(found.points), si, torch.arange(len(si)))
    near, mesh = found.points, world.geometry.mesh_index
    values = Striped()(near)
    for row, lane in list(enumerate(kept.tolist()))[::7]:
        mine = (mesh[near.prim] == mesh[si.prim[lane]]).nonzero().squeeze(-1)
        away = (near.p[mine] - si.p[lane]).double().norm(dim=1)
        away = away * (1.0 + TURNED * (1.0 - (near.n[mine] * si.n[lane]).sum(1)))
        first = away.argsort()[:NEAREST]
        weight = 1.0 / away[first] / (1.0 / away[first]).sum()
        for got, of_all in ((guess.albedo[row], values.albedo), (guess.roughness[row], values.roughness)):
            beside = (weight[:, None] * of_all[mine[first]]).sum(0)
            expected = LOCAL * beside + (1.0 - LOCAL) * of_all[mine].double().mean(0)
            torch.testing.assert_close(got.double(), expected, atol=1e-4, rtol=1e-4)


def test_points_of_a_pixel_have_one_answer_for_each_mesh(room, monkeypatch):
    """That of its first; how many distances are in memory at once changes nothing."""
    _, world, si = room
    found = of(world, EVERYWHERE)
    pixel = torch.arange(len(si)) // 3
    kept, guess = found.guess(Striped()(found.points), si, pixel)
    mesh = world.geometry.mesh_index[si.prim]
    first = {}
    for row, lane in enumerate(kept.tolist()):
        alike = first.setdefault((int(pixel[lane]), int(mesh[lane])), row)
        assert torch.equal(guess.albedo[row], guess.albedo[alike])
    alone = torch.tensor([int(kept[row]) for row in first.values()])
    _, each = found.guess(Striped()(found.points), si[alone], torch.arange(len(alone)))
    torch.testing.assert_close(each.albedo, guess.albedo[torch.tensor(list(first.values()))])
    monkeypatch.setattr(neighbours, "_PAIRS", 1000)
    torch.testing.assert_close(found.guess(Striped()(found.points), si, pixel)[1].albedo, guess.albedo)


def test_without_photographed_points_nothing_is_guessed(room):
    """No view at all, or views that show nothing."""
    _, world, si = room
    pose = np.eye(4, dtype=np.float32)
    pose[2, 3] = -10.0  # behind the room, which it turns its back to
    away = replace(EVERYWHERE[0], to_world=pose)
    for cameras in ([], [away]):
        found = of(world, cameras)
        kept, guess = found.guess(Striped()(found.points), si, torch.arange(len(si)))
        assert len(kept) == len(guess.albedo) == len(guess.roughness) == 0


def test_fitted_materials_count_as_recovered_and_those_of_a_scene_do_not(room):
    """Also where members are looked up without the modules of a network, as from Python 3.12 on."""
    scene, world, _ = room
    small = FieldConfig(GridConfig(levels=2, coarsest=2, finest=4, log2_size=8), width=8)
    made = build_materials(scene, small, small, world.geometry)
    assert isinstance(made, Recovered)
    assert inspect.getattr_static(made, "known_meshes") == made.known_meshes
    assert not isinstance(TrueMaterials(scene, world.geometry), Recovered)


def test_fitted_materials_of_a_scene_without_training_views_are_predicted(room):
    scene, _, _ = room
    scene = replace(scene, train=[], test=scene.train[:1])
    world = build_world(scene)
    small = FieldConfig(GridConfig(levels=2, coarsest=2, finest=4, log2_size=8), width=8)
    (maps,) = HeldOut(scene, world.geometry, world.tracer.tracer).predict(
        build_materials(scene, small, small, world.geometry)
    )
    assert all(np.isfinite(pixels).all() for pixels in maps.values())


def test_maps_are_guessed_where_no_training_view_looks_but_not_on_known_meshes(room):
    scene, _, _ = room
    scene = replace(scene, train=scene.train[:1], test=scene.train[2:4])
    world = build_world(scene)
    held_out = HeldOut(scene, world.geometry, world.tracer.tracer)
    striped, known = Striped(), Striped()
    known.known_meshes = frozenset(range(len(scene.meshes)))
    guessed, own = held_out.predict(striped), held_out.predict(known)
    changed = 0
    for index in range(2):
        same = np.isclose(guessed[index]["albedo"], own[index]["albedo"], atol=1e-6).all(-1)
        assert same[held_out.seen(index)].all()
        changed += int((~same).sum())
    assert changed > 20
