"""Surfaces as photographs show them: which pixels show nothing but one side of one mesh, and the radiance that leaves
the places they show.

Nothing is assumed of materials or lights. What leaves a place is what the photographs of it show on average, whatever
it is made of, so the light that arrives elsewhere can be gathered from it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.colour import luminance
from neurad.core.frame import dot
from neurad.core.protocols import PhotoSource
from neurad.core.records import Lanes, PixelBatch, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.sampling import evenly
from neurad.core.scene_records import Camera
from neurad.integrators.film import pixel_positions
from neurad.integrators.world import World
from neurad.runtime.progress import counted
from neurad.scene.geometry import Geometry

MAX_PIXELS = 1 << 20
"""Pixels that are looked at, all photographs together."""
MIN_PIXELS_PER_VIEW = 64  # of each photograph, however many there are
POSITIONS = 4
"""Stratified positions of a pixel, all of which have to show the same side of the same mesh."""
_CHUNK = 1 << 15  # pixels
_FINEST = 1.0 / 64  # sides of the cells in which radiance is averaged, in radii of the scene
_COARSER = 1, 4, 16
_BITS = 14  # of a cell's number along an axis


@dataclass(frozen=True)
class SurfacePixels(Lanes):
    """Pixels that show nothing but one side of one mesh, and a point of it."""

    view: Tensor
    """[n], int64."""
    pixel: Tensor
    """Row-major pixel index [n], int64."""
    side: Tensor
    """Twice the index of the mesh, and 1 more where its triangles' backs are seen [n], int64."""
    color: Tensor
    """Photographed there [n, 3]."""
    full: Tensor
    """Which channels are at the photograph's ceiling [n, 3], bool."""
    prims: Tensor
    """Triangles met at several positions of the pixel [n, positions], int64."""
    si: SurfaceInteraction
    """The point at the first of these, seen from the camera."""

    def evenly(self, most: int) -> SurfacePixels:
        """At most so many of the pixels, evenly over all."""
        return self[evenly(len(self), most, self.view.device)]

    @property
    def clipped(self) -> Tensor:
        """Whether some channel is at the photograph's ceiling [n], bool."""
        return self.full.any(-1)


def side_of(geometry: Geometry, si: SurfaceInteraction) -> Tensor:
    """The side of a mesh that is seen [n], as in :class:`SurfacePixels`."""
    return 2 * geometry.mesh_index[si.prim.clamp_min(0)] + (dot(si.ng, si.wo) <= 0).long()


