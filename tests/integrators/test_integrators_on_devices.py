"""A bounce, the guide, kept first hits and whole pictures are the same on every device."""

from dataclasses import replace
from functools import partial

import pytest
import torch
from helpers.delta_scenes import delta_gallery
from helpers.devices import close, on_devices
from helpers.object_scene import object_scene, sky
from helpers.random_vertices import one_sided, random_vertices, uneven_guide
from helpers.small_step import small_scene

from neurad.assembly.build import build_world
from neurad.core.camera import project, to_camera
from neurad.core.records import PixelBatch, Rays, Surface
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.film import render
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build, build_cornell
from neurad.scene.textures import TrueMaterials

N = 3000
SCENES = {
    "diffuse": build_cornell,
    "diffuse, one-sided": lambda: one_sided(build_cornell()),
    "principled": lambda: build("patterns"),
    "under an environment": lambda: object_scene(sky()),
    "mirrors and glass": delta_gallery,
}


@on_devices
@pytest.mark.parametrize("tracer", ["embree", "warp"])
@pytest.mark.parametrize("name", SCENES)
def test_a_bounce_is_that_of_the_reference(device, name, tracer):
    if tracer == "warp":
        pytest.importorskip("warp")
    scene = SCENES[name]()
    world, there = build_world(scene), build_world(scene, tracer)
    if name == "principled":
        world.guide, there.guide = uneven_guide(world), uneven_guide(world)
    there.to(device)
    si, stream = random_vertices(world, N, 3), Stream(4)
    u = stream.uniform(N, DIMENSIONS)
    albedo, roughness = stream.uniform(N, 3), 0.1 + 0.9 * stream.uniform(N, 1)

    def step(function, world, where):
        surface = Surface(*(x.clone().to(where).requires_grad_(True) for x in (albedo, roughness)))
        result = function(world, si.to(where), surface, u.to(where))
        (result.direct + 0.3 * result.weight).sum().backward()
        return result, surface.albedo.grad

    expected, gradient = step(partial(bounce, use_kernels=False), world, "cpu")
    found, gradient_there = step(bounce, there, device)
    assert found.direct.device.type == found.next.p.device.type == device
    # Where a vertex reflects nothing, its ray is anyone's: it carries no weight.
    carries = expected.weight.detach().abs().sum(-1) > 0
    assert float(carries.float().mean()) > 0.2
    same = (found.next.prim.cpu() == expected.next.prim) & (found.next.valid.cpu() == expected.next.valid)
    assert float((~same & carries).float().mean()) < 5e-3  # rounding at an edge
    same &= carries
    scale = float(expected.direct.detach().abs().max())
    assert scale > 0
    for a, b, unit in (
        (found.direct, expected.direct, 1e-4 * scale),
        (found.weight, expected.weight, 1e-3),
        (gradient_there, gradient, 1e-4 * scale),
        (found.next.p, expected.next.p, 1e-3),
    ):
        close(a.cpu()[same], b[same], rtol=5e-3, atol=unit, stray=5e-3)


@on_devices
def test_the_guide_draws_records_and_updates_the_same(device):
    world = build_world(build("patterns"))
    guide = uneven_guide(world)
    there = uneven_guide(world).to(device)
    si, u = random_vertices(world, N, 3), Stream(5).uniform(N, 2)
    wi = torch.nn.functional.normalize(Stream(6).uniform(N, 3) - torch.tensor([0.5, 0.5, 0.0]), dim=-1)
    light, n = Stream(7).uniform(N, 3), si.n
    rows, rows_there = guide.rows(si, n), there.rows(si.to(device), n.to(device))
    close(rows_there, rows, stray=2e-3)
    close(there.warp(rows.to(device), u.to(device)), guide.warp(rows, u), rtol=1e-3, atol=1e-3, stray=5e-3)
    close(there.density(rows.to(device), wi.to(device)), guide.density(rows, wi), rtol=1e-3, atol=1e-4, stray=5e-3)
    for module, where in ((guide, "cpu"), (there, device)):
        module.record(*module.bin_samples(si.to(where), wi.to(where), light.to(where)))
        module.update()
    for name in ("counts", "squares", "cdf"):
        close(getattr(there, name), getattr(guide, name), rtol=1e-3, atol=1e-4, stray=5e-3)


@on_devices
@pytest.mark.parametrize("kept", [0, 4])
def test_first_hits_lie_in_their_pixels_on_every_device(device, kept):
    scene = small_scene()
    world = build_world(scene).to(device)
    cameras = [view.camera for view in scene.train]
    primary = PrimaryHits(world, cameras, kept, 0, torch.device(device))
    view, pixel = (x.flatten() for x in torch.meshgrid(torch.arange(3), torch.arange(0, 144, 5), indexing="ij"))
    ones = torch.ones(len(view))
    batch = PixelBatch(*(x.to(device) for x in (view, pixel, torch.zeros(len(view), 3), ones)), 0)
    si = primary(batch, 16, Stream(1, device=device)).si
    assert si.p.device.type == device
    si = si.to("cpu")
    tracer, corner = build_world(scene).tracer, torch.stack((pixel % 12, pixel // 12), -1).repeat_interleave(16, 0)
    inside = torch.empty(len(si), 2)
    for index, camera in enumerate(cameras[:3]):
        mine = (view == index).repeat_interleave(16).nonzero().squeeze(-1)
        inside[mine] = project(camera, to_camera(camera, si.p[mine])) - corner[mine]
        # What a ray through the same place meets on the CPU.
        origin = torch.tensor(camera.to_world[:3, 3], dtype=torch.float32).expand(len(mine), 3)
        away = si.p[mine] - origin
        distance = away.norm(dim=-1)
        hit = tracer.closest(Rays(origin.contiguous(), away / distance[:, None]))
        close(hit.t, distance, rtol=1e-4, stray=2e-3)  # but for a ray along an edge
    assert float(inside.min()) > -1e-3
    assert float(inside.max()) < 1.001
    # Uniform in their pixels: of n positions the mean has a standard deviation of 12^-1/2 n^-1/2; five of them.
    positions = len(view) * (kept or 16)
    assert float((inside.mean(0) - 0.5).abs().max()) < 5.0 * (12.0 * positions) ** -0.5


@on_devices
def test_a_picture_has_the_same_mean_on_every_device(device):
    scene = build_cornell()
    camera = replace(scene.test[0].camera, width=16, height=16)

    def picture(where, seed):
        world = build_world(scene, "embree").to(where)
        materials = TrueMaterials(scene, world.geometry).to(where)
        return render(camera, path_tracer(world, materials, scene.max_depth), 64, seed, where).cpu()

    expected, found = picture("cpu", 1), picture(device, 2)
    assert float(found.mean()) == pytest.approx(float(expected.mean()), rel=0.05)
    assert float((found - expected).square().mean()) < 0.02 * float(expected.square().mean())
