"""How hard a scene's held-out views are: what is seen in them, and what trivial answers score there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.records import Rays, SurfaceInteraction, View
from neurad.core.rng import Stream
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

SUB = 16


@dataclass(frozen=True)
class HeldOutMaps:
    """Box-filtered truth over the counted pixels of all held-out views."""

    albedo: Tensor
    """[p, 3]."""
    roughness: Tensor
    """[p, 1]."""
    fraction: Tensor
    """How much of each pixel shows each mesh [p, meshes]."""
    seen: Tensor
    """In how many training views the worst sub-sample of each pixel is seen [p]."""


def primary(world: World, view: View, sub: int = SUB, seed: int = 0) -> SurfaceInteraction:
    """First hits of ``sub`` stratified positions in every pixel, pixel-major."""
    camera = view.camera
    pixels = torch.arange(camera.width * camera.height)
    xy = pixel_positions(camera.width, pixels, sub, Stream(seed)).reshape(-1, 2)
    return world.intersect(camera_rays(camera, xy))


def seen_by(world: World, view: View, si: SurfaceInteraction) -> Tensor:
    """Whether points lie in the frustum of ``view``, unoccluded [n], bool."""
    camera = view.camera
    pose = torch.as_tensor(camera.to_world, dtype=torch.float32)
    to_point = si.p - pose[:3, 3]
    local = to_point @ pose[:3, :3]
    half = torch.tan(torch.tensor(camera.fov_x / 2))
    inside = (local[:, 2] < 0) & (local[:, :2].abs().amax(-1) < -local[:, 2] * half)
    distance = to_point.norm(dim=-1)
    hit = world.intersect(Rays(pose[:3, 3].expand_as(to_point).contiguous(), to_point / distance.unsqueeze(-1)))
    return inside & ((hit.p - si.p).norm(dim=-1) < 2e-3 * distance)


def held_out_maps(scene: Scene, world: World) -> HeldOutMaps:
    """Truth, objects and coverage over the counted pixels (none of whose sub-samples sees an emitter or nothing)."""
    materials = TrueMaterials(scene, world.geometry)
    parts = []
    for view in scene.test:
        si = primary(world, view)
        surface = materials(si)
        mesh = world.geometry.mesh_index[si.prim.clamp_min(0)]
        lit = world.geometry.emission[si.prim.clamp_min(0)].amax(-1) > 0
        counted = (si.valid & ~lit).view(-1, SUB).all(1)
        fraction = torch.nn.functional.one_hot(mesh, len(scene.meshes)).float().view(-1, SUB, len(scene.meshes)).mean(1)
        seen = torch.stack([seen_by(world, train, si) for train in scene.train]).sum(0).view(-1, SUB).amin(1)
        albedo, roughness = (x.view(-1, SUB, x.shape[-1]).mean(1) for x in (surface.albedo, surface.roughness))
        parts.append(tuple(x[counted] for x in (albedo, roughness, fraction, seen)))
    return HeldOutMaps(*(torch.cat(x) for x in zip(*parts, strict=True)))


def psnr(error: Tensor) -> float:
    """PSNR with peak 1 of residuals, pooled."""
    return float(-10 * torch.log10((error**2).mean()))


def best_per_object(truth: Tensor, fraction: Tensor) -> float:
    """PSNR of the best answer with one value per mesh: least squares over box-filtered pixels."""
    used = fraction.sum(0) > 0
    basis = fraction[:, used].double()
    value = torch.linalg.lstsq(basis, truth.double(), driver="gelsd").solution
    return psnr(basis @ value - truth)


def best_constant(truth: Tensor) -> float:
    """PSNR of the mean."""
    return psnr(truth - truth.mean(0))
