"""Pinhole cameras: rays through film positions, and film positions of points."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from neurad.core.records import Camera, Rays


def pixel_side(camera: Camera) -> float:
    """Side of a pixel on the plane z = -1 of the camera's space."""
    return 2.0 * math.tan(0.5 * camera.fov_x) / camera.width


def focal_length(camera: Camera) -> float:
    """Focal length in pixels."""
    return 0.5 * camera.width / math.tan(0.5 * camera.fov_x)


def fov_of(focal: float, width: int) -> float:
    """Horizontal field of view in radians for a focal length in pixels; the inverse of :func:`focal_length`."""
    return 2.0 * math.atan(0.5 * width / focal)


def camera_rays(camera: Camera, xy: Tensor) -> Rays:
    """Rays from the pinhole through film positions.

    Args:
        camera: looks along -Z with +Y up; ``fov_x`` is horizontal, pixels are square.
        xy: film positions in pixels [n, 2]; x runs right from 0 to width, y runs down from 0 to height.

    Returns:
        Rays with unit directions, on the device of ``xy``.
    """
    pixel = pixel_side(camera)
    x = (xy[:, 0] - 0.5 * camera.width) * pixel
    y = (0.5 * camera.height - xy[:, 1]) * pixel
    to_world = torch.as_tensor(camera.to_world, dtype=xy.dtype, device=xy.device)
    d = torch.stack((x, y, -torch.ones_like(x)), -1) @ to_world[:3, :3].T
    d = d / d.norm(dim=-1, keepdim=True)
    return Rays(to_world[:3, 3].expand_as(d).contiguous(), d)


def to_camera(camera: Camera, p: Tensor) -> Tensor:
    """World points [..., 3] in the camera's space, where it looks along -z."""
    to_world = torch.as_tensor(camera.to_world, dtype=p.dtype, device=p.device)
    return (p - to_world[:3, 3]) @ to_world[:3, :3]


def project(camera: Camera, p: Tensor) -> Tensor:
    """Film positions in pixels [..., 2] of points in the camera's space [..., 3] with z < 0."""
    depth = -p[..., 2] * pixel_side(camera)
    return torch.stack((0.5 * camera.width + p[..., 0] / depth, 0.5 * camera.height - p[..., 1] / depth), -1)


def in_view(camera: Camera, p: Tensor) -> Tensor:
    """Whether world points [n, 3] lie before the camera and inside its film, whatever is in between [n], bool."""
    x, y, z = to_camera(camera, p).unbind(-1)
    edge_x = math.tan(0.5 * camera.fov_x)
    edge_y = edge_x * camera.height / camera.width
    return (z < 0) & (x.abs() <= -z * edge_x) & (y.abs() <= -z * edge_y)


@dataclass(frozen=True)
class Cameras:
    """Several cameras of one size on tensors, for rays through pixels of different views at once."""

    rotation: Tensor
    """Camera to world [v, 3, 3]."""
    origin: Tensor
    """[v, 3]."""
    side: Tensor
    """Side of a pixel on the plane z = -1 [v]."""
    width: int
    height: int

    @classmethod
    def of(cls, cameras: list[Camera], device: torch.device | str) -> Self:
        """The cameras on a device, float32."""
        pose = torch.stack([torch.as_tensor(c.to_world, dtype=torch.float32) for c in cameras]).to(device)
        side = torch.tensor([pixel_side(c) for c in cameras], device=device)
        return cls(pose[:, :3, :3].contiguous(), pose[:, :3, 3].contiguous(), side, cameras[0].width, cameras[0].height)

    def rays(self, view: Tensor, xy: Tensor) -> Rays:
        """What :func:`camera_rays` gives, each lane with the camera of its view.

        Args:
            view: index of the camera [n], int64.
            xy: film positions in pixels [n, 2].
        """
        side, axes = self.side[view], self.rotation[view]
        x, y = (xy[:, 0] - 0.5 * self.width) * side, (0.5 * self.height - xy[:, 1]) * side
        d = axes[:, :, 0] * x.unsqueeze(-1) + axes[:, :, 1] * y.unsqueeze(-1) - axes[:, :, 2]
        return Rays(self.origin[view], d / d.norm(dim=-1, keepdim=True))


def resized(camera: Camera, width: int | None) -> Camera:
    """The camera with its film scaled to ``width`` pixels; the same camera for None."""
    if width is None:
        return camera
    return replace(camera, width=width, height=round(camera.height * width / camera.width))
