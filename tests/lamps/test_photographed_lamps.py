"""What photographs say about lamps: against photographs that are rendered here, of lamps of known radiance."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import Photographs, lamp_room

from neurad.assembly.build import build_world
from neurad.core.records import PixelBatch
from neurad.core.scene_records import Camera
from neurad.integrators.emitter_pixels import emitter_pixels
from neurad.integrators.film import render
from neurad.integrators.renderer import path_tracer
from neurad.lamps import photographed as lamps
from neurad.lamps.known import refusal, report
from neurad.lamps.photographed import (
    REFUSE,
    WARN,
    PhotographedLamp,
    lamp_photographs,
    lamp_pixels,
    photographed_lamps,
)
from neurad.scene.builtin import build
from neurad.scene.textures import TrueMaterials

SIZE = 24


@pytest.fixture(scope="module")
def box():
    """A Cornell box whose lamp fills part of two pictures taken from below, as its photographs show it."""
    scene = build("cornell")
    lamp = next(mesh for mesh in scene.meshes if mesh.radiance is not None)
    middle = lamp.vertices.mean(0)
    poses = []
    for shift in (0.0, 0.05):
        pose = np.eye(4, dtype=np.float32)
        pose[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # looks up: -z of the camera is +y
        pose[:3, 3] = middle - [shift, 0.9, 0.0]
        poses.append(pose)
    cameras = [Camera(pose, 1.0, SIZE, SIZE) for pose in poses]
    world = build_world(scene)
    materials = TrueMaterials(scene, world.geometry)
    photographs = torch.stack([render(c, path_tracer(world, materials), 16, 3).view(-1, 3) for c in cameras])
    return scene, world, materials, cameras, photographs


def measured(box, photographs, scene=None, develop=None):
    first, world, materials, cameras, _ = box
    scene = scene or first
    world = world if scene is first else build_world(scene)
    view, pixel = (~emitter_pixels(world, cameras, 1, torch.device("cpu"))).nonzero().unbind(-1)
    sample = PixelBatch(view, pixel, photographs[view, pixel], torch.ones(len(view)), 0)
    shown = lamp_photographs(world, cameras, Photographs(photographs), sample, 1).developed(develop)
    (lamp,) = photographed_lamps(scene, world, materials, cameras, shown, 1)
    return lamp


def times(scene, factor):
    """The scene with a lamp that is declared brighter."""
    factor = np.asarray(factor, np.float32)
    lit = [m if m.radiance is None else replace(m, radiance=m.radiance * factor) for m in scene.meshes]
    return replace(scene, meshes=lit)


def test_a_right_lamp_is_found_right_without_what_it_reflects(box):
    """The lamp reflects part of the room's light: less than it is measured with, and more than none."""
    lamp = measured(box, box[4])
    assert lamp.pixels > 50
    assert lamp.views == 2
    assert lamp.clipped == 0
    np.testing.assert_allclose(lamp.factor, 1.0, atol=0.02)
    np.testing.assert_allclose(lamp.radiance, lamp.declared, rtol=0.02)
    assert (lamp.photographed > lamp.declared * 1.005).all()
    assert (lamp.reflected > 0).all()
    assert not lamp.beyond(WARN)
    lines = report([lamp])
    assert len(lines) == 1
    assert "photographed over declared radiance" in lines[0]


def test_photographs_of_unlike_exposures_are_developed_first(box):
    gains = torch.tensor([[2.0], [0.25]])

    def develop(batch):
        return replace(batch, color=batch.color / gains[batch.view])

    lamp = measured(box, box[4] * gains.unsqueeze(1), develop=develop)
    np.testing.assert_allclose(lamp.factor, 1.0, atol=0.02)
    assert measured(box, box[4] * gains.unsqueeze(1)).beyond(WARN)


@pytest.mark.parametrize("factor", [4.0, 0.1, (1.0, 0.7, 0.4)])
def test_a_wrong_lamp_is_found_wrong_by_its_factor(box, factor):
    scene = times(box[0], factor)
    lamp = measured(box, box[4], scene)
    np.testing.assert_allclose(lamp.factor, np.broadcast_to(1.0 / np.asarray(factor), 3), rtol=0.03)
    np.testing.assert_allclose(lamp.radiance, [17, 12, 4], rtol=0.03)
    assert lamp.beyond(WARN)
    assert lamp.beyond(REFUSE) == (not isinstance(factor, tuple))
    assert any(line.startswith("warning: lamp light is") for line in report([lamp]))
    if lamp.beyond(REFUSE):
        way = "darker" if factor > 1 else "brighter"
        assert f"times {way} in the photographs than the declared radiance" in refusal([lamp])
    else:
        assert "2.5 times brighter in blue" in report([lamp])[1]


def test_clipped_pixels_say_nothing(box):
    """Where surfaces reach the ceiling, too, or it is that of a format, a lamp at it is clipped; alone it is not."""
    photographs = box[4].clamp_max(1.0)
    lamp = measured(box, photographs)
    assert lamp.clipped == lamp.pixels
    assert np.isnan(lamp.factor).all()
    assert not lamp.beyond(WARN)
    assert "half or more of them clipped in each, so it cannot be checked" in report([lamp])[0]
    bright = box[4].clamp_max(2.5)
    bright[:, :2] = 2.5  # two pixels of the ceiling
    assert measured(box, bright).clipped == lamp.pixels
    even = box[4].clamp_max(16.0)  # no surface is as bright
    assert measured(box, even).clipped == 0


