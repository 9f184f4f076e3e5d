"""The sun that photographs show: its direction, and none where there is none."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurad.assembly.build import build_world
from neurad.assembly.region import training_paths
from neurad.core.frame import Frame, dot, faceforward
from neurad.core.records import PixelBatch
from neurad.core.reflection import DielectricModel, DiffuseModel
from neurad.core.rng import Stream
from neurad.core.sampling import uniform_cone
from neurad.core.scene_records import Constant, EnvironmentMap, Material, Mesh, View
from neurad.integrators.primary_hits import PrimaryHits
from neurad.lamps.sky import find_sun, seen_sky
from neurad.scene.builtin.shapes import box, look_at
from neurad.scene.description import Scene

TOWARDS = np.array([0.8, 0.5, 0.33])
TOWARDS /= np.linalg.norm(TOWARDS)
SIZE, WINDOW = 64, ((1.0, 2.2), (-1.2, 0.3))
"""Pixels across, and the window in the wall at x = 2: y and z."""


def quad(*corners) -> np.ndarray:
    return np.array(corners, np.float32)


def room(pane: bool = False) -> Scene:
    """A room of 4 x 3 x 4 with a window, perhaps with a pane, a box that throws a shadow, and four cameras."""
    (y0, y1), (z0, z1) = WINDOW
    quads = [
        quad((-2, 0, -2), (-2, 0, 2), (2, 0, 2), (2, 0, -2)),
        quad((-2, 3, -2), (2, 3, -2), (2, 3, 2), (-2, 3, 2)),
        quad((-2, 0, -2), (-2, 3, -2), (-2, 3, 2), (-2, 0, 2)),
        quad((-2, 0, -2), (2, 0, -2), (2, 3, -2), (-2, 3, -2)),
        quad((-2, 0, 2), (-2, 3, 2), (2, 3, 2), (2, 0, 2)),
        *(quad((2, a, c), (2, a, d), (2, b, d), (2, b, c)) for a, b, c, d in (
            (0, y0, -2, 2), (y1, 3, -2, 2), (y0, y1, -2, z0), (y0, y1, z1, 2),
        )),
        quad((-0.5, 0.7, -1.0), (-0.5, 0.7, -0.3), (0.2, 0.7, -0.3), (0.2, 0.7, -1.0)),
    ]  # fmt: skip
    vertices = np.concatenate(quads)
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(quads))])
    material = Material(
        "paint", DiffuseModel(), Constant(np.full(3, 0.5, np.float32)), Constant(np.ones(1, np.float32))
    )
    views = [
        View(f"view_{i}", look_at(origin, target, math.degrees(1.4), SIZE))
        for i, (origin, target) in enumerate([
            ((1.7, 1.5, 1.5), (-1.5, 0.5, -1.0)), ((1.5, 2.5, -1.5), (-1.5, 0.3, 0.5)),
            ((-0.5, 2.7, 1.5), (-1.0, 0.0, -0.8)), ((1.0, 2.0, 0.0), (-2.0, 0.8, -0.5)),
        ])
    ]  # fmt: skip
    meshes = [Mesh("room", vertices, faces.astype(np.int64), 0)]
    white, smooth = Constant(np.ones(3, np.float32)), Constant(np.zeros(1, np.float32))
    glass = Material("glass", DielectricModel(), white, smooth, two_sided=True)
    if pane:
        meshes.append(box((2.0, y0, z0), (2.02, y1, z1)).mesh("pane", 1, smooth_shading=False))
    environment = EnvironmentMap(np.ones((2, 4, 3), np.float32))
    return Scene("room", meshes, [material, glass], environment=environment, train=views).check()


@pytest.fixture(scope="module")
def photographs(request):
    """Camera rays of the room, a sample of its pixels, and what the sun adds to them: its visibility times the cosine;
    the light from elsewhere falls off with the distance to the window, and paint has a pattern.
    """
    scene = room(request.param)
    world = build_world(scene)
    primary = PrimaryHits(world, [view.camera for view in scene.train], 0, 0, torch.device("cpu"))
    n = 1 << 15
    batch = PixelBatch(
        Stream(1).integers(len(scene.train), n), Stream(2).integers(SIZE * SIZE, n), torch.ones(n, 3), torch.ones(n), 0
    )
    si = primary(batch, 1, Stream(3)).si
    sun = lit(world, si, torch.from_numpy(TOWARDS).float())
    ambient = 1.0 / (1.0 + (si.p - torch.tensor([2.0, 1.6, -0.4])).square().sum(-1))
    paint = 0.4 + 0.3 * torch.sin(9.0 * si.p).prod(-1)
    return world, scene, primary, batch, sun, ambient, paint


@pytest.mark.parametrize(
    ("photographs", "strength"), [(False, 0.0), (False, 3.0), (True, 3.0)], indirect=["photographs"]
)
def test_the_sun_is_found_where_it_stands(photographs, strength):
    world, scene, primary, batch, sun, ambient, paint = photographs
    noise = 1.0 + 0.05 * torch.randn(len(sun), generator=torch.Generator().manual_seed(4))
    color = paint * (ambient + strength * sun) * noise.clamp_min(0.1)
    found = find_sun(primary, replace(batch, color=color[:, None].expand(-1, 3)), leaving(world, scene), 0)
    if strength == 0.0:
        assert found is None
    else:
        assert math.degrees(math.acos(min(1.0, float(found.towards @ TOWARDS)))) < 0.5
        assert found.contrast > 2.0
        # paint / pi * E * cos is what it adds; the albedo behind the first guess is not that of the paint
        assert 0.3 * math.pi * strength < found.irradiance[0] < 3.0 * math.pi * strength


@pytest.mark.parametrize("photographs", [False], indirect=True)
def test_a_wide_sun_is_found_within_its_disk(photographs):
    """Photographs of a sun blurred by haze say its direction no closer than that."""
    world, scene, primary, batch, _, ambient, paint = photographs
    radius, si = math.radians(2.0), primary(batch, 1, Stream(3)).si
    frame = Frame.around(torch.from_numpy(TOWARDS).float()[None].expand(64, 3))
    disk = frame.to_world(uniform_cone(Stream(5).uniform(64, 2), 2.0 * math.sin(0.5 * radius) ** 2))
    sun = torch.stack([lit(world, si, wi) for wi in disk]).mean(0)
    color = (paint * (ambient + 8.0 * sun))[:, None].expand(-1, 3)
    found = find_sun(primary, replace(batch, color=color), leaving(world, scene), 0)
    assert found is not None
    assert math.acos(min(1.0, float(found.towards @ TOWARDS))) < radius
    assert found.radius > 0.5 * radius


def lit(world, si, wi):
    """The cosine where surfaces see a direction [n]."""
    wi = wi.expand(len(si), 3)
    free = world.visibility(world.geometry.spawn(si, wi), torch.full((len(si),), math.inf))
    return free * dot(faceforward(si), wi).clamp_min(0.0)


def leaving(world, scene):
    paths = training_paths(world, scene)
    assert 0 < len(paths.leaving) < 0.5 * paths.bounces
    return paths.leaving.d


@pytest.mark.parametrize("pane", [False, True])
def test_sky_seen_through_a_pane_is_as_bright_as_it_is(pane):
    """Of photographs that are 1 where they show the sky: behind glass it is brighter by what that reflects."""
    world, camera = build_world(room(pane)), look_at((-1.0, 1.6, -0.4), (2.0, 1.7, -0.5), 40.0, SIZE)
    primary = PrimaryHits(world, [camera], 0, 0, torch.device("cpu"))
    pixel = torch.arange(SIZE * SIZE)
    batch = PixelBatch(torch.zeros_like(pixel), pixel, torch.ones(len(pixel), 3), torch.ones(len(pixel)), 0)
    d, radiance = seen_sky(primary, batch, 0)
    assert len(d) > 300
    assert bool((d[:, 0] > 0).all())
    torch.testing.assert_close(radiance, torch.full_like(radiance, 0.96**-2 if pane else 1.0), rtol=0.02, atol=0.0)
