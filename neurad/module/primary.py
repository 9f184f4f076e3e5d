"""Camera rays of the training views, traced once: several stratified positions in every pixel."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.records import Camera, PixelBatch, Rays
from neurad.core.rng import Stream
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import Reached, World
from neurad.scene.camera import camera_rays

_CHUNK = 1 << 18


class PrimaryHits:
    """What the camera sees at ``count`` stratified positions in each pixel of each training view.

    Keeps a triangle and barycentrics for each, 12 bytes; never the centre of a pixel alone.

    Args:
        world: the scene.
        cameras: training cameras, all of one size.
        count: positions a pixel.
        seed: of the positions.
        device: where the cache lies.
    """

    def __init__(self, world: World, cameras: list[Camera], count: int, seed: int, device: torch.device) -> None:
        self.world = world
        self.cameras = cameras
        self.count = count
        self.origin = torch.stack([torch.as_tensor(c.to_world[:3, 3], dtype=torch.float32) for c in cameras]).to(device)
        prim, bary, away = [], [], []
        for index, camera in enumerate(cameras):
            pixels = torch.arange(camera.width * camera.height, device=device)
            xy = pixel_positions(camera.width, pixels, count, Stream(seed, index, device=device)).view(-1, 2)
            for begin in range(0, len(xy), _CHUNK):
                rays = camera_rays(camera, xy[begin : begin + _CHUNK])
                hit = world.tracer.closest(rays)
                world.rays_cast += len(rays)
                prim.append(hit.prim.int())
                bary.append(torch.stack((hit.u, hit.v), -1))
                away.append((-rays.d).half() if world.features.has_environment else rays.d[:0].half())
        self.prim = torch.cat(prim)
        self.bary = torch.cat(bary)
        self.away = torch.cat(away)
        self.pixels = cameras[0].width * cameras[0].height

    def sees_emitter(self) -> Tensor:
        """Whether any position of a pixel sees an emitter's triangle [views, pixels], bool."""
        emission = self.world.geometry.emission.amax(-1)
        light = (emission[self.prim.clamp_min(0).long()] > 0) & (self.prim >= 0)
        return light.view(len(self.cameras), self.pixels, self.count).any(-1)

    def __call__(self, batch: PixelBatch, positions: int, stream: Stream) -> Reached:
        """First vertices at ``positions`` independent positions of every pixel, pixel by pixel [b * positions]."""
        if self.world.delta is not None:
            return self._through_glass(batch, positions, stream)
        b = len(batch.view)
        # Independent draws: if a pixel's positions were always different ones, the leave-one-out gradient would miss
        # the pairs of one position with itself and reward contrast inside the pixel.
        chosen = stream.integers(self.count, b, positions)
        pixel = (batch.view * self.pixels + batch.pixel).unsqueeze(1) * self.count
        index = (pixel + chosen).view(-1)
        prim, bary = self.prim[index].long(), self.bary[index]
        origin = self.origin[batch.view].repeat_interleave(positions, 0)
        valid = prim >= 0
        missed = self.away[index].float() if len(self.away) else torch.zeros_like(origin)
        it = self.world.geometry.interact_at(prim, bary[:, 0], bary[:, 1], missed, valid)
        seen = torch.nn.functional.normalize(origin - it.p, dim=-1)
        return Reached(replace(it, wo=torch.where(valid.unsqueeze(-1), seen, missed)), None, None)

    def _through_glass(self, batch: PixelBatch, positions: int, stream: Stream) -> Reached:
        """The same in a scene with smooth surfaces: chains are random, so they are traced anew each time."""
        u = stream.uniform(len(batch.view), positions, 3)
        width = self.cameras[0].width
        corner = torch.stack((batch.pixel % width, batch.pixel // width), -1).unsqueeze(1)
        xy, parts = corner + u[..., :2], []
        order = batch.view.argsort(stable=True)
        ends = batch.view.bincount(minlength=len(self.cameras)).cumsum(0).tolist()
        for camera, begin, end in zip(self.cameras, [0, *ends], ends, strict=False):
            if end > begin:
                parts.append(camera_rays(camera, xy[order[begin:end]].reshape(-1, 2)))
        back = order.argsort().unsqueeze(1) * positions + torch.arange(positions, device=order.device)
        return self.world.reach(Rays.cat(*parts)[back.view(-1)], u[..., 2].reshape(-1))
