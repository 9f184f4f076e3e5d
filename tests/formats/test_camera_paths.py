"""Paths of cameras: where they are and what they look at."""

from itertools import pairwise

import numpy as np
import pytest

from neurad.core.errors import InputError
from neurad.core.records import Camera
from neurad.formats.edits.camera_paths import path_of

UP = np.array([0.0, 1.0, 0.0])


def camera(x=0.0, y=1.0, z=3.0, fov=0.8):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return Camera(pose, fov, 16, 12)


def test_a_turntable_keeps_its_distance_and_looks_at_the_middle():
    middle = np.array([0.5, 0.0, 0.0])
    made = path_of("turntable", [camera()], 8, UP, middle)
    eyes = np.array([c.to_world[:3, 3] for c in made])
    np.testing.assert_allclose(np.linalg.norm(eyes - middle, axis=1), np.linalg.norm([-0.5, 1.0, 3.0]))
    np.testing.assert_allclose(eyes[:, 1], 1.0)
    for c, eye in zip(made, eyes, strict=True):
        ahead = -c.to_world[:3, 2]
        np.testing.assert_allclose(ahead, (middle - eye) / np.linalg.norm(middle - eye), atol=1e-12)
        np.testing.assert_allclose(c.to_world[:3, :3].T @ c.to_world[:3, :3], np.eye(3), atol=1e-12)
        assert c.to_world[1, 0] == pytest.approx(0.0, abs=1e-12)  # upright
    np.testing.assert_allclose(eyes[0], [0.0, 1.0, 3.0])
    np.testing.assert_allclose(eyes[0] + eyes[4], 2 * middle + [0, 2, 0], atol=1e-12)
    with pytest.raises(InputError, match="right above or below"):
        path_of("turntable", [camera(0.5, 2.0, 0.0)], 8, UP, middle)


def test_a_pan_stays_where_it_is():
    made = path_of("pan", [camera()], 4, UP, [9, 9, 9])
    np.testing.assert_allclose([c.to_world[:3, 3] for c in made], [[0, 1, 3]] * 4, atol=1e-12)
    np.testing.assert_allclose(-made[1].to_world[:3, 2], [-1, 0, 0], atol=1e-12)  # counterclockwise from above


def test_a_flight_passes_all_cameras_at_an_even_pace():
    turned = camera(3.0, 1.0, 0.0, 1.0)
    turned.to_world[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    cameras = [camera(), camera(1.0, 1.5, 2.0), turned]
    made = path_of("fly", cameras, 101, UP, np.zeros(3))
    eyes = np.array([c.to_world[:3, 3] for c in made])
    np.testing.assert_allclose(made[0].to_world, cameras[0].to_world, atol=1e-6)
    np.testing.assert_allclose(made[-1].to_world, turned.to_world, atol=1e-6)
    assert np.linalg.norm(eyes - [1.0, 1.5, 2.0], axis=1).min() < 0.05
    assert made[-1].fov_x == pytest.approx(1.0)
    for c in made:
        np.testing.assert_allclose(c.to_world[:3, :3].T @ c.to_world[:3, :3], np.eye(3), atol=1e-6)
    turns = np.array([np.linalg.norm(a.to_world[:3] - b.to_world[:3]) for a, b in pairwise(made)])
    assert turns.max() < 3 * turns.min()
    with pytest.raises(InputError, match="two cameras or more"):
        path_of("fly", [camera()], 5, UP, np.zeros(3))
