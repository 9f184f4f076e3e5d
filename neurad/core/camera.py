"""Cameras: rays through film positions, and film positions of points."""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.lens import Bending
from neurad.core.records import Flash, Float64Array, Rays
from neurad.core.scene_records import Camera, PunctualLight

_CHUNK = 1 << 14
"""Positions whose distortion is taken back at a time: what is computed on the way stays in the processor's cache."""


def pixel_side(camera: Camera) -> float:
    """Width of a pixel on the plane z = -1 of the camera's space, in the middle of the picture."""
    return 2.0 * math.tan(0.5 * camera.fov_x) / camera.width


def fov_of(focal: float, width: int) -> float:
    """Horizontal field of view in radians for a focal length in pixels; the inverse of ``Camera.fl_x``."""
    return 2.0 * math.atan(0.5 * width / focal)


def facing(at: Any, back: Any, up: Any) -> Float64Array:
    """The pose [4, 4] of something at a place [3] whose +Z axis is ``back`` [3] and whose +X axis is perpendicular to
    ``up`` [3] as well. These are of any length, and not parallel.
    """
    z = np.asarray(back, np.float64) / np.linalg.norm(back)
    x = np.cross(up, z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3] = np.stack((x, np.cross(z, x), z, at), axis=1)
    return pose


def camera_rays(camera: Camera, xy: Tensor) -> Rays:
    """Rays from the camera through film positions.

    Args:
        camera: looks along -Z with +Y up. Distortion is taken back in float64, whatever the positions have.
        xy: film positions in pixels [n, 2]; x runs right from 0 to width, y runs down from 0 to height.

    Returns:
        Rays with unit directions, on the device of ``xy``.
    """
    to_world = torch.as_tensor(camera.to_world, dtype=xy.dtype, device=xy.device)
    if camera.lens.bends:
        bending = bending_of([camera], xy.device)
        d = _unbent(bending, *_distorted(camera, xy))[0].to(xy.dtype) @ to_world[:3, :3].T
    else:
        side = pixel_side(camera)
        x, y = (xy[:, 0] - camera.cx) * side, (camera.cy - xy[:, 1]) * (side / camera.lens.aspect)
        d = torch.stack((x, y, -torch.ones_like(x)), -1) @ to_world[:3, :3].T
    d = d / d.norm(dim=-1, keepdim=True)
    flash = flashes([camera], xy.device)
    return Rays(to_world[:3, 3].expand_as(d).contiguous(), d, None if flash is None else flash.repeat(len(d)))


def flashes(cameras: list[Camera], device: torch.device | str) -> Flash | None:
    """Where the flashes of cameras are in the world, one a camera; None where none has one."""
    if all(camera.flash is None for camera in cameras):
        return None
    lights = [flash_in_world(camera) or PunctualLight("none", "point", np.zeros(3, np.float32)) for camera in cameras]
    columns = zip(*((light.position, light.direction, light.intensity) for light in lights), strict=True)
    return Flash(*(torch.from_numpy(np.stack(column)).float().to(device) for column in columns))


def flash_in_world(camera: Camera) -> PunctualLight | None:
    """The flash of a camera as a light that stands in the scene where the camera is; None where it has none."""
    if camera.flash is None:
        return None
    pose: Float64Array = np.asarray(camera.to_world, np.float64)
    axis = pose[:3, :3] @ camera.flash.direction
    return replace(
        camera.flash,
        position=(pose[:3, :3] @ camera.flash.position + pose[:3, 3]).astype(np.float32),
        direction=(axis / np.linalg.norm(axis)).astype(np.float32),
    )


def bending_of(cameras: list[Camera], device: torch.device | str) -> Bending:
    """The distortion of cameras, a row each."""
    return Bending.of([(c.lens, pixel_side(c), c.width, c.height) for c in cameras], device)


def _distorted(camera: Camera, xy: Tensor) -> tuple[Tensor, Tensor]:
    """Film positions on the plane at distance 1 as the lens shows it, y down, float64."""
    side = pixel_side(camera)
    x, y = xy.double().unbind(-1)
    return (x - camera.cx) * side, (y - camera.cy) * (side / camera.lens.aspect)


