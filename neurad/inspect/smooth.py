"""Few samples made smooth where the surface is: a first guess for pictures that have nothing smooth to begin with."""

import math

import torch
from torch import Tensor
from torch.nn.functional import pad

from neurad.assembly.build import Assembly
from neurad.core.camera import camera_rays
from neurad.core.frame import dot
from neurad.core.scene_records import Camera

DARKEST = 0.02
"""Albedo below which light is not divided by it."""
TURN = 16.0
"""How quickly weights fall as normals turn away: to 1/e at 20 degrees."""
DEPTH = 0.01
"""Distance from a surface's plane, over that from the camera, at which weights fall to 1/e."""
COARSE = 16
"""Pixels across the picture that the widest smoothing leaves apart."""
_TAPS = [(y, x, 2.0 ** -(abs(y) + abs(x))) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]


class Smoother:
    """Means over a surface of the light that arrives there, in steps that widen (an a-trous wavelet transform).

    Light is what a picture shows over the albedo, so that patterns stay sharp. Nothing is mixed across edges of meshes
    or creases, nothing is changed on smooth mirrors and glass and where there is no surface. Edges of shadows and
    reflections are blurred.
    """

    def __init__(self, assembly: Assembly, camera: Camera) -> None:
        world = assembly.world
        device = world.two_sided.device
        pixel = torch.arange(camera.width * camera.height, device=device)
        rays = camera_rays(camera, torch.stack((pixel % camera.width, pixel // camera.width), -1) + 0.5)
        with torch.no_grad():
            si = world.intersect(rays)
            albedo = assembly.materials.albedo(si)
        size = camera.height, camera.width
        delta = torch.tensor([m.model.is_delta for m in assembly.scene.materials], device=device)
        prim = si.prim.clamp_min(0)
        usable = si.valid & ~delta[world.geometry.material[prim]]
        mesh = torch.where(usable, world.geometry.mesh_index[prim], -1).view(size)
        away = torch.linalg.vector_norm(si.p - rays.o, dim=-1).clamp_min(1e-12).view(size)
        self._albedo = torch.where(usable[:, None], albedo, 1.0).clamp_min(DARKEST).view(*size, 3)
        self._levels = [
            (step, _weights(mesh, si.n.view(*size, 3), si.p.view(*size, 3), away, step))
            for step in (1 << level for level in range(max(1, round(math.log2(max(min(size) / COARSE, 1.0))))))
        ]

    def __call__(self, picture: Tensor) -> Tensor:
        """A picture [h, w, 3] made smooth."""
        light = picture / self._albedo
        for step, weights in self._levels:
            total = torch.ones_like(weights[0])
            summed = light.clone()
            for shifted, weight in zip(_shifted(light, step), weights, strict=True):
                summed += weight.unsqueeze(-1) * shifted
                total += weight
            light = summed / total.unsqueeze(-1)
        return light * self._albedo


def _weights(mesh: Tensor, n: Tensor, p: Tensor, away: Tensor, step: int) -> list[Tensor]:
    """Weights [h, w] of the neighbours of each pixel, ``step`` pixels away, in the order of the taps."""
    found = []
    for (_, _, weight), n2, p2, mesh2 in zip(
        _TAPS, _shifted(n, step), _shifted(p, step), _shifted(mesh.unsqueeze(-1).double(), step), strict=True
    ):
        turned = (1.0 - dot(n, n2)).clamp_min(0.0)
        off = dot(p2 - p, n).abs() / (DEPTH * away)
        same = (mesh2[..., 0] == mesh) & (mesh >= 0)
        found.append(weight * torch.where(same, (-TURN * turned - off).exp(), 0.0))
    return found


def _shifted(image: Tensor, step: int) -> list[Tensor]:
    """An image [h, w, c] as each neighbour sees it; beyond its edge it goes on as at the edge."""
    height, width, _ = image.shape
    wide = pad(image.permute(2, 0, 1)[None], (step, step, step, step), mode="replicate")[0].permute(1, 2, 0)
    return [
        wide[step * (1 + y) : step * (1 + y) + height, step * (1 + x) : step * (1 + x) + width] for y, x, _ in _TAPS
    ]
