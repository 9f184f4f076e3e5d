"""Points, spots and directional lights in scenes: closed forms, Mitsuba, and every method's derivative."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.method_oracles import Textures, camera_vertices, gallery
from helpers.oracles import accept
from helpers.pathtraced import paths
from scipy import stats

from benchmarks.loaded import to_mitsuba
from neurad.assembly.build import build_world
from neurad.core.records import Camera, Constant, EnvironmentMap, Material, PunctualLight, Rays, View
from neurad.core.reflection import DiffuseModel
from neurad.core.rng import Stream
from neurad.emitters.punctual import PunctualLights
from neurad.integrators.debiased import Debiased
from neurad.integrators.direct import Direct
from neurad.integrators.film import render
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.prb import PRB
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

ALBEDO = np.array([0.8, 0.5, 0.2], np.float32)


def light(kind, intensity, at=(0.0, 0.0, 0.0), along=(0.0, -1.0, 0.0), cutoff=40.0, beam=25.0, name=None):
    rgb, place, axis = (np.asarray(x, np.float32) for x in (intensity, at, along))
    return PunctualLight(name or kind, kind, rgb, place, axis, cutoff, beam)


LAMPS = (
    light("point", (1.0, 0.8, 0.5), (0.5, 0.6, 0.4)),
    light("spot", (2.0, 3.0, 4.0), (-0.5, 0.9, 0.3), (0.2, -1.0, -0.3)),
    light("directional", (0.3, 0.2, 0.6), along=(0.3, -1.0, -0.4)),
)


def lit_gallery(area=True, sky=False):
    """The gallery with lights without extent; without its ceiling, so that the directional one gets in."""
    scene = gallery()
    meshes = [mesh if area else replace(mesh, radiance=None) for mesh in scene.meshes]
    meshes = [mesh for mesh in meshes if mesh.vertices[:, 1].min() < 0.995 or mesh.radiance is not None]
    above = EnvironmentMap(np.full((4, 8, 3), 0.4, np.float32)) if sky else None
    return replace(scene, meshes=meshes, punctual=LAMPS, environment=above).check()


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


@pytest.mark.parametrize(
    ("sky", "delta", "depth"),
    [(False, False, 4), pytest.param(True, False, 4, marks=pytest.mark.slow),
     pytest.param(False, True, 16, marks=pytest.mark.slow)],
)  # fmt: skip
def test_pictures_agree_with_mitsuba(mi, sky, delta, depth):
    """All lights together: Welch's t over the seeds of both sides, Sidak-corrected at 99 %.

    Mitsuba counts smooth surfaces as vertices of a path, so that a scene with some has to have long paths.
    """
    scene = replace(lit_gallery(sky=sky), max_depth=depth, rr_depth=100)
    if not delta:
        scene = replace(scene, meshes=[mesh for mesh in scene.meshes if mesh.material == 0])
    size, spp, seeds = 10, 32, 10
    pose = np.eye(4)
    pose[:3, 3] = 0.0, 0.1, 0.95
    camera = Camera(pose, math.radians(75.0), size, size)
    loaded = to_mitsuba(scene, View("v", camera), size, spp)
    theirs = np.stack([np.array(mi.render(loaded, seed=s, spp=spp)) for s in range(seeds)])
    tracer = paths(scene)
    ours = np.stack([render(camera, tracer, spp, 100 + s) for s in range(seeds)])
    same = np.ptp(np.concatenate((ours, theirs)), axis=0) <= 1e-5 * np.abs(ours).max()  # nothing, or sky alone
    p = stats.ttest_ind(ours[:, ~same], theirs[:, ~same], axis=0, equal_var=False).pvalue
    ratio = ours.mean() / theirs.mean()
    print(f"smallest p {p.min():.2e} of {p.size}, mean ratio {ratio:.4f}")
    assert p.size > size * size
    assert abs(ratio - 1.0) < 0.03
    assert accept(p)
    assert stats.kstest(p, "uniform").pvalue > 1e-3


# ---- derivatives


class Fixed:
    """A radiance field that is what it is, whatever the materials are."""

    reads_albedo = False

    def __call__(self, si, albedo):
        return 0.5 + 0.3 * torch.sin(3.0 * si.p)


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
}


@pytest.mark.parametrize("area", [False, True], ids=["alone", "beside area lights"])
@pytest.mark.parametrize("name", METHODS)
def test_derivatives_are_central_differences_of_the_methods_own_picture(name, area):
    """Over the albedo, with common random numbers and the radiance field held fixed."""
    world, materials, n = build_world(lit_gallery(area)), Textures(), 500
    si = camera_vertices(world, n, 1)
    u = Stream(5).uniform(n, DIMENSIONS)
    towards = Stream(6).uniform(*materials.colour.shape) - 0.5
    model = SceneModel(world, materials, Fixed())

    def value():
        out = METHODS[name]().reflected(model, si, materials(si), u, Stream(7)).value
        return out.double().sum()

    (grad,) = torch.autograd.grad(value(), [materials.colour])
    ends = []
    for sign in (1.0, -1.0):  # with gradients enabled, as PRB draws other numbers where it need not replay
        with torch.no_grad():
            materials.colour += sign * 0.01 * towards
        ends.append(float(value().detach()))
        with torch.no_grad():
            materials.colour -= sign * 0.01 * towards
    expected = (ends[0] - ends[1]) / 0.02
    assert math.isclose(float((grad * towards).sum()), expected, rel_tol=2e-3)


def test_direct_light_has_the_exact_derivative_by_the_roughness():
    """Emitter sampling alone finds it, whose directions do not depend on the roughness."""
    world, materials, n = build_world(lit_gallery(False)), Textures(), 1500
    with torch.no_grad():
        materials.colour.fill_(0.5)
    si, u = camera_vertices(world, n, 2), Stream(5).uniform(n, DIMENSIONS)
    model = SceneModel(world, materials)

    def value():
        return Direct().reflected(model, si, materials(si), u, Stream(7)).value.double().sum()

    (grad,) = torch.autograd.grad(value(), [materials.rough])
    ends = []
    with torch.no_grad():
        for sign in (1.0, -1.0):
            materials.rough += sign * 0.004
            ends.append(float(value()))
            materials.rough -= sign * 0.004
    assert math.isclose(float(grad.sum()), (ends[0] - ends[1]) / 0.008, rel_tol=5e-3)
