"""Smooth mirrors and glass: closed forms, the training step behind them, and what shadow rays bring through panes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.delta_scenes import (
    ETA,
    LIGHT,
    TINT,
    bright_sky,
    delta_gallery,
    delta_material,
    fresnel,
    scene_of,
    window_room,
)
from helpers.oracles import accept
from helpers.pathtraced import paths
from helpers.small_step import SmallStep
from scipy import stats

from benchmarks.rooms.solids import ball
from neurad.assembly.build import build_world
from neurad.assembly.lighting import relit_world
from neurad.assembly.settings import Sampling
from neurad.core.camera import camera_rays
from neurad.core.records import PixelBatch, Rays
from neurad.core.reflection import ConductorModel, DielectricModel
from neurad.core.rng import Stream
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.lights import parts
from neurad.integrators.delta import MAX_CHAIN
from neurad.integrators.film import render
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.renderer import MethodRenderer, path_tracer
from neurad.runtime import lanes
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import box, quad
from neurad.scene.textures import TrueMaterials


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
    seen = paths(scene)(bundle(64, (0.0, 0.0, 1.0), d), 0)
    torch.testing.assert_close(seen, torch.tensor(np.float32(reflectance) * TINT * LIGHT).expand(64, 3))


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
    seen = paths(scene, 1)(bundle(n, (0.0, 0.0, 0.5), (0.6 * tangent, 0.8 * tangent, -1.0)), 3)
    f = fresnel(math.cos(math.radians(degrees)))
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
    seen = paths(scene, 1)(inside, 1).mean(-1)
    # Seen from inside through the top face, or after reflections at it and at the bottom, beyond which it is dark.
    f = fresnel(1.0)
    expected = ETA**2 * (1 - f) / (1 - f * f)
    assert abs(seen.mean().item() - expected) < 3.3 * seen.std().item() / math.sqrt(len(seen))


def test_total_reflection_keeps_light_in_the_slab():
    slab = box((-50, -50, -0.1), (50, 50, 0.1))
    scene = scene_of((slab, delta_material(DielectricModel()), None), (wall(1, -1), diffuse("wall", 0.0), LIGHT))
    seen = paths(scene, 1)(bundle(1000, (0.0, 0.0, 0.0), (1.0, 0.0, 0.8)), 1)  # critical angle 41.8 degrees
    assert (seen == 0).all()


def test_a_chain_between_facing_mirrors_ends():
    scene = scene_of(
        (wall(-1, 1, 4.0), delta_material(ConductorModel()), None),
        (wall(1, -1, 4.0), delta_material(ConductorModel()), None),
        (wall(9, -1), diffuse("wall", 0.5), LIGHT),
    )
    integrator = paths(scene)
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


def test_both_ways_to_the_first_hits_see_the_same_picture():
    """In a scene without anything smooth: the mean over a pixel of what is seen, by kept and by new rays."""
    scene = delta_gallery()
    scene = replace(scene, materials=[diffuse("grey", 0.5)] * len(scene.materials))
    made = SmallStep(Sampling(cached_spp=64), scene=scene)
    batch = made.batch(40)
    kept = made.primary(batch, 64, Stream(1)).si.p.view(40, 64, 3).mean(1)
    anew = made.primary._anew(batch, 64, Stream(2)).si.p.view(40, 64, 3)
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
    made = SmallStep(scene=delta_gallery())
    terms = made.step(made.batch(200), Stream(3))
    assert set(terms.materials) == {"photometric"}
    assert set(terms.field) == {"prior", "prior_extra_bounce", "lhs"}
    for module, losses in ((made.materials, terms.materials), (made.radiance, terms.field)):
        sum(loss.surrogate for _, loss in losses.values()).backward()
        for p in module.parameters():
            g = p.grad.coalesce().values() if p.grad.is_sparse else p.grad
            assert torch.isfinite(g).all()
            assert p.numel() == 1 or g.abs().sum() > 0


def test_the_rhs_behind_glass_is_emission_times_throughput_plus_reflection():
    """The image that a step compares with photographs has the mean of the RHS integrator's, pixel by pixel (99 %)."""
    scene = delta_gallery()
    made = SmallStep(scene=scene)
    estimator = made.estimator
    camera = scene.train[0].camera
    n, repeats = camera.width * camera.height, 24
    batch = PixelBatch(torch.zeros(n, dtype=torch.int64), torch.arange(n), torch.zeros(n, 3), torch.ones(n), 0)
    integrator = MethodRenderer(Radiometric(), estimator)
    right, ours = [], []
    with torch.no_grad():
        for seed in range(repeats):
            right.append(render(camera, integrator, 16, seed).view(n, 3).numpy())
            first = made.primary(batch, 8, Stream(9, seed))
            samples = estimator.reflected(first.si, estimator.materials(first.si), 2, Stream(10, seed))
            image = first.attenuate(estimator.world.emitted(first.si) + samples.mean(1)).view(n, 8, 3).mean(1)
            ours.append(image.numpy())
    right, ours = np.stack(right).mean(-1), np.stack(ours).mean(-1)
    p = stats.ttest_ind(right, ours, axis=0, equal_var=False).pvalue
    p = p[np.isfinite(p)]  # what sees the lamp alone has no variance
    assert p.size > 0.8 * n
    assert accept(p)


