"""How far photographs lie beside each other is measured to a tenth of a pixel, whatever else they differ in."""

import math

import numpy as np
import pytest
import torch
from helpers.lamp_room import lamp_room
from helpers.textured_room import CAMERAS, SIZE, Photos, pattern, photographed, turned

from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays, project, to_camera
from neurad.evidence.texture_offsets import PRECISE, SIDE, offsets, texture_offsets

SEED = 5


@pytest.fixture(scope="module")
def world():
    return build_world(lamp_room())


@pytest.mark.parametrize("way", [(0.0, 0.0), (0.3, -0.2), (-1.1, 0.7), (1.8, 1.5)])
def test_a_patch_says_how_far_it_was_moved(way):
    count, shift = 200, torch.tensor(way, dtype=torch.float64)
    y, x = torch.meshgrid(*[torch.arange(SIDE).double()] * 2, indexing="ij")
    rng, mine, theirs = np.random.default_rng(2), [], []
    for seed in range(count):
        place = torch.stack((x, y), -1)
        mine.append(pattern(place, seed, (8.0, 20.0)).log())
        theirs.append(pattern(place - shift, seed, (8.0, 20.0)).log() + 0.02 * x + 1.0)  # and other light
    mine, theirs = (
        torch.stack(t) + 0.05 * torch.from_numpy(rng.normal(size=(count, SIDE, SIDE))) for t in (mine, theirs)
    )
    found, error, along = offsets(mine, theirs)
    off = found - along @ shift
    assert float(error.median()) < 0.1
    assert abs(float(off.median())) < 0.02
    assert 0.6 < 1.4826 * float((off / error).abs().median()) < 1.6  # errors are what they are said to be


def test_a_patch_without_texture_says_nothing():
    rng = torch.Generator().manual_seed(0)
    flat, noisy = torch.zeros(1, SIDE, SIDE).double(), torch.rand(50, SIDE, SIDE, generator=rng).double()
    assert bool(offsets(flat, flat)[1].isinf().all())
    assert float((offsets(noisy, noisy.flip(0))[1] > PRECISE).float().mean()) > 0.9


def test_photographs_of_right_poses_agree_and_those_of_wrong_ones_do_not(world):
    shown = photographed(world, CAMERAS)
    exact = texture_offsets(world, CAMERAS, shown, SEED).summary(len(CAMERAS))
    assert exact.pixels < 0.1
    assert exact.sentences([str(i) for i in range(8)]) == []
    given = [turned(camera, 0.8, index) for index, camera in enumerate(CAMERAS)]
    off = texture_offsets(world, given, shown, SEED).summary(len(CAMERAS))
    # What a turn moves on the film, rms over views and places.
    xy = torch.cartesian_prod(*[torch.linspace(8.0, SIZE - 8.0, 9, dtype=torch.float64)] * 2)
    moves = [
        project(wrong, to_camera(wrong, torch.from_numpy(camera.to_world[:3, 3]) + camera_rays(camera, xy).d)) - xy
        for camera, wrong in zip(CAMERAS, given, strict=True)
    ]
    expected = float(torch.stack(moves).square().sum(-1).mean().sqrt())
    assert 0.7 * expected < off.pixels < 1.4 * expected
    (said,) = off.sentences([str(i) for i in range(8)])
    assert said.startswith(f"photographs disagree by {off.pixels:.1f} pixels")
    assert 0.005 < off.length < 0.1  # a pixel is 0.01 to 0.05 units wide on these walls


def test_one_photograph_that_lies_beside_the_others_is_named_alone(world):
    shown = photographed(world, CAMERAS)
    given = [turned(camera, 2.0 * (index == 5), 4) for index, camera in enumerate(CAMERAS)]
    found = texture_offsets(world, given, shown, SEED).summary(len(CAMERAS))
    assert found.beside == (5,)
    assert found.pixels < 0.2
    (said,) = found.sentences([f"view_{i}" for i in range(8)])
    assert "view_5 (" in said
    assert "check the pose" in said


def test_blank_walls_and_single_photographs_are_not_judged(world):
    blank = photographed(world, CAMERAS, lambda p: torch.ones(len(p)).double())
    for cameras in (CAMERAS, CAMERAS[:1], []):
        found = texture_offsets(world, cameras, blank, SEED).summary(len(cameras))
        assert math.isnan(found.pixels)
        assert found.sentences(["a"] * len(cameras)) == []


def test_copies_of_photographs_do_not_make_the_others_agree(world):
    twice = [camera for camera in CAMERAS for _ in range(2)]
    shown = photographed(world, CAMERAS)
    copies = Photos(shown.pixels.repeat_interleave(2, 0))
    given = [turned(camera, 0.8, index // 2) for index, camera in enumerate(twice)]
    assert texture_offsets(world, given, copies, SEED).summary(len(twice)).pixels > 0.5
