"""Poses are refined where photographs tell them, and kept where they do not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.lamp_room import lamp_room
from helpers.textured_room import CAMERAS, SIZE, Photos, pattern, photographed, turned

from benchmarks.stress.fit import small_settings
from neurad.assembly.build import build_world
from neurad.assembly.settings import Lighting
from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.errors import InputError
from neurad.core.lens import Lens
from neurad.emitters.lights import NullEmitter
from neurad.evidence import pose_fit
from neurad.evidence.camera_motion import OWN, apart, derivatives, moved
from neurad.evidence.offset_table import OffsetTable
from neurad.evidence.pose_fit import fit_poses
from neurad.evidence.smaller_photographs import SmallerPhotographs, smaller
from neurad.evidence.texture_offsets import PRECISE, REACH, SIDE, offsets, texture_offsets
from neurad.lamps.find import Found
from neurad.scene.builtin.plain import diffuse
from neurad.scene.builtin.shapes import look_at, quad
from neurad.scene.description import Scene
from neurad.scene.shining import Shining
from neurad.training import prepared_scene
from neurad.training.prepared_scene import poses_of, prepare_scene, with_poses

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
        motion = 1e-3 * rng.normal(size=8)
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
        derivatives(camera, points)[0, :, :OWN], rows @ np.hstack((turn, -np.eye(3))), rtol=1e-6, atol=1e-6
    )
    ray = np.array([x, -y]) / -z
    expected = f * np.stack((ray, (ray @ ray) * ray), -1)  # by the logarithm of the focal length, and by k1
    np.testing.assert_allclose(derivatives(camera, points)[0, :, OWN:], expected, rtol=1e-6, atol=1e-6)


def test_wrong_poses_are_found_back(world, shown):
    given = [
        moved(turned(camera, 0.6, index), np.array([0, 0, 0, 0.008, -0.006, 0.004, 0, 0]))
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


def test_focal_length_and_k1_of_the_photographs_of_one_size_are_found_back(world):
    """Every other photograph is larger, and of another lens than is said; that of the rest is right."""
    sides = [SIZE + 2 * (index % 2) for index in range(len(CAMERAS))]
    right = [replace(camera, width=side, height=side) for camera, side in zip(CAMERAS, sides, strict=True)]
    lens = np.array([*np.zeros(OWN), 0.01, 0.02])
    given = [turned(moved(camera, (index % 2) * lens), 0.6, index) for index, camera in enumerate(right)]
    found = fit_poses(world, given, photographed(world, right), 1)
    for (photographs, longer, bent), factor in zip(found.lenses, (0.0, -1.0), strict=True):
        assert photographs == 4
        assert math.isclose(longer, math.exp(0.01 * factor), abs_tol=0.002)
        assert math.isclose(bent, 0.02 * factor, abs_tol=0.004)
        said = f"lens of 4 photographs: focal length x {longer:.4f}, k1 {bent:+.4f}"
        assert (said in found.sentences(NAMES)) == ((longer, bent) != (1.0, 0.0))
    assert found.lenses[1][1:] != (1.0, 0.0)
    before, after = ([apart(a, b, world) for a, b in zip(c, right, strict=True)] for c in (given, found.cameras))
    assert np.median(after) < 0.3 * np.median(before)


def test_a_lens_that_would_fold_over_stays_as_it_is(world, shown, monkeypatch):
    monkeypatch.setattr(pose_fit, "ROUNDS", 1)
    monkeypatch.setattr(pose_fit, "fold", lambda lens, *_: (0.0, 0.0) if lens.bends else None)
    found = fit_poses(world, [turned(camera, 0.6, index) for index, camera in enumerate(CAMERAS)], shown, 1)
    assert found.moved.any()
    assert all(camera.lens == Lens() for camera in found.cameras)


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


PANELS = [(x, y) for x in (-0.75, -0.25, 0.25) for y in (-0.75, -0.25, 0.25)]
WIDE, FRAME = 0.3, 0.045
"""Sides of dark panels on a wall, and of frames to their right and above, which look as the wall does, in 2 pixels."""


def panels():
    """A wall, its panels and their frames; a frame has the wall's colour, in a material of its own."""
    wall = quad((-1.0, -1.0, 0.0), (2.0, 0.0, 0.0), (0.0, 2.0, 0.0)).mesh("wall", 0, smooth_shading=False)
    meshes = [wall]
    for number, (x, y) in enumerate(PANELS):
        for name, material, side, lift in (("frame", 1, WIDE + FRAME, 1e-4), ("panel", 2, WIDE, 2e-4)):
            solid = quad((x, y, lift), (side, 0.0, 0.0), (0.0, side, 0.0))
            meshes.append(solid.mesh(f"{name}_{number}", material, smooth_shading=False))
    return Scene("panels", meshes, [diffuse("wall", 0.5), diffuse("frame", 0.5), diffuse("panel", 0.1)])


