"""Small changes of cameras: their poses, and what their lenses do; and how their pictures move by them."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neurad.core.camera import camera_rays, fov_of, project, to_camera
from neurad.core.records import Float64Array
from neurad.core.scene_records import Camera
from neurad.integrators.world import World

OWN, SHARED = 6, 2
"""Numbers of a change that are of one camera, its pose, and those that all photographs of a lens have in common."""
_SMALL = 1e-4  # of a radian, of the distances in the room, of the focal length, and of k1: steps of the derivatives


def moved(camera: Camera, change: Float64Array) -> Camera:
    """A camera after a change [8]: turned by a vector of angles and moved by a vector, both in its own axes, its focal
    length longer by a factor, of which this is the logarithm, and k1 larger by a number.
    """
    pose: Any = np.asarray(camera.to_world, np.float64).copy()
    pose[:3, 3] += pose[:3, :3] @ change[3:OWN]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(change[:3]).as_matrix()
    longer, bent = change[OWN:].tolist()
    fov_x = fov_of(math.exp(longer) * camera.fl_x, camera.width) if longer else camera.fov_x
    k1, *others = camera.lens.numerator or (0.0,)
    lens = replace(camera.lens, numerator=(k1 + bent, *others)) if bent else camera.lens
    return replace(camera, to_world=pose, fov_x=fov_x, lens=lens)


def derivatives(camera: Camera, points: Tensor) -> Float64Array:
    """How film positions of world points [n, 3] move with the eight numbers of :func:`moved` [n, 2, 8], of any lens, by
    central differences.
    """
    points = points.double().cpu()
    scale = float(to_camera(camera, points).norm(dim=-1).median()) if len(points) else 1.0
    columns = []
    for step in _SMALL * np.diag([1.0, 1.0, 1.0, scale, scale, scale, 1.0, 1.0]):
        ends = [moved(camera, sign * step) for sign in (1.0, -1.0)]
        above, below = (project(end, to_camera(end, points)) for end in ends)
        columns.append((above - below).numpy() / (2.0 * step.sum()))
    return np.asarray(np.stack(columns, -1))


def apart(first: Camera, second: Camera, world: World) -> float:
    """Pixels between the pictures of two cameras of the same photograph, the median over surface points."""
    axes = [(torch.arange(16, dtype=torch.float64) + 0.5) / 16 * side for side in (first.width, first.height)]
    xy = torch.cartesian_prod(*axes)
    with world.tracer.uncounted():
        rays = camera_rays(first, xy.float().to(world.geometry.vertices.device))
        si = world.intersect(rays)
    p, valid = si.p.double().cpu(), si.valid.cpu()
    apart = (project(second, to_camera(second, p)) - project(first, to_camera(first, p))).norm(dim=-1)[valid]
    known = apart[~apart.isnan()]  # a lens with distortion does not show everything
    return float(known.median()) if len(known) else 0.0