def test_a_lamp_that_no_pixel_shows_alone_is_named(box):
    first = box[3][0]
    away = replace(first, to_world=np.diag([1.0, -1.0, -1.0, 1.0]).astype(np.float32) @ first.to_world)
    lamp = shown_by((*box[:3], [away], box[4]), Photographs(box[4]))
    assert lamp.pixels == 0
    assert report([lamp]) == []
    told = report([lamp, replace(measured(box, box[4]), name="other")])
    assert told[1] == "no photograph shows light alone in a pixel: nothing checks the radiance there"


def test_masked_pixels_do_not_count(box):
    _, world, _, cameras, _ = box
    everything = torch.ones(2, SIZE * SIZE, dtype=torch.bool)
    assert len(lamp_pixels(world, cameras, 1, everything).view) == 0


class Clipping(Photographs):
    """Photographs that say where they are clipped: from a ceiling of each view on."""

    def __init__(self, pixels, ceilings):
        self.ceilings = torch.tensor(ceilings).view(-1, 1, 1)
        super().__init__(pixels.minimum(self.ceilings))

    def clipped(self, view, pixel):
        return self.pixels[view, pixel] >= self.ceilings[view, 0]


def shown_by(box, photographs):
    """The lamp as such photographs show it."""
    scene, world, materials, cameras, _ = box
    sample = PixelBatch(torch.zeros(1).long(), torch.zeros(1).long(), torch.ones(1, 3), torch.ones(1), 0)
    shown = lamp_photographs(world, cameras, photographs, sample, 1)
    (lamp,) = photographed_lamps(scene, world, materials, cameras, shown, 1)
    return lamp


def test_the_border_of_a_saturated_lamp_is_not_the_lamp(box):
    """The pose is off by two pixels, so some of its pixels show the ceiling beside it, hundred times darker."""
    moved = box[4].view(2, SIZE, SIZE, 3).roll(2, 2).reshape(2, -1, 3)
    at = lamp_pixels(box[1], box[3], 1)
    free = int((moved[at.view, at.pixel] < 1.0).all(-1).sum())
    lamp = shown_by(box, Clipping(moved, (1.0, 1.0)))
    assert 8 <= free < lamp.pixels / 2
    assert lamp.clipped == lamp.pixels
    assert np.isnan(lamp.factor).all()
    assert not lamp.beyond(WARN)


def test_of_unlike_exposures_the_shorter_says_how_bright_a_lamp_is(box):
    lamp = shown_by(box, Clipping(box[4], (1.0, 100.0)))
    assert 0 < lamp.clipped < lamp.pixels
    np.testing.assert_allclose(lamp.factor, 1.0, atol=0.02)


def test_a_channel_in_which_a_lamp_is_dark_is_not_compared():
    """There only what it reflects shows, and that is a guess."""
    sent, back = np.array([3.0, 0.0, 0.0]), np.array([0.1, 0.08, 0.08])
    lamp = PhotographedLamp(0, "strip", sent, back, np.array([2.95, 0.015, 0.015]), 100, 3, 0)
    assert lamp.factor[1] < 1 / REFUSE
    assert not lamp.beyond(WARN)
    assert report([lamp])[0].startswith("lamp strip: photographed over declared radiance 0.95")
    red = replace(lamp, photographed=np.array([0.9, 0.015, 0.015]))
    assert "3.44 times darker in the photographs" in refusal([red])
    green = replace(lamp, photographed=np.array([2.95, 1.0, 0.015]))  # not dark there
    assert green.beyond(REFUSE)


def test_lamps_that_cannot_be_checked_do_not_count_as_agreeing(box):
    lamp = measured(box, box[4])
    full = replace(lamp, photographed=np.full(3, np.nan), clipped=lamp.pixels)
    said = report([lamp] * 8 + [full] * 2 + [lamp])
    assert said[-2:] == [
        "1 more lamps are as bright in the photographs as declared",
        "2 more lamps are clipped wherever they are shown, so they cannot be checked",
    ]


def test_a_small_lamp_is_looked_at_beside_a_large_one(monkeypatch):
    """The limit on pixels is one of each lamp."""
    scene = lamp_room()
    world, cameras = build_world(scene), [view.camera for view in scene.train]
    whole = lamp_pixels(world, cameras, 1)
    monkeypatch.setattr(lamps, "_MAX_PIXELS", 40)
    some = lamp_pixels(world, cameras, 1)
    index = {mesh.name: i for i, mesh in enumerate(scene.meshes)}
    strip, ceiling = (index[name] for name in ("strip", "ceiling lamp"))
    assert int((some.mesh == ceiling).sum()) < int((whole.mesh == ceiling).sum())
    assert int((some.mesh == strip).sum()) > 0.4 * int((whole.mesh == strip).sum())
