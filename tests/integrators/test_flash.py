"""A light that moves with the camera: the same as one that stands where the camera is, for every method; and the
radiance field, which is told where it is."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.flash_room import flash, flash_room, lit_by, standing
from helpers.method_oracles import Textures, gallery
from helpers.oracles import accept
from helpers.pathtraced import paths
from scipy import stats

from benchmarks.loaded import to_mitsuba
from neurad.assembly.build import build_world
from neurad.core.camera import Cameras, camera_rays, flash_in_world
from neurad.core.records import PixelBatch, Rays, View
from neurad.core.rng import Stream
from neurad.integrators.blend import Blend
from neurad.integrators.direct import Direct
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import FieldRenderer, path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.runs.model_settings import model_settings
from neurad.scene.builtin.shapes import look_at
from neurad.scene.textures import TrueMaterials
from neurad.training.train_radiance import train_radiance

LIGHTS = {"point": flash(at=(0.2, 0.1, 0.0)), "spot": flash(at=(0.0, 0.3, 0.1), kind="spot", along=(0.1, 0.0, -1.0))}


def gallery_lit(light, area):
    """The gallery seen from one place with a flash there, its own lamps on or gone."""
    scene = gallery()
    meshes = [mesh for mesh in scene.meshes if area or mesh.radiance is None]
    camera = replace(look_at((0.0, 0.3, 0.7), (0.1, -0.2, 0.0), 75.0, 8), flash=light)
    return replace(scene, meshes=meshes, train=[View("v", camera)]).check()


def from_the_camera(scene, n, seed):
    """Points of the gallery that all directions from its camera meet."""
    stream, camera = Stream(seed), scene.train[0].camera
    d = torch.nn.functional.normalize(stream.uniform(n, 3) - 0.5, dim=-1)
    o = torch.tensor(camera.to_world[:3, 3]).float().expand(n, 3).contiguous()
    here = camera_rays(camera, torch.zeros(1, 2)).flash
    rays = Rays(o, d, None if here is None else here.repeated(n))
    world = build_world(scene)
    return world, world.trace_past_delta(rays, stream.uniform(n)).si


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


@pytest.mark.parametrize("lamp", [False, True], ids=["dark room", "beside its lamp"])
def test_pictures_agree_with_mitsuba(mi, lamp):
    """Welch's t over the seeds of both sides, Sidak-corrected at 99 %, of two views."""
    scene = replace(flash_room(flash((1.0, 0.9, 0.8), (0.1, 0.05, 0.0)), lamp, views=1), max_depth=4, rr_depth=100)
    size, spp, seeds, tracer = 8, 32, 10, paths(scene)
    for view in scene.test[:2]:
        camera = replace(view.camera, width=size, height=size)
        loaded = to_mitsuba(standing(scene, camera), View("v", replace(camera, flash=None)), size, spp)
        theirs = np.stack([np.array(mi.render(loaded, seed=s, spp=spp)) for s in range(seeds)])
        ours = np.stack([render(camera, tracer, spp, 100 + s) for s in range(seeds)])
        same = np.ptp(np.concatenate((ours, theirs)), axis=0) <= 1e-5 * np.abs(ours).max()
        p = stats.ttest_ind(ours[:, ~same], theirs[:, ~same], axis=0, equal_var=False).pvalue
        assert p.size > size * size
        assert abs(ours.mean() / theirs.mean() - 1.0) < 0.04
        assert accept(p)


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


class Told:
    """A radiance field that is what it is, whatever the materials are, and that the flash's place changes."""

    reads_albedo = False

    def __call__(self, si, albedo):
        return 0.5 + 0.3 * torch.sin(3.0 * si.p + si.flash.position) * (1.0 + si.flash.arriving[:, None])


METHODS = {
    "ours": Radiometric,
    "ours, two bounces": lambda: Radiometric(2),
    "direct": Direct,
    "path": lambda: PathTracing(6, 100),
    "prb": lambda: PRB(6, 100),
    "blend": Blend,
}


@pytest.mark.parametrize("area", [False, True], ids=["alone", "beside area lights"])
@pytest.mark.parametrize("name", METHODS)
def test_derivatives_are_central_differences(name, area):
    """Over albedo and power, with common random numbers and the radiance field held fixed."""
    world, si = from_the_camera(gallery_lit(flash(), area), 500, 1)
    materials, gain = Textures(), world.flash.gain.requires_grad_(True)
    u, towards = Stream(5).uniform(500, DIMENSIONS), Stream(6).uniform(*materials.colour.shape) - 0.5
    model = SceneModel(world, materials, Told())

    def value():
        return METHODS[name]().reflected(model, si, materials(si), u, Stream(7)).value.double().sum()

    for parameter, way in ((materials.colour, towards), (gain, torch.tensor([0.3, -1.0, 0.5]))):
        (grad,) = torch.autograd.grad(value(), [parameter])
        ends = []
        for sign in (1.0, -1.0):  # with gradients enabled, as PRB draws other numbers where it need not replay
            with torch.no_grad():
                parameter += sign * 0.01 * way
            ends.append(float(value().detach()))
            with torch.no_grad():
                parameter -= sign * 0.01 * way
        assert math.isclose(float((grad * way).sum()), (ends[0] - ends[1]) / 0.02, rel_tol=3e-3)


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