def _unbent(bending: Bending, xd: Tensor, yd: Tensor) -> tuple[Tensor, Tensor]:
    """Directions in the camera's space [n, 3] and how much of the sphere around them comes to an area of the plane, as
    a fraction of what it is in the middle of the picture [n].
    """
    directions, spreads = [], []
    for begin in range(0, max(len(xd), 1), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        here = bending if len(bending.row) == 1 else bending[part]
        x, y, area = here.unbend(xd[part], yd[part])
        directions.append(torch.stack(here.direction(x, y), -1))
        spreads.append(torch.where(here.fisheye, torch.sinc(torch.hypot(x, y) / math.pi), 1.0) / area)
    return torch.cat(directions), torch.cat(spreads)


def to_camera(camera: Camera, p: Tensor) -> Tensor:
    """World points [..., 3] in the camera's space, where it looks along -z."""
    to_world = torch.as_tensor(camera.to_world, dtype=p.dtype, device=p.device)
    return (p - to_world[:3, 3]) @ to_world[:3, :3]


def project(camera: Camera, p: Tensor) -> Tensor:
    """Film positions in pixels [..., 2] of points in the camera's space [..., 3] with z < 0, for a fisheye any z.

    What a lens with distortion does not bring to the film at all is NaN.
    """
    side = pixel_side(camera)
    if not camera.lens.bends:
        depth = -p[..., 2] * side
        y = p[..., 1] / (depth / camera.lens.aspect)
        return torch.stack((camera.cx + p[..., 0] / depth, camera.cy - y), -1)
    bending = bending_of([camera], p.device)
    x, y = bending.bend(*bending.plane(*p.double().unbind(-1)))
    return torch.stack((camera.cx + x / side, camera.cy + y / (side / camera.lens.aspect)), -1).to(p.dtype)


def in_view(camera: Camera, p: Tensor) -> Tensor:
    """Whether world points [n, 3] lie before the camera and inside its film, whatever is in between [n], bool."""
    here = to_camera(camera, p)
    x, y = project(camera, here).unbind(-1)
    inside = (x >= 0) & (x <= camera.width) & (y >= 0) & (y <= camera.height)
    return inside if camera.lens.bends else inside & (here[..., 2] < 0)


@dataclass(frozen=True)
class Cameras:
    """Several cameras on tensors, for rays through pixels of different views at once."""

    rotation: Tensor
    """Camera to world [v, 3, 3]."""
    origin: Tensor
    """[v, 3]."""
    side: Tensor
    """Width of a pixel on the plane z = -1 in the middle of the picture [v]."""
    size: Tensor
    """Width and height in pixels [v, 2], float32."""
    centre: Tensor
    """Place of the axis in pixels [v, 2]."""
    rise: Tensor
    """Height of a pixel on that plane [v]."""
    width: Tensor
    """[v], int64."""
    bending: Bending | None = None
    """None where no lens distorts."""
    flash: Flash | None = None
    """[v]; None where no camera has one."""

    @classmethod
    def of(cls, cameras: list[Camera], device: torch.device | str) -> Self:
        """The cameras on a device, float32 but for distortion."""
        pose = torch.stack([torch.as_tensor(c.to_world, dtype=torch.float32) for c in cameras]).to(device)
        make = partial(torch.tensor, dtype=torch.float32, device=device)
        return cls(
            rotation=pose[:, :3, :3].contiguous(),
            origin=pose[:, :3, 3].contiguous(),
            side=make([pixel_side(c) for c in cameras]),
            size=make([(c.width, c.height) for c in cameras]),
            centre=make([(c.cx, c.cy) for c in cameras]),
            rise=make([pixel_side(c) / c.lens.aspect for c in cameras]),
            width=torch.tensor([c.width for c in cameras], device=device),
            bending=bending_of(cameras, device) if any(c.lens.bends for c in cameras) else None,
            flash=flashes(cameras, device),
        )

    def corner(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Upper left corners [n, 2], int64, of row-major pixels [n] of views [n]."""
        width = self.width[view]
        return torch.stack((pixel % width, pixel // width), -1)

    def rays(self, view: Tensor, xy: Tensor) -> Rays:
        """What :func:`camera_rays` gives at positions ``xy`` [n, 2], each lane with the camera of its ``view`` [n]."""
        side, rise, axes, centre = self.side[view], self.rise[view], self.rotation[view], self.centre[view]
        x, y = (xy[:, 0] - centre[:, 0]) * side, (centre[:, 1] - xy[:, 1]) * rise
        d = axes[:, :, 0] * x.unsqueeze(-1) + axes[:, :, 1] * y.unsqueeze(-1) - axes[:, :, 2]
        if self.bending is not None:
            local = _unbent(self.bending[view], *self._distorted(view, xy))[0].to(d.dtype)
            d = (axes @ local.unsqueeze(-1)).squeeze(-1)
        flash = None if self.flash is None else self.flash[view]
        return Rays(self.origin[view], d / d.norm(dim=-1, keepdim=True), flash)

    def footprint(self, view: Tensor, xy: Tensor) -> Tensor:
        """Side of a pixel at distance 1 [n], as far as the lens changes it over the picture."""
        side = (self.side * self.rise).sqrt()[view]
        if self.bending is None:
            return side
        return side * _unbent(self.bending[view], *self._distorted(view, xy))[1].sqrt().to(side.dtype)

    def _distorted(self, view: Tensor, xy: Tensor) -> tuple[Tensor, Tensor]:
        x, y = (xy - self.centre[view]).double().unbind(-1)
        return x * self.side[view], y * self.rise[view]


def resized(camera: Camera, width: int | None) -> Camera:
    """The camera with its film scaled to ``width`` pixels; the same camera for None."""
    if width is None:
        return camera
    return replace(camera, width=width, height=round(camera.height * width / camera.width))
