"""Rays through the pixels of a camera."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neurad.core.records import Camera, Rays


def camera_rays(camera: Camera, xy: Tensor) -> Rays:
    """Rays from the pinhole through film positions.

    Args:
        camera: looks along -Z with +Y up; ``fov_x`` is horizontal, pixels are square.
        xy: film positions in pixels [n, 2]; x runs right from 0 to width, y runs down from 0 to height.

    Returns:
        Rays with unit directions, on the device of ``xy``.
    """
    pixel = 2.0 * math.tan(0.5 * camera.fov_x) / camera.width  # side of a pixel on the plane z = -1
    x = (xy[:, 0] - 0.5 * camera.width) * pixel
    y = (0.5 * camera.height - xy[:, 1]) * pixel
    to_world = torch.as_tensor(camera.to_world, dtype=xy.dtype, device=xy.device)
    d = torch.stack((x, y, -torch.ones_like(x)), -1) @ to_world[:3, :3].T
    d = d / d.norm(dim=-1, keepdim=True)
    return Rays(to_world[:3, 3].expand_as(d).contiguous(), d)