@torch.no_grad()
def surface_pixels(
    world: World,
    cameras: Sequence[Camera],
    photographs: PhotoSource,
    seed: int,
    develop: Callable[[PixelBatch], PixelBatch] | None = None,
) -> SurfacePixels:
    """Look at the photographs, corrected by ``develop``: of large ones at every few pixels, and as many of the
    brightest, which show what is small and shines.
    """
    device = world.geometry.vertices.device
    ignored = photographs.ignored()
    most = max(MIN_PIXELS_PER_VIEW, MAX_PIXELS // max(1, len(cameras)))
    parts: list[SurfacePixels] = []
    for index, camera in enumerate(counted(cameras, "looking at", len(cameras), "photographs")):
        pixel = torch.arange(camera.width * camera.height)
        color = photographs.colors(torch.full_like(pixel, index), pixel)
        if develop is not None:
            batch = PixelBatch(torch.full_like(pixel, index), pixel, color, torch.ones(len(pixel)), 0)
            color = develop(batch).color.cpu()
        if ignored is not None:
            pixel = pixel[~ignored[index, : len(pixel)]]
        pixel = _chosen(pixel, luminance(color)[pixel], most)
        view = torch.full_like(pixel, index)
        clipped = photographs.clipped(view, pixel)
        full = torch.zeros(len(pixel), 3, dtype=torch.bool) if clipped is None else clipped
        for begin in range(0, max(1, len(pixel)), _CHUNK):
            part = slice(begin, begin + _CHUNK)
            stream = Stream(seed, index, begin, 41, device=device)
            whole, side, prims, si = showing_one_side(world, camera, pixel[part].to(device), POSITIONS, stream)
            read = (view[part], pixel[part], color[pixel[part]], full[part])
            views, places, colors, clips = (x[whole.cpu()].to(device) for x in read)
            parts.append(SurfacePixels(views, places, side, colors, clips, prims, si))
    return SurfacePixels.cat(*parts)


@torch.no_grad()
def showing_one_side(
    world: World, camera: Camera, pixel: Tensor, positions: int, stream: Stream
) -> tuple[Tensor, Tensor, Tensor, SurfaceInteraction]:
    """Which row-major pixels [n] show nothing but one side of one mesh at so many positions in each.

    Returns:
        Whether a pixel does [n], and of those that do the side, the triangles at all positions and the first point.
    """
    geometry = world.geometry
    rays = camera_rays(camera, pixel_positions(camera.width, pixel, positions, stream).view(-1, 2))
    with world.tracer.uncounted():
        hit = world.tracer.closest(rays)
    prim = hit.prim.clamp_min(0)
    back = dot(geometry.face_normal[prim], rays.d) >= 0
    side = torch.where(hit.valid, 2 * geometry.mesh_index[prim] + back, -1).view(-1, positions)
    whole = (side[:, 0] >= 0) & (side == side[:, :1]).all(-1)
    first = whole.nonzero().squeeze(-1)
    return (
        whole,
        side[first, 0],
        prim.view(-1, positions)[first],
        geometry.interact(rays[first * positions], hit[first * positions]),
    )


def _chosen(pixel: Tensor, light: Tensor, most: int) -> Tensor:
    """At most so many of the pixels [n], half of them evenly, half of them the brightest; in order."""
    if len(pixel) <= most:
        return pixel
    bright = light.topk(most - most // 2).indices
    return pixel[torch.unique(torch.cat((evenly(len(pixel), most // 2), bright)))]


class PhotographedRadiance:
    """The radiance that leaves surfaces, by what photographs show of them, whatever the direction: means over cells of
    each side of each mesh, the coarser where no photograph shows the finer. It takes the place of a radiance field.
    """

    reads_albedo = False

    def __init__(self, geometry: Geometry, pixels: SurfacePixels) -> None:
        self.geometry = geometry
        p = pixels.si.p
        self.low = p.amin(0) if len(p) else p.new_zeros(3)
        self.left_out = torch.zeros(2 * int(geometry.mesh_index.max()) + 2, dtype=torch.bool, device=p.device)
        """Sides that count as dark, because their light is known otherwise."""
        self.levels = []
        values = torch.cat((pixels.color, torch.ones_like(pixels.color[:, :1])), -1).double()
        for times in _COARSER:
            size = times * _FINEST * geometry.scale
            keys, row = torch.unique(self._key(pixels.side, p, size), return_inverse=True)
            total = values.new_zeros(len(keys), 4).index_add_(0, row, values)
            self.levels.append((size, keys, (total[:, :3] / total[:, 3:]).float()))

    def __call__(self, si: SurfaceInteraction, albedo: Tensor | None = None) -> Tensor:
        """Radiance [n, 3]; 0 where no photograph shows anything near."""
        return self._found(si)[0]

    def covered(self, si: SurfaceInteraction, albedo: Tensor) -> Tensor:
        """1 where radiance is known, 0 where it is not [n, 3]."""
        return self._found(si)[1].float().unsqueeze(-1).expand(-1, 3)

    def _found(self, si: SurfaceInteraction) -> tuple[Tensor, Tensor]:
        """Radiance [n, 3], and whether it is known [n]."""
        side = side_of(self.geometry, si)
        found, known = torch.zeros_like(si.p), self.left_out[side]
        for size, keys, mean in self.levels:
            if len(keys) == 0:
                break
            key = self._key(side, si.p, size)
            at = torch.searchsorted(keys, key).clamp_max(len(keys) - 1)
            here = (keys[at] == key) & ~known
            found = torch.where(here.unsqueeze(-1), mean[at], found)
            known = known | here
        return found, known

    def _key(self, side: Tensor, p: Tensor, size: float) -> Tensor:
        """A number for each side and cell [n]."""
        cell = ((p - self.low) / size).floor().long().clamp(-1, (1 << _BITS) - 2) + 1
        key = side
        for axis in range(3):
            key = (key << _BITS) + cell[:, axis]
        return key
