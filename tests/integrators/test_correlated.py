"""Two sets of materials along the same paths: each as path tracing shows it alone, the difference nearly exact."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from helpers.delta_scenes import delta_gallery
from helpers.object_scene import object_scene, sky
from helpers.oracles import accept, z_test_samples
from helpers.random_vertices import one_sided, random_vertices

from benchmarks.stress.fit import glossy
from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays
from neurad.core.records import Surface
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.correlated import CorrelatedBSDF, CorrelatedPaths
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_cornell, build_furnace
from neurad.scene.textures import TrueMaterials

N = 4000
SCENES = {
    "diffuse": build_cornell,
    "glossy": lambda: glossy(build_cornell()),
    "one-sided": lambda: one_sided(glossy(build_cornell())),
    "mirrors and glass": delta_gallery,
    "environment": lambda: object_scene(sky()),
}


@dataclass(frozen=True)
class Changed:
    """Materials of a scene with another albedo and another roughness."""

    materials: TrueMaterials
    albedo_factor: float
    roughness_factor: float

    def __call__(self, si):
        surface = self.materials(si)
        return replace(
            surface,
            albedo=surface.albedo * self.albedo_factor,
            roughness=(surface.roughness * self.roughness_factor).clamp(0.05, 1.0),
        )

    def albedo(self, si):
        return self(si).albedo


@pytest.fixture(params=list(SCENES))
def room(request):
    scene = replace(SCENES[request.param](), max_depth=7, rr_depth=3)
    world = build_world(scene)
    pixels = Stream(3).uniform(N, 2) * torch.tensor([scene.train[0].camera.width, scene.train[0].camera.height])
    return scene, world, TrueMaterials(scene, world.geometry), camera_rays(scene.train[0].camera, pixels)


@pytest.mark.usefixtures("three_threads")
def test_the_same_materials_twice_are_path_tracing_twice(room):
    scene, world, truth, rays = room
    first, second = CorrelatedPaths(world, truth, truth, scene.max_depth, scene.rr_depth)(rays, 7).split(3, -1)
    alone = path_tracer(world, truth, scene.max_depth, scene.rr_depth)(rays, 7)
    assert float(alone.mean()) > 0
    assert torch.equal(first, alone)
    torch.testing.assert_close(second, first, rtol=1e-3, atol=1e-5)


def test_others_look_as_path_tracing_shows_them_alone(room):
    """Means over 40 passes of 4000 samples, by channel: a z-test at 99 %."""
    scene, world, truth, rays = room
    others = Changed(truth, 0.8, 1.5)
    pair = CorrelatedPaths(world, truth, others, scene.max_depth, scene.rr_depth)
    alone = path_tracer(world, others, scene.max_depth, scene.rr_depth)
    found = [
        torch.stack([x(rays, k).mean(0) for k in seeds]) for x, seeds in ((pair, range(40)), (alone, range(50, 90)))
    ]
    assert accept(z_test_samples(found[0][:, 3:], found[1]))
    assert not accept(z_test_samples(found[0][:, :3], found[1]))  # the change is seen


def test_a_furnace_of_another_albedo_has_its_closed_form():
    """Emission over 1 - 0.6 along paths of albedo 0.5: a z-test at 99 %."""
    scene = build_furnace(0.5, 1.0)
    world = build_world(scene)
    truth = TrueMaterials(scene, world.geometry)
    pair = CorrelatedPaths(world, truth, Changed(truth, 1.2, 1.0), None, 4)
    rays = camera_rays(scene.train[0].camera, Stream(3).uniform(N, 2) * scene.train[0].camera.width)
    found = torch.stack([pair(rays, k).mean(0) for k in range(30)])
    assert accept(z_test_samples(found, np.repeat([1.0 / (1.0 - 0.5), 1.0 / (1.0 - 0.6)], 3)))


def test_a_small_change_is_known_far_better_than_by_the_same_numbers():
    """Each sample's change has a hundredth of the variance that it has between two path tracers of one seed."""
    scene = replace(glossy(build_cornell()), max_depth=12, rr_depth=3)
    world = build_world(scene)
    truth = TrueMaterials(scene, world.geometry)
    others = Changed(truth, 1.01, 1.01)
    rays = camera_rays(scene.train[0].camera, Stream(3).uniform(N, 2) * scene.train[0].camera.width)
    pair = CorrelatedPaths(world, truth, others, scene.max_depth, scene.rr_depth)(rays, 1)
    one, two = (path_tracer(world, m, scene.max_depth, scene.rr_depth)(rays, 1) for m in (truth, others))
    assert float((pair[:, 3:] - pair[:, :3]).var()) < 0.01 * float((two - one).var())


@pytest.mark.parametrize(
    "scene", [glossy(build_cornell()), one_sided(glossy(build_cornell()))], ids=["glossy", "sided"]
)
def test_the_compiled_bounce_is_the_plain_one(scene):
    world, stream = build_world(scene), Stream(5)
    si, u = random_vertices(world, N, 3), Stream(4).uniform(N, DIMENSIONS)
    drawn, surface = (Surface(stream.uniform(N, 3), 0.05 + 0.95 * stream.uniform(N, 1)) for _ in range(2))
    drawn = replace(drawn, specular_fraction=0.1 + 0.8 * stream.uniform(N, 1))
    along = world.reflecting_by(CorrelatedBSDF(world.bsdf, drawn))
    fast, plain = (bounce(along, si, surface, u, use_kernels=kernels) for kernels in (True, False))
    own = bounce(world, si, drawn, u)
    assert float((fast.next.prim == plain.next.prim).float().mean()) > 0.998
    assert torch.equal(fast.next.prim, own.next.prim)
    assert float(plain.direct.mean()) > 0
    for name in ("direct", "weight"):
        a, b = getattr(fast, name), getattr(plain, name)
        assert float(((a - b).abs() > 1e-3 * (1.0 + b.abs())).any(-1).float().mean()) < 2e-3
