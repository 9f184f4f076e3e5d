"""Edges of geometry and photographs: places by projection, exposure that plays no part, and turns that are found."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.textured_room import Photos
from helpers.textured_room import turned as away
from trimesh.transformations import rotation_matrix

from neurad.assembly.build import build_world
from neurad.core.camera import project, to_camera
from neurad.core.scene_records import Camera
from neurad.evidence.camera_motion import apart, moved
from neurad.evidence.edge_fit import EdgeFit, compared, directions, edge_fit, gradient_ranks, mean_rank, misfits
from neurad.evidence.mesh_edges import mesh_edges, primary_grid
from neurad.evidence.pose_fit import fit_poses
from neurad.images.photographs import read_view
from neurad.scene.builtin import build


@pytest.fixture(scope="module")
def box():
    scene = build("cornell")
    return scene, build_world(scene)


def sizes(camera, width):
    return replace(camera, width=width, height=width)


def painted(world, camera, seed):
    """A noisy photograph whose every material has one colour."""
    rng = np.random.default_rng(seed)
    grid = primary_grid(world, camera, camera.width)
    label = world.geometry.material[grid.si.prim].view(camera.height, camera.width).numpy()
    colours = rng.uniform(0.1, 1.0, (int(label.max()) + 1, 3))
    return (colours[label] * rng.gamma(100.0, 0.01, (*label.shape, 1))).astype(np.float32)


def turned(camera, axis, degrees):
    """The camera turned about its own x or y axis."""
    turn = rotation_matrix(math.radians(degrees), np.eye(3)["xyz".index(axis)])
    return replace(camera, to_world=(camera.to_world @ turn).astype(np.float32))


def test_edges_lie_where_the_blocks_project(box):
    """The two upper edges of the tall block that face a camera below them are found to half a pixel."""
    scene, world = box
    camera = sizes(scene.train[4].camera, 128)
    edges = mesh_edges(world, primary_grid(world, camera, 128))
    block = next(mesh for mesh in scene.meshes if mesh.name == "tall block")
    top = block.vertices[block.vertices[:, 1] > 0.19]
    corners = np.unique(top.round(4), axis=0)
    pairs = [(a, b) for i, a in enumerate(corners) for b in corners[i + 1 :] if 0.5 < np.linalg.norm(a - b) < 0.7]
    assert len(pairs) == 4
    seen = 0
    for a, b in pairs:
        points = torch.from_numpy(a + np.linspace(0.05, 0.95, 40)[:, None] * (b - a)).float()
        away = torch.cdist(project(camera, to_camera(camera, points)), edges.place)
        seen += bool((away.amin(1) < 0.75).all())
    assert seen == 2


def test_a_plane_has_no_edges(box):
    _, world = box
    wall = Camera(np.eye(4, dtype=np.float32), 0.3, 64, 64)
    wall.to_world[:3, 3] = (0.0, 0.8, -0.7)  # looks at the back wall alone
    assert not mesh_edges(world, primary_grid(world, wall, 64)).mask.any()


def test_exposure_plays_no_part():
    photograph = np.random.default_rng(1).random((24, 32, 3), np.float32)
    ranks = gradient_ranks(photograph)
    assert ranks.min() == 0.0
    assert ranks.max() == 1.0
    torch.testing.assert_close(gradient_ranks(8.0 * photograph), ranks)


@pytest.mark.parametrize(("axis", "degrees"), [("y", 3.0), ("y", -3.0), ("x", 3.0), ("x", -3.0)])
def test_a_turn_is_found_with_its_size_and_side(box, axis, degrees):
    """Against photographs painted by materials: the pose fits, and a turned one is off by the turn that was made."""
    scene, world = box
    camera = sizes(scene.train[1].camera, 128)
    ranks, small = compared(painted(world, camera, 3), camera)
    right = edge_fit(ranks, small, directions(mesh_edges(world, primary_grid(world, camera, 128)), 0))
    assert right.excess < -1.0
    assert right.peak > 3.0
    wrong = turned(camera, axis, degrees)
    fit = edge_fit(ranks, small, directions(mesh_edges(world, primary_grid(world, wrong, 128)), 0))
    assert not fit.fits
    left, up, roll = fit.turn
    # A camera turned to the left by too much has to be turned to the right.
    expected = (-degrees, 0.0) if axis == "y" else (0.0, -degrees)
    pixel = math.degrees(camera.fov_x) / camera.width
    np.testing.assert_allclose((left, up), expected, atol=2.5 * pixel)
    assert roll == 0.0
    back = moved(wrong, np.array([*fit.angles, *np.zeros(5)]))
    cosine = (np.trace(back.to_world[:3, :3].T @ camera.to_world[:3, :3]) - 1.0) / 2.0
    assert math.degrees(math.acos(min(cosine, 1.0))) < 2.5 * pixel
    assert misfits([right, fit, None]) == [1]


def test_a_camera_that_other_edges_have_caught_is_turned_back(box):
    """One of eight is off by 6 pixels; of what photographs show beside edges of the mesh 2 pixels are believed."""
    scene, world = box
    right = [sizes(view.camera, 128) for view in scene.train]
    photographs = Photos(torch.stack([torch.from_numpy(painted(world, camera, 3)).view(-1, 3) for camera in right]))
    given = [away(camera, 3.5 if index == 4 else 0.2, index) for index, camera in enumerate(right)]
    assert apart(given[4], right[4], world) > 5.0
    found = fit_poses(world, given, photographs, 1)
    assert max(apart(a, b, world) for a, b in zip(found.cameras, right, strict=True)) < 0.5


def test_textures_of_small_photographs_are_not_taken_for_edges():
    """Turned by some pixels, a picture of 64 keeps a few edges alone, which fall on checks."""
    scene = build("patterns")
    world, views = build_world(scene), [scene.train[8], scene.train[14], scene.train[17], scene.test[3]]
    for view in views:
        photograph = read_view(view).reshape(64, 2, 64, 2, 3).mean((1, 3))
        ranks, camera = compared(photograph, sizes(view.camera, 64))
        fit = edge_fit(ranks, camera, directions(mesh_edges(world, primary_grid(world, camera, 512)), 0))
        assert fit is not None
        assert fit.fits, view.name


def test_edges_out_of_sight_say_nothing(box):
    scene, world = box
    camera = sizes(scene.train[0].camera, 64)
    ranks, small = compared(painted(world, camera, 3), camera)
    behind = torch.tensor([[0.0, 0.0, 1.0]]).repeat(50, 1)
    assert edge_fit(ranks, small, behind) is None
    assert edge_fit(ranks, small, behind[:0]) is None
    assert mean_rank(ranks, small, behind) == -1.0


def test_a_rank_far_below_all_others_is_a_misfit():
    good = EdgeFit(100, 0.9, 0.6, 0.05, 0.8, (0.0, 0.0, 0.0), -0.01, (0.0, 0.0), (0.0, 0.0, 0.0))
    fits = [replace(good, here=0.9 + 0.005 * (i % 3)) for i in range(8)]
    assert misfits(fits) == []
    assert misfits([*fits, replace(good, here=0.78, best=0.7, gain=-0.05)]) == [8]