def dark_panels(p):
    """Their brightness at places [n, 3]."""
    inside = torch.zeros(len(p), dtype=torch.bool)
    for x, y in PANELS:
        inside |= ((p[:, :2] > torch.tensor([x, y])) & (p[:, :2] < torch.tensor([x, y]) + WIDE)).all(-1)
    return torch.where(inside, 0.1, 0.5).double()


def test_an_edge_that_photographs_do_not_show_is_not_taken_for_the_one_beside_it():
    """All frames are on the same sides: who takes the panel's edges for those of frames shifts all cameras."""
    world = build_world(panels(), lights=NullEmitter())
    right = [look_at((0.3 * x, 0.3 * y, 2.0), (0.05 * x, 0.0, 0.0), 50.0, SIZE) for x in (-1, 0, 1) for y in (-1, 1)]
    photographs = photographed(world, right, dark_panels)
    given = [turned(camera, 0.3, index) for index, camera in enumerate(right)]
    found = fit_poses(world, given, photographs, 1)
    before, after = ([apart(a, b, world) for a, b in zip(c, right, strict=True)] for c in (given, found.cameras))
    assert np.median(before) > 0.2
    assert np.median(after) < 0.5 * np.median(before)


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
    change = np.array([*np.zeros(OWN), 0.01, 0.02])
    cameras = [turned(moved(view.camera, change), 1.0, index) for index, view in enumerate(scene.train)]
    again = with_poses(scene, poses_of(cameras), "--ckpt_path")
    for view, camera in zip(again.train, cameras, strict=True):
        np.testing.assert_array_equal(view.camera.to_world, camera.to_world)
        assert (view.camera.fov_x, view.camera.lens) == (camera.fov_x, camera.lens)
    for bad in (None, [[1.0] * 17], [[1.0] * 16] * 5, "poses"):
        with pytest.raises(InputError, match="--ckpt_path: it has no refined poses of 5 views"):
            with_poses(scene, bad, "--ckpt_path")


def test_lamps_are_searched_for_with_refined_poses(shown, monkeypatch):
    """A camera that is a pixel off shows the borders of a lamp dark."""
    lamps, searched = [Shining(mesh=0)], []

    def find(scene, *_):
        searched.append(scene)
        return Found(lamps, ["said"])

    monkeypatch.setattr(prepared_scene, "find_lamps", find)
    scene = lamp_room()
    views = [replace(scene.train[0], camera=turned(camera, 0.6, index)) for index, camera in enumerate(CAMERAS)]
    given = replace(scene, train=views, photography=replace(scene.photography, poses="refine"))
    prepared = prepare_scene(given, shown, replace(small_settings(), lighting=Lighting(emitters="find")))
    assert (prepared.shining, prepared.said_of_lamps) == (lamps, ["said"])
    assert prepared.said_of_poses[0].startswith("poses refined")
    assert prepared.poses != poses_of([view.camera for view in views])
    for with_them in (searched[0], prepared.scene):
        assert poses_of([view.camera for view in with_them.train]) == prepared.poses


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
