"""Smooth mirrors and glass: closed forms, another renderer, and the training step behind a pane."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.delta_scenes import ETA, LIGHT, TINT, delta_gallery, delta_material, scene_of

from neurad.assembly.build import build_radiance, build_world
from neurad.assembly.fitted_materials import build_materials
from neurad.assembly.settings import Objective, Sampling
from neurad.core.camera import camera_rays
from neurad.core.parameters import RECOVERED
from neurad.core.records import PixelBatch, Rays
from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.core.rng import Stream
from neurad.core.scene_records import EnvironmentMap
from neurad.fields.settings import FieldConfig, GridConfig, RadianceConfig
from neurad.integrators.delta import MAX_CHAIN
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import render
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import MethodRenderer, path_tracer
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import box, quad
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials
from neurad.training.objective import ObjectiveStep


def path(scene, **settings):
    world = build_world(scene)
    return path_tracer(world, TrueMaterials(scene, world.geometry), **settings)


def bundle(n, o, d):
    unit = torch.nn.functional.normalize(torch.tensor(d, dtype=torch.float32), dim=0)
    return Rays(torch.tensor(o, dtype=torch.float32).expand(n, 3).contiguous(), unit.expand(n, 3).contiguous())


def wall(z, towards, size=100.0):
    """A large square at ``z`` that faces along ``towards`` * z."""
    side = (size * towards, 0, 0)
    return quad((-size / 2 * towards, -size / 2, z), side, (0, size, 0))


# ---- closed forms


@pytest.mark.parametrize(
    ("d", "faces", "two_sided", "reflectance"),
    [
        ((0.0, 0.0, -1.0), 1, True, 1.0),
        ((0.3, -0.2, -1.0), 1, False, 1.0),
        ((0.1, 0.0, -1.0), -1, True, 1.0),
        ((0.1, 0.0, -1.0), -1, False, 0.0),
    ],
)
def test_a_mirror_shows_the_wall_behind_the_camera_and_a_one_sided_one_is_black_from_behind(
    d, faces, two_sided, reflectance
):
    mirror = wall(-1, faces, 4.0), delta_material(ConductorModel(), TINT, two_sided), None
    scene = scene_of(mirror, (wall(3, -1), diffuse("wall", 0.0), LIGHT))
    seen = path(scene)(bundle(64, (0.0, 0.0, 1.0), d), 0)
    torch.testing.assert_close(seen, torch.tensor(np.float32(reflectance) * TINT * LIGHT).expand(64, 3))


def fresnel(degrees):
    cos = math.cos(math.radians(degrees))
    cos_t = math.sqrt(1 - (1 - cos**2) / ETA**2)
    s, p = (cos - ETA * cos_t) / (cos + ETA * cos_t), (ETA * cos - cos_t) / (ETA * cos + cos_t)
    return (s * s + p * p) / 2


@pytest.mark.parametrize("degrees", [0, 45, 75])
def test_a_glass_slab_splits_light_as_fresnel_says(degrees):
    """With F at either face, all inner reflections summed: T = (1 - F) / (1 + F) and R = 1 - T. The walls send light
    of different colours, so both are seen. 99.9 % confidence for each."""
    slab = box((-50, -50, -0.1), (50, 50, 0.1))
    red, blue = np.array([1, 0, 0], np.float32), np.array([0, 0, 1], np.float32)
    scene = scene_of(
        (slab, delta_material(DielectricModel()), None),
        (wall(-1, 1), diffuse("behind", 0.0), red),
        (wall(1, -1), diffuse("before", 0.0), blue),
    )
    n = 60_000
    tangent = math.tan(math.radians(degrees))
    seen = path(scene, max_depth=1)(bundle(n, (0.0, 0.0, 0.5), (0.6 * tangent, 0.8 * tangent, -1.0)), 3)
    f = fresnel(degrees)
    through = (1 - f) / (1 + f)
    error = math.sqrt(through * (1 - through) / n)
    assert abs(seen[:, 0].mean().item() - through) < 3.3 * error
    assert abs(seen[:, 2].mean().item() - (1 - through)) < 3.3 * error
    torch.testing.assert_close(seen.sum(-1), torch.ones(n))  # eta^2 in and out cancel; nothing is lost


def test_radiance_inside_glass_is_stretched_by_the_square_of_its_index():
    slab = box((-50, -50, -2.0), (50, 50, 0.0))
    scene = scene_of(
        (slab, delta_material(DielectricModel()), None), (wall(1, -1), diffuse("wall", 0.0), np.ones(3, np.float32))
    )
    inside = bundle(20_000, (0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    seen = path(scene, max_depth=1)(inside, 1).mean(-1)
    # Seen from inside through the top face, or after reflections at it and at the bottom, beyond which it is dark.
    f = fresnel(0)
    expected = ETA**2 * (1 - f) / (1 - f * f)
    assert abs(seen.mean().item() - expected) < 3.3 * seen.std().item() / math.sqrt(len(seen))


def test_total_reflection_keeps_light_in_the_slab():
    slab = box((-50, -50, -0.1), (50, 50, 0.1))
    scene = scene_of((slab, delta_material(DielectricModel()), None), (wall(1, -1), diffuse("wall", 0.0), LIGHT))
    seen = path(scene, max_depth=1)(bundle(1000, (0.0, 0.0, 0.0), (1.0, 0.0, 0.8)), 1)  # critical angle 41.8 degrees
    assert (seen == 0).all()


def test_a_chain_between_facing_mirrors_ends():
    scene = scene_of(
        (wall(-1, 1, 4.0), delta_material(ConductorModel()), None),
        (wall(1, -1, 4.0), delta_material(ConductorModel()), None),
        (wall(9, -1), diffuse("wall", 0.5), LIGHT),
    )
    integrator = path(scene)
    world = integrator.scene.world
    reached = world.trace_past_delta(bundle(5, (0.1, 0.2, 0.0), (0.0, 0.0, -1.0)), torch.rand(5))
    assert world.tracer.rays_cast == 5 * (1 + MAX_CHAIN)
    assert int(world.delta.begun) == int(world.delta.absorbed) == 5
    assert not reached.si.valid.any()
    assert (reached.throughput == 0).all()
    assert reached.via_delta.all()
    assert (integrator(bundle(5, (0.1, 0.2, 0.0), (0.0, 0.0, -1.0)), 0) == 0).all()


def test_only_lanes_that_meet_something_smooth_change():
    scene = scene_of(
        (wall(-1, 1, 2.0), delta_material(ConductorModel(), TINT), None), (wall(-2, 1), diffuse("wall", 0.5), LIGHT)
    )
    world = build_world(scene)
    rays = Rays.cat(bundle(2, (5.0, 0.0, 0.0), (0.0, 0.0, -1.0)), bundle(2, (0.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    reached = world.trace_past_delta(rays, torch.rand(4))
    assert reached.via_delta.tolist() == [False, False, True, True]
    assert reached.si.valid.tolist() == [True, True, False, False]
    torch.testing.assert_close(reached.throughput, torch.tensor([[1.0] * 3] * 2 + [TINT.tolist()] * 2))
    torch.testing.assert_close(reached.si.p[:2, 2], torch.tensor([-2.0, -2.0]))


# ---- a room with a mirror and glass


SMALL = GridConfig(levels=2, coarsest=4, finest=8, log2_size=10)


def estimator_of(scene):
    materials = build_materials(
        scene, dict.fromkeys(RECOVERED, FieldConfig(SMALL, 16)), Geometry(scene), known_emitters=False
    )
    radiance = build_radiance(scene, RadianceConfig(grid=SMALL, width=16, hidden_layers=1))
    return Estimator(build_world(scene), materials, radiance)


def batch_of(scene, n, seed=0):
    camera = scene.train[0].camera
    stream = Stream(seed)
    view, pixel = stream.integers(len(scene.train), n), stream.integers(camera.width * camera.height, n)
    return PixelBatch(view, pixel, stream.uniform(n, 3), torch.ones(n), 0)


def test_both_ways_to_the_first_hits_see_the_same_picture():
    """In a scene without anything smooth: the mean over a pixel of what is seen, by kept and by new rays."""
    scene = delta_gallery()
    scene = replace(scene, materials=[diffuse("grey", 0.5)] * len(scene.materials))
    world = build_world(scene)
    primary = PrimaryHits(world, [v.camera for v in scene.train], 64, 0, torch.device("cpu"))
    batch = batch_of(scene, 40)
    kept = primary(batch, 64, Stream(1)).si.p.view(40, 64, 3).mean(1)
    anew = primary._anew(batch, 64, Stream(2)).si.p.view(40, 64, 3)
    error = anew.std(1) / 8 + 1e-5  # the kept ones are stratified: their part of the noise is small
    assert ((kept - anew.mean(1)).abs() / error).max() < 5.5  # 120 numbers
    assert ((kept - anew.mean(1).roll(1, 0)).abs() / error).max() > 50  # a wrong order would be seen


@pytest.mark.parametrize("has_sky", [False, True])
def test_pixels_that_show_something_smooth_or_the_sky(has_sky):
    """They may show small lights, so nothing is spread there: what many rays through a pixel meet says which."""
    scene = delta_gallery()
    del scene.meshes[0]  # without walls, so that there is something beyond
    scene = replace(scene, environment=EnvironmentMap(np.ones((2, 4, 3), np.float32)) if has_sky else None)
    world, cameras = build_world(scene), [view.camera for view in scene.train]
    found = PrimaryHits(world, cameras, 0, 0, torch.device("cpu")).sees_beyond()
    smooth = torch.tensor([material.model.is_delta for material in scene.materials])
    inside = (torch.arange(16) + 0.5) / 16
    for beyond, camera in zip(found, cameras, strict=True):
        corners = torch.cartesian_prod(torch.arange(camera.height), torch.arange(camera.width)).flip(1)
        positions = corners.unsqueeze(1) + torch.cartesian_prod(inside, inside)  # [h * w, 256, 2]
        hit = world.tracer.closest(camera_rays(camera, positions.view(-1, 2)))
        met = torch.where(hit.valid, smooth[world.geometry.material[hit.prim.clamp_min(0)]], has_sky)
        met = met.view(len(corners), -1)
        assert not (beyond & ~met.any(1)).any()
        assert not (~beyond & met.all(1)).any()
    assert found.any()
    assert has_sky or not found.all()


def test_a_training_step_behind_glass():
    scene = delta_gallery()
    estimator = estimator_of(scene)
    primary = PrimaryHits(estimator.world, [v.camera for v in scene.train], 2, 0, torch.device("cpu"))
    step = ObjectiveStep(estimator, primary, Sampling(), Objective(), 0.01, primary.sees_emitter())
    terms = step(batch_of(scene, 200), Stream(3))
    assert set(terms.materials) == {"photometric"}
    assert set(terms.field) == {"prior", "prior_extra_bounce", "lhs"}
    for parameters, losses in (
        (estimator.materials.parameters(), terms.materials),
        (estimator.radiance.parameters(), terms.field),
    ):
        sum(loss.surrogate for _, loss in losses.values()).backward()
        for p in parameters:
            g = p.grad.coalesce().values() if p.grad.is_sparse else p.grad
            assert torch.isfinite(g).all()
            assert p.numel() == 1 or g.abs().sum() > 0


def test_the_rhs_behind_glass_is_emission_times_throughput_plus_reflection():
    """The image that a step compares with photographs has the mean of the RHS integrator's, pixel by pixel (99 %)."""
    stats = pytest.importorskip("scipy.stats")
    from helpers.oracles import accept

    scene = delta_gallery()
    estimator = estimator_of(scene)
    primary = PrimaryHits(estimator.world, [v.camera for v in scene.train], 2, 0, torch.device("cpu"))
    camera = scene.train[0].camera
    n, repeats = camera.width * camera.height, 24
    batch = PixelBatch(torch.zeros(n, dtype=torch.int64), torch.arange(n), torch.zeros(n, 3), torch.ones(n), 0)
    integrator = MethodRenderer(Radiometric(), estimator)
    right, ours = [], []
    with torch.no_grad():
        for seed in range(repeats):
            right.append(render(camera, integrator, 16, seed).view(n, 3).numpy())
            first = primary(batch, 8, Stream(9, seed))
            samples = estimator.reflected(first.si, estimator.materials(first.si), 2, Stream(10, seed))
            image = first.attenuate(estimator.world.emitted(first.si) + samples.mean(1)).view(n, 8, 3).mean(1)
            ours.append(image.numpy())
    right, ours = np.stack(right).mean(-1), np.stack(ours).mean(-1)
    p = stats.ttest_ind(right, ours, axis=0, equal_var=False).pvalue
    p = p[np.isfinite(p)]  # what sees the lamp alone has no variance
    assert p.size > 0.8 * n
    assert accept(p)
