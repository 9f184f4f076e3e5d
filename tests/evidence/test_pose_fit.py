"""Poses are refined where photographs tell them, and kept where they do not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import Photographs, lamp_room
from scipy.spatial.transform import Rotation

from neurad.assembly.build import build_world
from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.errors import InputError
from neurad.core.lens import Lens
from neurad.evidence.offset_table import OffsetTable
from neurad.evidence.pose_fit import apart, derivatives, fit_poses, moved
from neurad.evidence.smaller_photographs import SmallerPhotographs, smaller
from neurad.evidence.texture_offsets import PRECISE, REACH, SIDE, offsets, texture_offsets
from neurad.scene.builtin.shapes import look_at
from neurad.training.posed_scene import poses_of, with_poses

SIZE = 96
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


def photographed(world, cameras, texture=pattern, noise=0.02):
    """What cameras see of walls with a texture, each with a gain of its own."""
    rng = np.random.default_rng(1)
    pictures = []
    for index, camera in enumerate(cameras):
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        shown = texture(world.intersect(camera_rays(camera, torch.stack((x, y), -1).view(-1, 2))).p)
        shown = shown * torch.from_numpy(1 + noise * rng.normal(size=len(shown))) * (1 + 0.1 * index)
        pictures.append(shown.float()[:, None].expand(-1, 3))
    return Photos(torch.stack(pictures))


def turned(camera, degrees, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    pose = np.asarray(camera.to_world, np.float64).copy()
    pose[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
    return replace(camera, to_world=pose)


NAMES = [f"view_{i}" for i in range(len(CAMERAS))]


@pytest.fixture(scope="module")
def world():
    return build_world(lamp_room())


@pytest.fixture(scope="module")
def shown(world):
    return photographed(world, CAMERAS)


def off(world, cameras):
    """Median pixels by which cameras see surface points beside where the right ones see them [views]."""
    xy = torch.cartesian_prod(*[torch.linspace(4.0, SIZE - 4.0, 12)] * 2)
    found = []
    for camera, right in zip(cameras, CAMERAS, strict=True):
        p = world.intersect(camera_rays(right, xy)).p.double()
        found.append(float((project(camera, to_camera(camera, p)) - xy).norm(dim=-1).median()))
    return np.array(found)


@pytest.mark.parametrize(
    "lens", [Lens(), Lens(1.1, (0.45, 0.55), (0.1, -0.02), (), (0.01, -0.01)), Lens(numerator=(0.05,), fisheye=True)]
)
def test_derivatives_are_those_of_the_film_position(lens):
    camera = replace(turned(CAMERAS[0], 20.0, 3), lens=lens)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(0)).double() * 0.3
    points += torch.from_numpy(camera.to_world[:3, 3] - 1.5 * camera.to_world[:3, 2])
    found = derivatives(camera, points)
    rng = np.random.default_rng(0)
    for _ in range(3):
        motion = 1e-3 * rng.normal(size=6)
        after = moved(camera, motion)
        change = project(after, to_camera(after, points)) - project(camera, to_camera(camera, points))
        np.testing.assert_allclose(change.numpy(), found @ motion, atol=2e-3)


def test_derivatives_of_a_pinhole_in_closed_form():
    camera = CAMERAS[1]
    points = torch.from_numpy(camera.to_world[:3, 3] + camera.to_world[:3, :3] @ np.array([0.3, -0.2, -1.6]))[None]
    x, y, z, f = 0.3, -0.2, -1.6, camera.fl_x
    rows = np.array([[f / -z, 0.0, f * x / z**2], [0.0, -f / -z, -f * y / z**2]])  # by the point in the camera's space
    turn = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # q x w
    np.testing.assert_allclose(
        derivatives(camera, points)[0], rows @ np.hstack((turn, -np.eye(3))), rtol=1e-6, atol=1e-6
    )


def test_wrong_poses_are_found_back(world, shown):
    given = [
        moved(turned(camera, 0.6, index), np.array([0, 0, 0, 0.008, -0.006, 0.004]))
        for index, camera in enumerate(CAMERAS)
    ]
    found = fit_poses(world, given, shown, 1)
    before, after = off(world, given), off(world, found.cameras)
    assert np.median(before) > 0.4
    assert np.median(after) < 0.4 * np.median(before)
    assert found.after.pixels < 0.25 * found.before.pixels
    said = found.sentences(NAMES)
    assert said[0].startswith("poses refined")
    assert math.isclose(float(np.median(found.moved)), float(np.median(before)), rel_tol=0.5)


def test_poses_farther_off_than_patches_reach_are_found_by_smaller_pictures(world):
    large = [replace(camera, width=3 * SIZE, height=3 * SIZE) for camera in CAMERAS]
    given = [turned(camera, 2.0, index) for index, camera in enumerate(large)]
    found = fit_poses(world, given, photographed(world, large), 1)
    assert found.bound == 4 * REACH
    assert np.median([apart(a, b, world) for a, b in zip(given, large, strict=True)]) > REACH
    assert np.median([apart(a, b, world) for a, b in zip(found.cameras, large, strict=True)]) < 0.5


def test_smaller_photographs_show_means_and_pass_on_what_does_not_count(shown, monkeypatch):
    camera = replace(CAMERAS[0], width=7, height=5)
    values = torch.arange(35.0)[None, :, None].expand(1, -1, 3).contiguous()
    clipped, ignored = values > 33, torch.zeros(1, 35, dtype=torch.bool)
    ignored[0, 0] = True
    monkeypatch.setattr(Photos, "ignored", lambda _: ignored)
    monkeypatch.setattr(Photos, "clipped", lambda _, view, pixel: clipped[view, pixel])
    reduced = SmallerPhotographs(Photos(values), [camera], 2)
    assert (smaller(camera, 2).width, smaller(camera, 2).height) == (3, 2)
    view, pixel = torch.zeros(6, dtype=torch.int64), torch.arange(6)
    rows, columns = [[0, 1], [3, 4]], [[0, 1], [2, 4], [5, 6]]  # of five and of seven, spread evenly
    expected = [np.mean([7.0 * r + c for r in rr for c in cc]) for rr in rows for cc in columns]
    np.testing.assert_allclose(reduced.colors(view, pixel)[:, 0].numpy(), expected)
    assert reduced.clipped(view, pixel)[:, 0].tolist() == [False] * 5 + [True]
    assert reduced.ignored()[0].tolist() == [True] + [False] * 5


def test_right_poses_are_kept(world, shown):
    found = fit_poses(world, CAMERAS, shown, 1)
    assert found.cameras == CAMERAS
    assert found.sentences(NAMES)[0].startswith("poses are kept: photographs disagree by 0.0")


def test_blank_walls_keep_poses_and_it_is_said(world):
    blank = photographed(world, CAMERAS, lambda p: torch.ones(len(p)).double())
    found = fit_poses(world, [turned(camera, 0.6, 1) for camera in CAMERAS], blank, 1)
    assert not found.moved.any()
    assert found.sentences(NAMES) == [
        "poses are kept: too few textures are shown by several photographs to refine them"
    ]


def test_a_photograph_of_something_else_is_not_moved_far(world, shown):
    other = shown.pixels.clone()
    other[3] = other[3].view(SIZE, SIZE, 3).flip(0, 1).roll((17, 29), (0, 1)).reshape(-1, 3)
    given = [turned(camera, 0.6, index) for index, camera in enumerate(CAMERAS)]
    found = fit_poses(world, given, Photos(other), 1)
    assert found.moved.max() <= found.bound
    rest = [index for index in range(len(CAMERAS)) if index != 3]
    assert np.median(off(world, found.cameras)[rest]) < 0.6 * np.median(off(world, given)[rest])


def test_a_photograph_without_any_whole_patch_is_compared_with_none(world, shown, monkeypatch):
    """As one that is clipped everywhere, or has fireflies in every patch."""
    ignored = torch.zeros(shown.pixels.shape[:2], dtype=torch.bool)
    ignored[3, ::5] = True
    monkeypatch.setattr(Photos, "ignored", lambda _: ignored)
    table = texture_offsets(world, CAMERAS, shown, SEED)
    assert len(table.offset) > 0
    assert not bool(table.of(3).any())


def test_poses_of_a_checkpoint_are_those_that_were_found():
    scene = lamp_room()
    cameras = [turned(view.camera, 1.0, index) for index, view in enumerate(scene.train)]
    again = with_poses(scene, poses_of(cameras), "--ckpt_path")
    for view, camera in zip(again.train, cameras, strict=True):
        np.testing.assert_array_equal(view.camera.to_world, camera.to_world)
    for bad in (None, [[1.0] * 16], "poses"):
        with pytest.raises(InputError, match="--ckpt_path: it has no refined poses of 5 views"):
            with_poses(scene, bad, "--ckpt_path")


# ---- how far photographs lie beside each other is measured to a tenth of a pixel, whatever else they differ in


SEED = 5


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


def test_photographs_of_right_poses_agree_and_those_of_wrong_ones_do_not(world, shown):
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


def test_one_photograph_that_lies_beside_the_others_is_named_alone(world, shown):
    given = [turned(camera, 2.0 * (index == 5), 4) for index, camera in enumerate(CAMERAS)]
    found = texture_offsets(world, given, shown, SEED).summary(len(CAMERAS))
    assert found.beside == (5,)
    assert found.pixels < 0.2
    (said,) = found.sentences([f"view_{i}" for i in range(8)])
    assert "view_5 (" in said
    assert "check the pose" in said


def test_a_shadow_that_two_photographs_share_puts_neither_beside_all_others():
    """Many patches of one pair lie apart, those that both share with other photographs do not."""
    pairs = [(0, 1)] * 8 + [(0, 2)] * 8 + [(1, 2)] * 8 + [(2, 3)] * 10 + [(0, 3)] * 2 + [(1, 3)] * 2
    first, second = (torch.tensor(side) for side in zip(*pairs, strict=True))
    offset = torch.where((first == 2) & (second == 3), 3.0, 0.1).double()
    one = torch.ones(len(first), dtype=torch.float64)
    rest = one[:, None].expand(-1, 3), one[:, None].expand(-1, 2), torch.eye(2).double().expand(len(first), 2, 2)
    table = OffsetTable(first, second, *rest, offset, 0.1 * one, one)
    assert table.summary(4).beside == ()
    everywhere = replace(table, offset=torch.where(second == 3, 3.0, 0.1).double())
    assert everywhere.summary(4).beside == (3,)


def test_blank_walls_and_single_photographs_are_not_judged(world):
    blank = photographed(world, CAMERAS, lambda p: torch.ones(len(p)).double())
    for cameras in (CAMERAS, CAMERAS[:1], []):
        found = texture_offsets(world, cameras, blank, SEED).summary(len(cameras))
        assert math.isnan(found.pixels)
        assert found.sentences(["a"] * len(cameras)) == []


def test_copies_of_photographs_do_not_make_the_others_agree(world, shown):
    twice = [camera for camera in CAMERAS for _ in range(2)]
    copies = Photos(shown.pixels.repeat_interleave(2, 0))
    given = [turned(camera, 0.8, index // 2) for index, camera in enumerate(twice)]
    assert texture_offsets(world, given, copies, SEED).summary(len(twice)).pixels > 0.5
