"""A light that moves with the camera: the same as one that stands where the camera is, for every method; and the
radiance field, which is told where it is."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.flash_room import flash, flash_room, lit_by, standing
from helpers.lit_gallery import from_the_camera, gallery_lit
from helpers.method_oracles import Textures

from neurad.assembly.build import build_world
from neurad.core.camera import Cameras, camera_rays, flash_in_world
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.renderer import FieldRenderer, path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.runs.model_settings import model_settings
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import train_radiance

LIGHTS = {"point": flash(at=(0.2, 0.1, 0.0)), "spot": flash(at=(0.0, 0.3, 0.1), kind="spot", along=(0.1, 0.0, -1.0))}


@pytest.mark.parametrize("name", LIGHTS)
def test_paths_are_those_of_a_light_that_stands_there(name):
    """Of the same random numbers, to rounding: nothing else shines, so that nothing is drawn for the light."""
    scene = gallery_lit(LIGHTS[name], area=False)
    found = []
    for lit in (scene, standing(scene, scene.train[0].camera)):
        world, si = from_the_camera(lit, 2000, 3)
        surface = (materials := Textures())(si)
        u = Stream(5).uniform(len(si), DIMENSIONS)
        value = PathTracing(4, 100).reflected(SceneModel(world, materials), si, surface, u, Stream(7)).value
        found.append(value.detach())
    assert float(found[0].mean()) > 0.01
    same = ((found[0] - found[1]).abs() <= 1e-3 * found[1].abs() + 1e-5).all(-1)
    assert float(same.float().mean()) > 0.998  # rounding may turn a shadow ray at an edge
    torch.testing.assert_close(found[0].mean(0), found[1].mean(0), rtol=3e-3, atol=0.0)


def test_each_view_has_its_own():
    """Kept camera rays of several views see the flash of their own, as new rays do; a view may have none."""
    scene = flash_room(flash(), lamp=True, views=3)
    scene.train[1] = replace(scene.train[1], camera=replace(scene.train[1].camera, flash=None))
    world, cameras = build_world(scene), [view.camera for view in scene.train]
    batch = PixelBatch(torch.tensor([0, 1, 2]), torch.full((3,), 2080), torch.zeros(3, 3), torch.ones(3), 0)
    for kept in (4, 0):
        si = PrimaryHits(world, cameras, kept, 1, torch.device("cpu"))(batch, 2, Stream(1)).si
        for index, camera in enumerate(cameras):
            light = flash_in_world(camera)
            mine = si.flash[slice(2 * index, 2 * index + 2)]
            if light is None:
                assert not mine.intensity.any()
            else:
                np.testing.assert_allclose(mine.position, np.tile(light.position, (2, 1)), atol=1e-6)
                np.testing.assert_allclose(mine.intensity, np.tile(light.intensity, (2, 1)))
                distance = (mine.position - si.p[2 * index : 2 * index + 2]).norm(dim=-1)
                np.testing.assert_allclose(mine.arriving, 1.0 / distance**2, rtol=1e-4)
    assert Cameras.of(cameras[1:2], "cpu").flash is None


@pytest.mark.slow
def test_the_field_knows_the_light_of_places_that_the_flash_was_never_at():
    """Against paths, in a room that a flash alone lights, with its true materials."""
    scene = flash_room(flash())
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    traced = path_tracer(world, materials, 20, 8)
    errors = {}
    for told, inputs in ((True, None), (False, ("faceforward",))):
        settings = model_settings("scene.yaml", 1)
        settings = replace(settings, radiance=replace(settings.radiance, inputs=inputs))
        field = train_radiance(scene, world, materials, [view.camera for view in scene.train], settings, 1000)
        assert field.reads_flash == told
        found = []
        for view in scene.test:
            camera = replace(view.camera, width=24, height=24)
            true = render(camera, traced, 512, 3).numpy()
            shown = render(camera, FieldRenderer(SceneModel(world, materials, field)), 16, 4).numpy()
            found.append(np.sqrt(np.mean(((shown - true) / (true + 0.05 * true.mean())) ** 2)))
        errors[told] = np.mean(found)
    print(errors)
    assert errors[True] < 0.15
    assert errors[False] > 4.0 * errors[True]


def test_a_room_without_a_flash_is_the_same_as_ever():
    """Cameras carry nothing, nor do rays and surfaces."""
    scene = lit_by(flash_room(flash(), lamp=True, views=1))
    world, camera = build_world(scene), scene.train[0].camera
    rays = camera_rays(camera, torch.full((4, 2), 30.0))
    assert (world.flash, rays.flash, world.intersect(rays).flash) == (None, None, None)
    assert not [name for name in world.state_dict() if "flash" in name]
