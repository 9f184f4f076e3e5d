"""Light transport against closed forms: the furnace, the prior in it, direct light, and lights without extent."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lit_gallery import LAMPS, light

from neurad.assembly.build import build_world
from neurad.core.records import Rays, Surface
from neurad.core.reflection import DiffuseModel
from neurad.core.rng import Stream
from neurad.core.scene_records import Constant, Material
from neurad.emitters.punctual import PunctualLights
from neurad.integrators.bounce import bounce
from neurad.integrators.direct import Direct
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import FieldRenderer, MethodRenderer, path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_furnace
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

RHO = 0.6


@pytest.fixture(scope="module")
def furnace():
    scene = build_furnace(RHO)
    world = build_world(scene)
    return world, TrueMaterials(scene, world.geometry)


def rays_inside(n, seed=3):
    stream = Stream(seed)
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


def test_derivative_of_the_rhs_is_emission_plus_field(furnace):
    """With k = 1 the derivative is E + L_theta, not the full E / (1 - rho)^2: that is the method."""
    world, materials = furnace
    value = 0.9  # of the field, whatever the physics says

    def field(si, albedo):
        return torch.full_like(albedo, value)

    si = world.intersect(rays_inside(20_000))
    albedo = torch.full((len(si), 3), RHO, requires_grad=True)
    surface = Surface(albedo, torch.ones(len(si), 1))
    scene, u = SceneModel(world, materials, field), Stream(11).uniform(len(si), DIMENSIONS)
    Radiometric().reflected(scene, si, surface, u, Stream(12)).value.sum().backward()
    each = albedo.grad.mean(-1)
    error = each.std().item() / math.sqrt(len(each))
    assert abs(each.mean().item() - (1 + value)) <= 3.3 * error
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
