"""How far photographs lie beside each other is measured to a tenth of a pixel, whatever else they differ in."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import Photographs, lamp_room
from helpers.shared_rooms import ROOMS
from scipy.spatial.transform import Rotation

from datamodules.scene_data import SceneData
from datamodules.settings import DataSettings
from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays, project, to_camera
from neurad.evidence.texture_offsets import PRECISE, SIDE, offsets, texture_offsets
from neurad.formats.load import load_scene
from neurad.scene.builtin.shapes import look_at

SIZE, SEED = 96, 5
CAMERAS = [
    look_at((0.8 * x, 0.2 + 0.1 * i, 0.8 * z), (-0.5 * x, -0.3, -0.2 * z), 80.0, SIZE)
    for i, (x, z) in enumerate(((1, 1), (1, 0.4), (1, -0.4), (1, -1), (-1, 1), (-1, 0.4), (-1, -0.4), (-1, -1)))
]


class Photos(Photographs):
    def ignored(self):
        return None


def pattern(p, seed=0, wavelengths=(0.2, 0.5)):
    """A smooth texture of places [..., d]: the exponential of waves."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(16, p.shape[-1]))
    way *= 2 * math.pi / (rng.uniform(*wavelengths, (16, 1)) * np.linalg.norm(way, axis=-1, keepdims=True))
    return torch.exp(
        0.25 * torch.sin(p.double() @ torch.from_numpy(way).T + torch.from_numpy(rng.uniform(0, 7, 16))).sum(-1)
    )


@pytest.fixture(scope="module")
def world():
    return build_world(lamp_room())


def photographed(world, cameras, texture=pattern, noise=0.02):
    """What cameras see of walls with a texture, each with a gain of its own."""
    y, x = torch.meshgrid(*[torch.arange(SIZE) + 0.5] * 2, indexing="ij")
    rng = np.random.default_rng(1)
    pictures = []
    for index, camera in enumerate(cameras):
        shown = texture(world.intersect(camera_rays(camera, torch.stack((x, y), -1).view(-1, 2))).p)
        shown = shown * torch.from_numpy(1 + noise * rng.normal(size=len(shown))) * (1 + 0.1 * index)
        pictures.append(shown.float()[:, None].expand(-1, 3))
    return Photos(torch.stack(pictures))


def turned(camera, degrees, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    pose = np.asarray(camera.to_world, np.float64).copy()
    pose[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
    return replace(camera, to_world=pose)


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["living-room-2", "kitchen", "staircase", "veach-ajar", "dining-room"])
def test_exact_rooms_raise_no_alarm(name):
    if not (ROOMS / name).is_dir():
        pytest.skip("the shared rooms are not here")
    scene = load_scene(str(ROOMS / name), None)
    data = SceneData(DataSettings(root=str(ROOMS / name)))
    found = texture_offsets(build_world(scene), [view.camera for view in scene.train], data, SEED).summary(
        len(scene.train)
    )
    assert found.pixels < 0.15
    assert found.sentences([view.name for view in scene.train]) == []
