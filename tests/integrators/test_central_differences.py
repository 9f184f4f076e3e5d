"""Derivatives of every method by albedo, metalness and what is unknown of the light: differences of its own value.

Random numbers are common and the radiance field is held fixed. Neither parameter moves a path as long as roulette,
which would depend on the albedo, is off. Roughness moves the sampled directions, which detached sampling holds fixed
on purpose.
"""

from dataclasses import replace

import pytest
import torch
from helpers.flash_room import flash
from helpers.lamp_scene import with_lamps
from helpers.lit_gallery import from_the_camera, gallery_lit, lit_gallery
from helpers.method_oracles import Textures, camera_vertices, gallery
from helpers.object_scene import sky
from helpers.oracles import half_difference

from neurad.assembly.build import build_world
from neurad.bsdf.principled import Principled
from neurad.core.rng import Stream
from neurad.emitters.fitted import FittedEnvironment
from neurad.integrators.blend import Blend
from neurad.integrators.debiased import Debiased
from neurad.integrators.direct import Direct
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS

N = 500


class Fixed:
    """A radiance field that is what it is, whatever the materials are, and that the place of a flash changes."""

    reads_albedo = False

    def __call__(self, si, albedo):
        if si.flash is None:
            return 0.5 + 0.3 * torch.sin(3.0 * si.p)
        return 0.5 + 0.3 * torch.sin(3.0 * si.p + si.flash.position) * (1.0 + si.flash.arriving[:, None])


def debiased(k):
    """With probabilities to go on that do not depend on the albedo, so that common random numbers stay common."""
    method = Debiased(k)
    method.continuation = lambda bounces, throughput, weight: None if bounces < k else weight[:, 0] * 0 + 0.6
    return method


METHODS = {
    "ours": lambda: Radiometric(1),
    "ours, two bounces": lambda: Radiometric(2),
    "direct": Direct,
    "path": lambda: PathTracing(6, 100),
    "prb": lambda: PRB(6, 100),
    "debiased": lambda: debiased(1),
    "debiased, two bounces": lambda: debiased(2),
    "blend": Blend,
}


def known(scene):
    """A world, vertices, and nothing unknown of the light."""
    world = build_world(scene)
    return world, camera_vertices(world, N, 1), []


def lit_by_a_flash(area):
    """The power of the flash is unknown."""
    world, si = from_the_camera(gallery_lit(flash(), area), N, 1)
    return world, si, [(world.flash.gain.requires_grad_(True), 0.01 * torch.tensor([0.3, -1.0, 0.5]))]


def lit_by_unknown_lamps():
    """Tables stay as they are, so that samples do."""
    world, lamps = with_lamps(gallery())
    step = 0.02 * torch.tensor([[1.0, -0.5, 0.3], [0.4, 0.8, -0.6]])
    return world, camera_vertices(world, N, 1), [(lamps.values, step, lamps.update)]


def lit_by_an_unknown_sky():
    light = FittedEnvironment(sky(), 16, 8)
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        light.values.copy_(torch.randn(light.values.shape, generator=generator))
    light.refresh()
    meshes = [mesh for mesh in gallery().meshes if mesh.radiance is None and mesh.vertices[:, 1].min() < 0.995]
    world = build_world(replace(gallery(), meshes=meshes, environment=sky()), "embree", True, light)
    step = 0.01 * torch.randn(light.values.shape, generator=generator)
    return world, camera_vertices(world, N, 1), [(light.values, step)]


LIGHTS = {
    "lamps": lambda: known(gallery()),
    "points": lambda: known(lit_gallery(area=False)),
    "points beside lamps": lambda: known(lit_gallery()),
    "a flash": lambda: lit_by_a_flash(area=False),
    "a flash beside lamps": lambda: lit_by_a_flash(area=True),
    "unknown lamps": lit_by_unknown_lamps,
    "an unknown sky": lit_by_an_unknown_sky,
}


def check(method, world, si, materials, moves, rel=2e-3, least=0.0):
    """Derivatives of a method's value along steps of parameters are differences of it."""
    u, model = Stream(5).uniform(len(si), DIMENSIONS), SceneModel(world, materials, Fixed())

    def value():
        return method().reflected(model, si, materials(si), u, Stream(7)).value.double().sum()

    for parameter, step, *changed in moves:
        (gradient,) = torch.autograd.grad(value(), [parameter])
        expected = half_difference(value, [(parameter, step)], *changed)
        assert abs(expected) >= least * float(value().detach()), "the step changes next to nothing"
        assert float((gradient * step).sum()) == pytest.approx(expected, rel=rel)


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("method", METHODS)
def test_derivatives_are_central_differences_of_the_methods_own_value(method, light):
    world, si, unknown = LIGHTS[light]()
    materials = Textures()
    towards = 0.01 * (Stream(6).uniform(*materials.colour.shape) - 0.5)
    check(METHODS[method], world, si, materials, [(materials.colour, towards), *unknown])


@pytest.mark.parametrize("light", ["lamps", "points beside lamps", "an unknown sky"])
@pytest.mark.parametrize("method", METHODS)
def test_derivatives_by_the_metalness_are_central_differences(method, light, monkeypatch):
    """Lobes are drawn with one probability: that metal has another moves paths, which is held fixed on purpose."""
    monkeypatch.setattr(Principled, "_fraction", lambda self, surface: 0.6)
    world, si, _ = LIGHTS[light]()
    materials = Textures(metal=True)
    with torch.no_grad():
        materials.metal.clamp_(0.05, 0.95)
    step = 0.05 * (Stream(6).uniform(*materials.metal.shape) - 0.3)
    check(METHODS[method], world, si, materials, [(materials.metal, step)], least=1e-3)


def test_direct_light_has_the_exact_derivative_by_the_roughness():
    """Emitter sampling alone finds it, whose directions do not depend on the roughness."""
    world, materials = build_world(lit_gallery(area=False)), Textures()
    with torch.no_grad():
        materials.colour.fill_(0.5)
    step = torch.full_like(materials.rough, 0.004)
    check(Direct, world, camera_vertices(world, 1500, 2), materials, [(materials.rough, step)], rel=5e-3)
