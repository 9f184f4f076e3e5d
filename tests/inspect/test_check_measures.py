"""Measures of a check against closed forms: free space, seen area, exposure, clipped pixels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neurad.assembly.build import build_world
from neurad.core.records import Camera
from neurad.evidence.view_residuals import few
from neurad.inspect.check.photograph_facts import photograph_facts
from neurad.inspect.check.seen_area import POINTS, seen_points
from neurad.inspect.check.surroundings import both_ways, surroundings
from neurad.inspect.check.view_exposure import exposure_ratios, rendered
from neurad.metrics.seen import SeenBy
from neurad.scene.builtin import build
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials


def standing(place, fov=1.2):
    pose = np.eye(4, dtype=np.float32)
    pose[:3, 3] = place
    return Camera(pose, fov, 16, 16)


def test_directions_come_in_pairs_and_cover_the_sphere():
    d = both_ways(256)
    torch.testing.assert_close(d[:256], -d[256:])
    torch.testing.assert_close(d.norm(dim=-1), torch.ones(512))
    torch.testing.assert_close(d.T @ d / 512, torch.eye(3) / 3, atol=5e-3, rtol=0)


def test_free_space_in_a_slab_and_beside_it():
    """Between parallel planes at a distance of 1 the way through is 1 / cos, the median of which is 2."""
    side = 400.0
    floor = quad((-side / 2, 0.0, -side / 2), (0, 0, side), (side, 0, 0))
    ceiling = quad((-side / 2, 1.0, -side / 2), (side, 0, 0), (0, 0, side))
    meshes = [solid.mesh(name, 0, smooth_shading=False) for name, solid in (("floor", floor), ("ceiling", ceiling))]
    world = build_world(Scene("slab", [meshes[0], replace(meshes[1], radiance=np.ones(3, np.float32))],
                              [diffuse("paint", 0.5)]))  # fmt: skip
    inside, above = surroundings(world, [standing((0.0, 0.3, 0.0)), standing((0.0, 1.5, 0.0))])
    assert inside.free < 0.02
    assert inside.width == pytest.approx(2.0, rel=0.02)
    assert inside.backs == 0.0  # both face each other
    assert above.free == pytest.approx(0.5, abs=0.02)
    assert math.isinf(above.width)
    assert above.backs == 1.0


def test_seen_area_is_what_is_in_sight():
    """A camera above the middle of a floor sees a square of it; the side away from it counts as the same surface."""
    floor = quad((-1.0, 0.0, -1.0), (0, 0, 2), (2, 0, 0)).mesh("floor", 0, smooth_shading=False)
    lamp = quad((5.0, 5.0, 5.0), (1, 0, 0), (0, 0, 1)).mesh(
        "lamp", 0, smooth_shading=False, radiance=np.ones(3, np.float32)
    )
    world = build_world(Scene("floor", [floor, lamp], [diffuse("paint", 0.5)]))
    down = standing((0.0, 1.0, 0.0), 2.0 * math.atan(0.5))
    down.to_world[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    points, seen = seen_points(world.geometry, SeenBy(world.geometry, world.tracer, [down]), 1)
    assert points.sum() == POINTS
    assert points[0] / POINTS == pytest.approx(0.8, abs=0.02)  # areas 4 and 1
    assert seen[0] / points[0] == pytest.approx(0.25, abs=0.02)
    assert seen[1] == 0


def test_exposure_is_the_ratio_of_means_without_fireflies():
    rng = np.random.default_rng(2)
    view = torch.arange(1200) // 600
    expected = torch.from_numpy(rng.gamma(4.0, 0.25, (1200, 3))).float()
    shown = expected * torch.from_numpy(rng.gamma(50.0, 0.02, (1200, 1))).float() * torch.tensor([3.0, 0.5])[view, None]
    expected[5] = 1e4
    ratios = exposure_ratios(shown, expected, view, 3)
    np.testing.assert_allclose(ratios[:2], [3.0, 0.5], rtol=0.05)
    assert np.isnan(ratios[2])


def test_clipped_black_and_equal_pixels():
    pixels = np.random.default_rng(3).random((80, 80, 3), np.float32)
    inside = np.ones((80, 80), bool)
    inside[:10] = False
    pixels[:10] = 7.0  # a lamp
    plain = photograph_facts(pixels, inside)
    assert plain.clipped < 0.001
    assert plain.highest == 7.0
    assert plain.levels > 256
    assert not plain.constant
    clipped = photograph_facts(np.minimum(pixels, 0.75), inside)
    assert clipped.clipped == pytest.approx(0.25, abs=0.02)
    dark = pixels.copy()
    dark[40:47] = 0.0
    assert photograph_facts(dark, inside).black == pytest.approx(0.1)
    assert photograph_facts(np.full_like(pixels, 0.5), inside).constant
    assert photograph_facts(np.round(pixels * 255) / 255, inside).levels <= 257


def test_rendered_pixels_are_those_of_the_photographs():
    """The Cornell box's photographs against its own materials: the mean over some pixels agrees to a few per cent."""
    from datamodules.scene_data import SceneData
    from datamodules.settings import DataSettings

    scene = build("cornell")
    world = build_world(scene)
    sample = few(SceneData(DataSettings(scene="cornell")).dataset_stats().sample, len(scene.train))
    kept = slice(None, None, 8)
    pixels = replace(sample, view=sample.view[kept], pixel=sample.pixel[kept], color=sample.color[kept])
    found = rendered(world, TrueMaterials(scene, world.geometry), [v.camera for v in scene.train], pixels, 4)
    assert float(found.mean() / pixels.color.mean()) == pytest.approx(1.0, abs=0.08)
