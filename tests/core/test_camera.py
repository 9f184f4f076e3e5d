"""Projection: film positions and rays are inverse to each other."""

from __future__ import annotations

import math

import pytest
import torch

from neurad.core.camera import Cameras, camera_rays, fov_of, in_view, pixel_side, project, to_camera
from neurad.core.records import Camera
from neurad.core.rng import Stream
from neurad.scene.builtin.shapes import look_at


def wide() -> Camera:
    """A camera whose film is not square."""
    pose = look_at((1.0, 2.0, 3.0), (0.0, 0.5, -1.0), 40.0, 8).to_world
    return Camera(pose, math.radians(50.0), 48, 32)


def test_a_point_on_a_ray_is_projected_to_where_the_ray_came_from() -> None:
    camera, stream = wide(), Stream(3)
    xy = stream.uniform(500, 2).double() * torch.tensor([48.0, 32.0])
    rays = camera_rays(camera, xy)
    t = 0.1 + 5.0 * stream.uniform(500, 1).double()
    p = rays.o + t * rays.d
    torch.testing.assert_close(project(camera, to_camera(camera, p)), xy)
    assert bool(in_view(camera, p).all())
    assert not bool(in_view(camera, rays.o - t * rays.d).any())  # behind it


@pytest.mark.parametrize(("x", "y"), [(-0.5, 16.0), (48.5, 16.0), (24.0, -0.5), (24.0, 32.5)])
def test_what_lies_beside_the_film_is_not_in_view(x: float, y: float) -> None:
    rays = camera_rays(wide(), torch.tensor([[x, y]], dtype=torch.float64))
    assert not bool(in_view(wide(), rays.o + rays.d).any())


def test_rays_of_several_cameras_are_those_of_each() -> None:
    cameras, xy = [wide(), Camera(wide().to_world, 0.7, 48, 32)], Stream(4).uniform(40, 2) * 32
    view = torch.arange(40) % 2
    rays = Cameras.of(cameras, "cpu").rays(view, xy)
    for index, camera in enumerate(cameras):
        torch.testing.assert_close(rays.d[index::2], camera_rays(camera, xy[index::2]).d)


def test_focal_length_and_field_of_view_are_inverse() -> None:
    camera = wide()
    assert fov_of(camera.fl_x, camera.width) == pytest.approx(camera.fov_x)
    assert camera.fl_x * pixel_side(camera) == pytest.approx(1.0)
