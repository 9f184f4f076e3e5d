"""Cameras of the browser: OpenCV's axes and a vertical field of view, and ours."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from neurad.core.camera import camera_rays
from neurad.core.records import Float64Array
from neurad.core.scene_records import Camera
from neurad.inspect.check.surroundings import surroundings
from neurad.integrators.world import World

Vector = Float64Array
"""[3]."""
ACROSS = 10.0
"""Lengths of the page across the room: viser walks two of them a second, and draws what is near a hundredth of one."""
SPOT = 0.01
"""Lengths of the page to what a camera turns around that turns on the spot: the least that viser can do."""
ENCLOSED = 2.0 / 3.0
"""Part of all directions in which a camera has to meet something to be indoors."""
_CAMERAS = 16  # that say what is around
_FLIP = np.diag([1.0, -1.0, -1.0])
"""Between axes with +Y up, looking along -Z, and axes with +Y down, looking along +Z."""


@dataclass(frozen=True)
class Pose:
    """Where a browser looks from."""

    rotation: tuple[float, ...]
    """Camera to world, row by row, OpenCV's axes: 9 numbers."""
    position: tuple[float, float, float]
    fov_y: float
    """Vertical field of view in radians."""
    aspect: float
    """Width over height."""

    def camera(self, pixels: int) -> Camera:
        """The camera, with about as many square pixels."""
        width = max(1, round(math.sqrt(pixels * self.aspect)))
        height = max(1, round(width / self.aspect))
        to_world = np.eye(4, dtype=np.float32)
        to_world[:3, :3] = np.reshape(self.rotation, (3, 3)) @ _FLIP
        to_world[:3, 3] = self.position
        fov_x = 2.0 * math.atan(math.tan(0.5 * self.fov_y) * width / height)
        return Camera(to_world, fov_x, width, height)


def pose_of(camera: Camera) -> Pose:
    """The place of one of our cameras; its lens becomes a pinhole over the middle of the picture."""
    to_world = np.asarray(camera.to_world, np.float64)
    x, y, z = (float(v) for v in to_world[:3, 3])
    rotation = tuple(float(v) for v in (to_world[:3, :3] @ _FLIP).ravel())
    return Pose(rotation, (x, y, z), _fov_y(camera), camera.width / camera.height)


def _fov_y(camera: Camera) -> float:
    """Vertical field of view in radians, of a wide fisheye no more than a pinhole can have."""
    return min(2.0 * math.atan(0.5 * camera.height / camera.fl_y), math.radians(150.0))


@dataclass(frozen=True)
class Stand:
    """Where a browser's camera is put to see what a view shows, in lengths of the page."""

    position: Vector
    look_at: Vector
    """The surface in the middle of the picture, which it may turn around."""
    up: Vector
    fov_y: float

    def pivot(self, on_the_spot: bool) -> Vector:
        """What it turns around."""
        way = self.look_at - self.position
        return self.position + way * (SPOT / float(np.linalg.norm(way))) if on_the_spot else self.look_at


def stand_of(camera: Camera, world: World, length: float) -> Stand:
    """A place in the browser, with lengths of ``length`` scene units, for one of our cameras.

    Its lens is a pinhole there, with the vertical field of view of the camera's.
    """
    middle = torch.tensor([[camera.width / 2, camera.height / 2]], device=world.two_sided.device)
    si = world.intersect(camera_rays(camera, middle))
    pose = np.asarray(camera.to_world, np.float64)
    position, ahead = pose[:3, 3], -pose[:3, 2]
    away = world.geometry.scale
    if bool(si.valid):
        away = float(np.linalg.norm(si.p[0].cpu().numpy() - position))
    look_at = position + max(away, 1e-3 * world.geometry.scale) * ahead
    return Stand(position / length, look_at / length, pose[:3, 1], _fov_y(camera))


@dataclass(frozen=True)
class Surrounded:
    """What is around the cameras of a room."""

    length: float
    """Scene units in a length of the page, :data:`ACROSS` of which cross the room."""
    indoors: bool
    """Whether cameras are within what they see, and do not look at it from outside."""


def surrounded(world: World, cameras: Sequence[Camera]) -> Surrounded:
    """What is around some cameras of a room."""
    found = surroundings(world, cameras[:: -(-len(cameras) // _CAMERAS)])
    width = float(np.median([one.width for one in found]))
    across = width if math.isfinite(width) else 2.0 * world.geometry.scale
    return Surrounded(across / ACROSS, float(np.median([one.free for one in found])) < 1.0 - ENCLOSED)
