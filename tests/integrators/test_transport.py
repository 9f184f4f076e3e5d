"""Light transport against closed forms: the furnace, the prior in it, direct light, lights without extent, and a flash,
which is one that stands where the camera is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.flash_room import flash, flash_room, standing
from helpers.lit_gallery import LAMPS, from_the_camera, gallery_lit, light
from helpers.method_oracles import Textures

from neurad.assembly.build import build_world
from neurad.core.camera import Cameras, flash_in_world
from neurad.core.records import PixelBatch, Rays
from neurad.core.reflection import DiffuseModel
from neurad.core.rng import Stream
from neurad.core.scene_records import Constant, Material
from neurad.emitters.punctual import PunctualLights
from neurad.integrators.bounce import bounce
from neurad.integrators.direct import Direct
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import FieldRenderer, MethodRenderer, path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.runs.model_settings import model_settings
from neurad.scene.builtin import build_furnace
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import train_radiance

RHO = 0.6


@pytest.fixture(scope="module")
def furnace():
    scene = build_furnace(RHO)
    world = build_world(scene)
    return world, TrueMaterials(scene, world.geometry)


def rays_inside(n):
    stream = Stream(3)
    d = torch.nn.functional.normalize(stream.uniform(n, 3) - 0.5, dim=-1)
    return Rays(torch.zeros(n, 3) + (stream.uniform(n, 3) - 0.5) * 0.1, d)


@pytest.mark.parametrize("depth", [1, 2, 3, 6, None])
def test_furnace_gives_the_partial_sum_of_the_series_and_without_a_depth_cap_the_limit(furnace, depth):
    world, materials = furnace
    tracer = path_tracer(world, materials, max_depth=depth, rr_depth=100 if depth else 3)
    values = tracer(rays_inside(20_000 if depth else 40_000), 5 if depth else 6).mean(-1)
    expected = sum(RHO**k for k in range(depth)) if depth else 1 / (1 - RHO)
    error = values.std().item() / math.sqrt(len(values))
    assert abs(values.mean().item() - expected) <= 3.3 * error + (1e-5 if depth else 0.0)
    assert error < 0.01 * (expected if depth else 1.0)


def test_in_the_furnace_the_exact_field_solves_the_rendering_equation(furnace):
    world, materials = furnace
    exact = RHO / (1 - RHO)

    def field(si, albedo):
        return torch.full_like(albedo, exact)

    rays = rays_inside(40_000)
    left = FieldRenderer(SceneModel(world, materials, field))(rays, 0).mean(-1)
    right = MethodRenderer(Radiometric(), SceneModel(world, materials, field))(rays, 7).mean(-1)
    torch.testing.assert_close(left, torch.full_like(left, 1 / (1 - RHO)))
    error = right.std().item() / math.sqrt(len(right))
    assert abs(right.mean().item() - 1 / (1 - RHO)) <= 3.3 * error
    assert error < 0.01


def test_bounce_from_a_miss_is_zero_and_finite(furnace):
    world, materials = furnace
    outside = Rays(torch.tensor([[100.0, 0.0, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]))
    si = world.intersect(outside)
    step = bounce(world, si, materials(si), torch.full((1, DIMENSIONS), 0.5))
    assert (step.direct == 0).all()
    assert (step.weight == 0).all()


# ---- lights without extent over a floor

ALBEDO = np.array([0.8, 0.5, 0.2], np.float32)


def floor_lit_by(lamp, blocked=False):
    """Radiance towards viewers above a diffuse floor at y = 0 [n, 3], and the points on it [n, 3]."""
    material = Material("floor", DiffuseModel(), Constant(ALBEDO), Constant(np.ones(1, np.float32)))
    meshes = [quad((-2, 0, -2), (0, 0, 4), (4, 0, 0)).mesh("floor", 0)]
    if blocked:
        meshes.append(quad((-9, 0.5, -9), (0, 0, 18), (18, 0, 0)).mesh("lid", 0))
    scene = Scene("floor", meshes, [material], punctual=(lamp,)).check()
    world = build_world(scene)
    assert isinstance(world.lights, PunctualLights)
    stream = Stream(1)
    o = torch.stack((stream.uniform(2000) * 4 - 2, torch.full((2000,), 0.2), stream.uniform(2000) * 4 - 2), 1)
    si = world.intersect(Rays(o, torch.tensor([0.0, -1.0, 0.0]).expand(2000, 3).contiguous()))
    materials = TrueMaterials(scene, world.geometry)
    u = stream.uniform(len(si), DIMENSIONS)
    value = Direct().reflected(SceneModel(world, materials), si, materials(si), u, stream).value
    return value.double().numpy(), si.p.double().numpy()


@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_lights_over_a_floor_have_their_closed_form(kind):
    """A spot is linear in the angle between its two, and black from the outer one on."""
    at, axis, intensity = np.array([0.3, 1.0, -0.4]), np.array([0.2, -1.0, 0.3]), np.array([5.0, 2.0, 1.0])
    value, p = floor_lit_by(light(kind, intensity, at, axis))
    away = p - at
    distance = np.linalg.norm(away, axis=1)
    angle = np.degrees(np.arccos(away @ axis / distance / np.linalg.norm(axis)))
    shown = at[1] / distance**3 if kind != "directional" else np.full(len(p), 1.0 / np.linalg.norm(axis))
    if kind == "spot":
        shown = shown * np.clip((40.0 - angle) / 15.0, 0.0, 1.0)
        assert {(angle < 25).any(), ((angle > 25) & (angle < 40)).any(), (angle > 40).any()} == {True}
    np.testing.assert_allclose(value, ALBEDO / math.pi * intensity * shown[:, None], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("lamp", [replace(LAMPS[0], position=np.float32([0, 2, 0])), LAMPS[2]])
def test_what_lies_in_between_gives_shadow(lamp):
    assert (floor_lit_by(lamp, blocked=True)[0] == 0).all()


# ---- a flash, and the radiance field, which is told where it is


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
    assert errors[True] < 0.15
    assert errors[False] > 4.0 * errors[True]