# ---- panes: what shadow rays bring through them


def visibility(glass, d, t_max=math.inf):
    """What gets from the origin along d through glass."""
    material = delta_material(DielectricModel(ETA, thin=len(glass.faces) == 2))
    rays = Rays(torch.zeros(1, 3), torch.nn.functional.normalize(torch.tensor([d]), dim=-1))
    world = build_world(scene_of((glass, material, None), environment=bright_sky()))
    return float(world.visibility(rays, torch.tensor([t_max])))


SHEET, SLAB = quad((-50, -50, 1), (100, 0, 0), (0, 100, 0)), box((-50, -50, 1.0), (50, 50, 1.1))


@pytest.fixture(params=[False, True], ids=["some lanes", "all lanes"])
def every(request, monkeypatch):
    if request.param:
        monkeypatch.setattr(lanes, "FULL_DEVICES", ("cpu", "cuda"))


@pytest.mark.parametrize("degrees", [0, 40, 80])
def test_a_pane_lets_through_what_fresnel_says(every, degrees):
    d = (0.6 * math.tan(math.radians(degrees)), 0.8 * math.tan(math.radians(degrees)), 1.0)
    f = fresnel(math.cos(math.radians(degrees)))
    assert visibility(SHEET, d) == pytest.approx((1 - f) / (1 + f), rel=1e-4)
    assert visibility(SHEET, d, 100.0) == pytest.approx((1 - f) / (1 + f), rel=1e-4)
    assert visibility(SHEET, d, 0.5) == 1.0
    assert visibility(SLAB, d) == pytest.approx((1 - f) ** 2, rel=1e-4)  # inner reflections are found by BSDF samples
    assert visibility(SLAB, d, 100.0) == 0.0  # what lies behind it at a distance is seen beside its place


def test_glass_that_bends_light_hides_it():
    assert visibility(ball((0.0, 0.0, 2.0), 1.0, 1.0), (0.3, 0.0, 1.0)) == 0.0


@pytest.mark.parametrize("thin", [True, False])
def test_a_floor_under_glass_gets_the_integral(thin):
    """An endless pane under a constant sky; both techniques together, in an interval of 99.9 %."""
    cover = quad((-50, 1, -50), (0, 0, 100), (100, 0, 0)) if thin else box((-50, 1.0, -50), (50, 1.1, 50))
    floor = quad((-50, 0, -50), (0, 0, 100), (100, 0, 0))
    parts = (cover, delta_material(DielectricModel(ETA, thin)), None), (floor, diffuse("floor", 0.5), None)
    environment = EnvironmentMap(np.ones((2, 4, 3), np.float32))
    rays = bundle(20_000, (0.0, 0.5, 0.0), (0.0, -1.0, 0.0))
    seen = paths(scene_of(*parts, environment=environment), 2)(rays, 1)[:, 0]
    cos = (np.arange(100_000) + 0.5) / 100_000
    expected = 0.5 * float(np.mean(2 * cos * (1 - fresnel(cos)) / (1 + fresnel(cos))))
    assert abs(float(seen.mean()) - expected) < 3.3 * float(seen.std()) / math.sqrt(len(seen))
    assert float(seen.std()) < 0.5 * expected


def test_pictures_draw_light_towards_the_window():
    """Those in the scene's own light and in another: the same mean with less noise."""
    scene = window_room(True, bright_sky())
    own = build_world(scene)
    for world in (own, relit_world(own, scene, bright_sky(4))):
        _, environment, _ = parts(world.lights)
        assert environment.openings is not None
        integrator = path_tracer(world, TrueMaterials(scene, world.geometry), max_depth=2)
        camera, found = scene.train[1].camera, []
        for _ in range(2):
            found.append(torch.stack([render(camera, integrator, 16, seed) for seed in range(8)]))
            environment.openings = None
        noise = [x.var(0).mean() for x in found]
        assert noise[0] < 0.75 * noise[1]
        error = math.sqrt(sum(float(x.mean((1, 2, 3)).var()) for x in found) / 8)
        assert abs(float(found[0].mean() - found[1].mean())) < 4 * error
