"""Light transport against closed forms: the furnace, the prior in it, and direct light."""

import math

import pytest
import torch

from neurad.assembly.build import build_world
from neurad.core.records import Rays, Surface
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.method import SceneModel
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import FieldRenderer, MethodRenderer, path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_furnace
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
