"""Panes of glass: what shadow rays bring through them, closed forms, and Mitsuba."""

import math

import numpy as np
import pytest
import torch
from helpers.delta_scenes import ETA, delta_material, scene_of, window_room

from benchmarks.rooms.solids import ball
from neurad.assembly.build import build_world
from neurad.assembly.lighting import relit_world
from neurad.core.records import Rays
from neurad.core.reflection import DielectricModel
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.lights import parts
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.runtime import lanes
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import box, quad
from neurad.scene.textures import TrueMaterials


def fresnel(cos):
    cos_t = np.sqrt(1 - (1 - cos**2) / ETA**2)
    s, p = (cos - ETA * cos_t) / (cos + ETA * cos_t), (ETA * cos - cos_t) / (ETA * cos + cos_t)
    return (s * s + p * p) / 2


def sky(seed=3):
    """A map without any symmetry, with one bright texel."""
    pixels = np.random.default_rng(seed).uniform(0.2, 1.0, (8, 16, 3)).astype(np.float32)
    pixels[2, 3] = 5.0
    return EnvironmentMap(pixels)


def visibility(glass, d, t_max=math.inf):
    """What gets from the origin along d through glass."""
    material = delta_material(DielectricModel(ETA, thin=len(glass.faces) == 2))
    rays = Rays(torch.zeros(1, 3), torch.nn.functional.normalize(torch.tensor([d]), dim=-1))
    world = build_world(scene_of((glass, material, None), environment=sky()))
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


def direct(scene, n=20_000):
    """Direct light [n, 3] at a place of the floor of a scene."""
    world = build_world(scene)
    integrator = path_tracer(world, TrueMaterials(scene, world.geometry), max_depth=2)
    rays = Rays(torch.tensor([[0.0, 0.5, 0.0]]).expand(n, 3), torch.tensor([[0.0, -1.0, 0.0]]).expand(n, 3))
    return integrator(rays, 1)


@pytest.mark.parametrize("thin", [True, False])
def test_a_floor_under_glass_gets_the_integral(thin):
    """An endless pane under a constant sky; both techniques together, in an interval of 99.9 %."""
    cover = quad((-50, 1, -50), (0, 0, 100), (100, 0, 0)) if thin else box((-50, 1.0, -50), (50, 1.1, 50))
    floor = quad((-50, 0, -50), (0, 0, 100), (100, 0, 0))
    parts = (cover, delta_material(DielectricModel(ETA, thin)), None), (floor, diffuse("floor", 0.5), None)
    environment = EnvironmentMap(np.ones((2, 4, 3), np.float32))
    seen = direct(scene_of(*parts, environment=environment))[:, 0]
    cos = (np.arange(100_000) + 0.5) / 100_000
    expected = 0.5 * float(np.mean(2 * cos * (1 - fresnel(cos)) / (1 + fresnel(cos))))
    assert abs(float(seen.mean()) - expected) < 3.3 * float(seen.std()) / math.sqrt(len(seen))
    assert float(seen.std()) < 0.5 * expected


def test_pictures_draw_light_towards_the_window():
    """Those in the scene's own light and in another: the same mean with less noise."""
    scene = window_room(True, sky())
    own = build_world(scene)
    for world in (own, relit_world(own, scene, sky(4))):
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
