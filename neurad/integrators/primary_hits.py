"""Camera rays of the training views: traced once, at several stratified positions in every pixel, or in every step."""

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from neurad.core.camera import Cameras, camera_rays
from neurad.core.records import PixelBatch, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.integrators.emitter_pixels import emitter_pixels, pixels_beyond
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import Distinct, NonDeltaHit, World
from neurad.runtime.dispatch import use_kernel
from neurad.runtime.lanes import all_lanes
from neurad.runtime.progress import counted
from neurad.runtime.threads import GRAIN, split

_CHUNK = 1 << 18
_POSITIONS = 1 << 22
"""Positions that are drawn, or looked at, at a time: bounds the memory beside what is kept."""


def kept_positions(world: World, cached_spp: int) -> int:
    """How many of ``cached_spp`` positions of a pixel are kept: none where there are smooth surfaces."""
    return cached_spp if world.delta is None else 0


class PrimaryHits:
    """What the camera sees at ``cached_spp`` stratified positions in each pixel of each training view.

    Keeps a triangle and barycentrics for each, 12 bytes; never the centre of a pixel alone. With a ``cached_spp`` of 0
    nothing is kept: every call traces new, uniformly random positions. So it is in a scene with smooth surfaces, whose
    chains are random.
    """

    def __init__(
        self,
        world: World,
        cameras: list[Camera],
        cached_spp: int,
        seed: int,
        device: torch.device,
        use_kernels: bool = True,
    ) -> None:
        self.world = world
        self.cameras = cameras
        self.cached_spp = cached_spp = kept_positions(world, cached_spp)
        self.seed = seed
        self.use_kernels = use_kernels
        self.views = Cameras.of(cameras, device)
        self.origin = self.views.origin
        counts = [camera.width * camera.height for camera in cameras]
        self.pixels = max(counts)
        """Pixels of the largest view."""
        self.first = (torch.tensor(counts).cumsum(0) - torch.tensor(counts)).to(device)  # pixel of each view
        total = sum(counts) * cached_spp
        has_sky = world.features.has_environment
        # Triangle and barycentrics of a hit stand next to each other, since they are read at random addresses.
        self.hits = torch.empty(total, 3, dtype=torch.int32, device=device)
        self.prim, self.bary = self.hits[:, 0], self.hits[:, 1:].view(torch.float32)
        self.away = torch.empty(total if has_sky else 0, 3, dtype=torch.float16, device=device)
        if cached_spp > 0:
            for index, camera in enumerate(counted(cameras, "tracing", len(cameras), "camera rays")):
                self._keep(index, camera)

    def _keep(self, index: int, camera: Camera) -> None:
        """Trace the positions of one view."""
        device = self.prim.device
        stream = Stream(self.seed, index, device=device)
        step, count = max(1, _POSITIONS // self.cached_spp), camera.width * camera.height
        before = int(self.first[index])
        for row in range(0, count, step):
            pixels = torch.arange(row, min(row + step, count), device=device)
            xy = pixel_positions(camera.width, pixels, self.cached_spp, stream).view(-1, 2)
            first = (before + row) * self.cached_spp
            for begin in range(0, len(xy), _CHUNK):
                rays = camera_rays(camera, xy[begin : begin + _CHUNK])
                hit = self.world.tracer.closest(rays)
                here = slice(first + begin, first + begin + len(rays))
                self.prim[here] = hit.prim.int()
                self.bary[here] = torch.stack((hit.u, hit.v), -1)
                if len(self.away):
                    self.away[here] = (-rays.d).half()

    def nothing(self) -> Tensor:
        """A mask of no pixel [views, pixels], bool; True behind the last one of a view that is smaller than others."""
        counts = torch.tensor([camera.width * camera.height for camera in self.cameras])
        return (torch.arange(self.pixels) >= counts.unsqueeze(1)).to(self.prim.device)

    def sees_emitter(self) -> Tensor:
        """Whether any position of a pixel sees an emitter's triangle [views, pixels], bool.

        Without kept positions some are traced for it, in the pixels onto which an emitter projects. A view that is
        smaller than others has fewer pixels: what lies behind its last one is True.
        """
        if self.cached_spp == 0:
            return emitter_pixels(self.world, self.cameras, self.seed, self.prim.device)
        emission = self.world.geometry.emission.amax(-1)
        prims = self.prim.view(-1, self.cached_spp)
        found = torch.empty(len(prims), dtype=torch.bool, device=prims.device)
        step = max(1, _POSITIONS // self.cached_spp)
        for begin in range(0, len(prims), step):
            prim = prims[begin : begin + step]
            light = (emission[prim.clamp_min(0).long()] > 0) & (prim >= 0)
            found[begin : begin + step] = light.any(-1)
        views = torch.split(found, [camera.width * camera.height for camera in self.cameras])
        return pad_sequence(list(views), batch_first=True, padding_value=True)

    def sees_beyond(self) -> Tensor:
        """Whether a pixel shows a smooth surface or the environment [views, pixels], bool; True behind a view's
        last pixel.
        """
        return pixels_beyond(self.world, self.cameras, self.seed, self.prim.device)

    def some(self, pixels: PixelBatch, count: int, stream: Stream) -> tuple[SurfaceInteraction, Tensor]:
        """First vertices of at most ``count`` of the pixels, drawn at random where there are more, and their colours
        [n, 3].
        """
        device = self.origin.device
        if len(pixels.view) > count:
            pixels = pixels[stream.integers(len(pixels.view), count).to(pixels.view.device)]
        pixels = pixels.to(device)
        return self(pixels, 1, stream).si, pixels.color

    def __call__(self, batch: PixelBatch, spp: int, stream: Stream) -> NonDeltaHit:
        """First vertices at ``spp`` independent positions of every pixel, pixel by pixel [b * spp]."""
        if self.cached_spp == 0:
            return self._anew(batch, spp, stream)
        # ---------------------- Kept positions ----------------------

        b = len(batch.view)
        # Independent draws: if a pixel's positions were always different ones, the leave-one-out gradient would miss
        # the pairs of one position with itself and reward contrast inside the pixel.
        chosen = stream.integers(self.cached_spp, b, spp)  # [b, spp]
        first = (self.first[batch.view] + batch.pixel) * self.cached_spp  # [b]

        # ---------------------- Surface points there ----------------------

        geometry = self.world.geometry
        kernel = use_kernel(self.use_kernels and len(geometry.faces) > 0, geometry.table, self.origin)
        points = self._kernel if kernel else self._reference
        distinct = self._distinct(chosen) if kernel and spp > 1 and not all_lanes(chosen.device) else None
        si = points(first, chosen, batch.view)
        if self.views.flash is not None:
            si = self.world.flashed(si, self.views.flash[batch.view].repeat(spp))
        return NonDeltaHit(si, None, None, distinct)

    def _distinct(self, chosen: Tensor) -> Distinct | None:
        """Which lanes are the same kept hit, as positions of a pixel were ``chosen`` [b, n]; None where fewer than an
        eighth of them repeat another.
        """
        from neurad.scene import geometry_kernels as kernels  # compiled code is loaded by those who use it

        lanes, source = torch.empty(2, chosen.numel(), dtype=torch.int64).unbind()
        last = np.full(self.cached_spp, -1)
        count = kernels.number_distinct(chosen.numpy(), last, lanes.numpy(), source.numpy())
        return Distinct(lanes[:count], source) if 8 * count <= 7 * len(source) else None

    def _reference(self, first: Tensor, chosen: Tensor, view: Tensor) -> SurfaceInteraction:
        """Surface points at the kept hits ``first`` [b] + ``chosen`` [b, n] of pixels of ``view`` [b]."""
        # Triangle and barycentrics of each hit
        index = (first.unsqueeze(1) + chosen).view(-1)
        hits = self.hits[index]  # [b * n, 3]
        prim, bary = hits[:, 0].long(), hits[:, 1:].view(torch.float32)

        # Surface points, and the direction back to the camera
        origin = self.origin[view].repeat_interleave(chosen.shape[1], 0)
        valid = prim >= 0
        missed = self.away[index].float() if len(self.away) else torch.zeros_like(origin)
        si = self.world.geometry.interact_at(prim, bary[:, 0], bary[:, 1], missed, valid)
        seen = torch.nn.functional.normalize(origin - si.p, dim=-1)
        return replace(si, wo=torch.where(valid.unsqueeze(-1), seen, missed))

    def _kernel(self, first: Tensor, chosen: Tensor, view: Tensor) -> SurfaceInteraction:
        """Surface points of :meth:`_reference` in one compiled pass."""
        from neurad.scene import geometry_kernels as kernels  # compiled code is loaded by those who use it

        m = chosen.numel()
        away = self.away[(first.unsqueeze(1) + chosen).view(-1)].float() if len(self.away) else torch.empty(0, 3)
        prim, valid = torch.empty(m, dtype=torch.int64), torch.empty(m, dtype=torch.bool)
        p, ng, n, wo = torch.empty(4, m, 3).unbind()
        uv, bary = torch.empty(2, m, 2).unbind()
        given = self.hits, self.hits.view(torch.float32), first, chosen, view, self.origin, away
        filled = prim, valid, p, ng, n, wo, uv, bary
        arrays = [x.contiguous().numpy() for x in (*given, self.world.geometry.table, *filled)]
        split(lambda low, high: kernels.interact_kept(low, high, *arrays), m, GRAIN)
        return SurfaceInteraction(p, ng, n, wo, uv, bary, prim, valid)

    def _anew(self, batch: PixelBatch, spp: int, stream: Stream) -> NonDeltaHit:
        u = stream.uniform(len(batch.view), spp, 3)
        corner = self.views.corner(batch.view, batch.pixel).unsqueeze(1)
        view = batch.view.repeat_interleave(spp)
        rays = self.views.rays(view, (corner + u[..., :2]).view(-1, 2))
        return self.world.trace_past_delta(rays, u[..., 2].reshape(-1))
