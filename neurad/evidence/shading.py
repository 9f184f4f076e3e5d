"""Whether photographs follow the light: how brightness rises with the light that arrives, within one mesh.

What a matt surface shows is its albedo times the light that arrives, so along a mesh of one albedo the logarithm of a
photograph rises by one with that of the light. What its coat reflects comes on top: that of rough paint follows the
light, too, while smooth paint reflects the room, which flattens the slope of dark meshes as haze does. Albedo that
varies, and highlights, change it on some meshes, so the errors are those over meshes or over photographs, whichever are
larger; of a room that is one mesh, a scan, what faces the same way is taken for a mesh. A response curve that was not
taken back changes the slope, and light that was added everywhere (haze, a black offset) flattens it. The light is that
of the lamps, directly and by surfaces whose mean radiance, a mesh each, is the photographs' (inverse global
illumination, Yu et al. 1999): no material needs to be known. It is an estimate in two independent halves, each the
instrument of the other, since noise in it would flatten the slope, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.frame import faceforward
from neurad.core.groups import centred, group_sums
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array, IntArray, Surface, SurfaceInteraction
from neurad.core.reflection import PrincipledModel
from neurad.core.rng import Stream
from neurad.core.sampling import evenly
from neurad.core.scene_records import Camera
from neurad.evidence.photograph_pairs import Develop, brightness_of, matt, some_views
from neurad.evidence.shared_errors import Estimate
from neurad.integrators.bounce import bounce
from neurad.integrators.vertex import DIMENSIONS, Bounce
from neurad.integrators.world import World

POINTS, DIRECTIONS = 8192, 16
"""Photographed points, and directions from each and from as many points that light comes from."""
PIXELS = 1 << 16
"""Pixels of a view among which the darkest is looked for."""
SCAN = 0.9
"""Part of all points from which on one mesh is taken for a scan of a room."""
_BOUNCES = 12
_TURN = 0.15  # of the scene's size that a turn of a normal by a radian counts in the search for the nearest point
_DIM, _DARK = 0.02, 0.01  # of the median light and of the median brightness: what is below takes no part
_ALBEDO = 0.5  # of the surfaces that light is estimated for: it falls out


@dataclass(frozen=True)
class Transport:
    """How light travels between points of a scene, by one bounce each way."""

    direct: Float64Array
    """From lamps, by each direction [2 n, k, 3]: of the photographed points, then of others."""
    weight: Float64Array
    """Weight of the radiance that comes from another point [2 n, k, 3]."""
    source: IntArray
    """Which point that is [2 n, k]; -1 for none."""
    mesh: IntArray
    """Mesh of each point [2 n]; in a scan with the way that it faces."""
    view: IntArray
    """View of each photographed point [n]."""
    photographed: Float64Array
    """Their colours [n, 3]."""
    floor: float
    """The smallest brightness in any photograph over the mean of surfaces: no more can have been added everywhere."""
    escaping: float
    """Fraction of the directions from photographed points in which there is nothing."""
    coat: float = 0.0
    """Part of the light that a coat reflects, seen head on."""

    def slope(self, power: float = 1.0, offset: float = 0.0, coat: float = 0.0) -> Estimate:
        """By how much the logarithm of brightness rises with that of the light. The error is cluster-robust (Liang and
        Zeger 1986), over meshes or over views.

        Args:
            power: of the response curve that is taken back from the photographs first.
            offset: what is taken away from them before, in units of their mean.
            coat: part of their mean that all surfaces show besides, whatever light arrives.
        """
        shown = np.maximum(self.photographed - offset * self.photographed.mean(), 0.0) ** (1.0 / power)
        halves, own = self._light(shown), self.mesh[: len(self.view)]
        bright = shown.mean(1)
        good = (halves.min(0) > _DIM * np.median(halves)) & (bright > _DARK * np.median(bright))
        # What each would show if each mesh had one albedo, which makes it as bright as it is on average, below the coat
        _, group = np.unique(own, return_inverse=True)
        gloss = coat * bright.mean()
        paint = np.maximum(np.bincount(group, bright - gloss), 0.0) / np.bincount(group, halves.mean(0)).clip(1e-30)
        expected = halves * paint[group] + gloss
        y, first, second = (centred(np.log(x[good]), own[good]) for x in (bright, *expected))
        rise, run = y * (first + second) / 2.0, first * second
        if run.sum() <= 0.0:
            return Estimate(1.0, np.inf, 2)
        slope, found = float(rise.sum() / run.sum()), []
        for cluster in (self.view[good], own[good]):
            names, group = np.unique(cluster, return_inverse=True)
            scores, count = np.bincount(group, rise - slope * run), max(len(names), 2)
            found.append((float(np.sqrt(count / (count - 1) * (scores**2).sum()) / run.sum()), count))
        return Estimate(slope, *max(found))

    def _light(self, shown: Float64Array) -> Float64Array:
        """Light that arrives at the photographed points, by two halves of the directions [2, n]."""
        n, (_, group) = len(self.view), np.unique(self.mesh, return_inverse=True)
        weight = np.where((self.source >= 0)[..., None], self.weight, 0.0)
        direct, source = self.direct.mean(1), np.maximum(self.source, 0)
        usual, count = shown.mean(0), np.bincount(group[:n], minlength=group.max() + 1)[:, None]
        mean = np.where(count > 0, group_sums(shown, group[:n], len(count)) / np.maximum(count, 1), usual)
        radiance = mean[group]
        radiance[:n] = shown
        for _ in range(_BOUNCES):
            light = direct + (weight * radiance[source]).mean(1)
            arrives = group_sums(light[:n], group[:n], len(count)) / np.maximum(count, 1)
            rate = np.where(count > 0, mean / np.maximum(arrives, 1e-30), usual / np.maximum(light[:n].mean(0), 1e-30))
            radiance = np.minimum(rate, 1.0 / _ALBEDO)[group] * light
        each = (self.direct[:n] + weight[:n] * radiance[source[:n]]).mean(2)
        return np.stack([part.mean(1) for part in np.split(each, 2, axis=1)])


@torch.no_grad()
def transport(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, seed: int, develop: Develop | None = None
) -> Transport | None:
    """Trace one bounce from photographed points, corrected by what a fit has recovered of how photographs were taken,
    and from points where it ends; None where too few are photographed.
    """
    from scipy.spatial import cKDTree  # imported where it is needed: it loads slowly

    geometry, device = world.geometry, world.geometry.vertices.device
    chosen, left_out = some_views(len(cameras)), photographs.ignored()
    hits, view, color, low = [], [], [], []
    with world.tracer.uncounted():
        for index in chosen:
            camera, count = cameras[index], POINTS // len(chosen)
            pixel = Stream(seed, index, 51, device=device).integers(camera.width * camera.height, count)
            xy = torch.stack((pixel % camera.width, pixel // camera.width), -1) + 0.5
            si = world.intersect(camera_rays(camera, xy.float()))
            shown = brightness_of(photographs, develop, torch.full_like(pixel, index).cpu(), pixel.cpu(), left_out)
            good = matt(world, si).cpu() & ~shown.isnan().any(-1) & (shown.mean(-1) > 0)
            hits.append(si[good.to(device)])
            view.append(np.full(int(good.sum()), index))
            color.append(shown[good].numpy())
            size = camera.width * camera.height
            some = evenly(size, PIXELS)
            low.append(brightness_of(photographs, develop, torch.full_like(some, index), some, left_out).mean(-1))
        own, photographed = SurfaceInteraction.cat(*hits), np.concatenate(color)
        if len(own) < POINTS // 8:
            return None
        first = _bounce(world, own, seed, 52)
        ends = (matt(world, first.next)).nonzero().squeeze(-1)
        if len(ends) == 0:
            return None
        others = first.next[ends[Stream(seed, 54, device=device).integers(len(ends), len(own))]]
        second = _bounce(world, others, seed, 53)
    points = SurfaceInteraction.cat(own, others)
    tree = cKDTree(_places(points, geometry.scale))
    parts = []
    for made in (first, second):
        end = matt(world, made.next).cpu().numpy()
        source = np.full(len(end), -1)
        if end.any():
            source[end] = tree.query(_places(made.next, geometry.scale)[end])[1]
        direct, weight = (x.double().cpu().numpy().reshape(-1, DIRECTIONS, 3) for x in (made.direct, made.weight))
        parts.append((direct, weight, source.reshape(-1, DIRECTIONS)))
    direct, weight, source = (np.concatenate(pair) for pair in zip(*parts, strict=True))
    every = torch.cat(low).nan_to_num(math.inf).clamp_min(0.0)
    if photographs.has_alpha:  # where nothing is in front of the background, it is 0
        every = every[every > 0]
    floor = float(every.min()) / float(photographed.mean()) if len(every) else 0.0
    mesh = parts_of_scan(geometry.mesh_index[points.prim], points, len(own))
    went = first.weight.sum(-1) > 0  # a sample below its surface goes nowhere
    escaping = float((went & ~first.next.valid).sum()) / max(int(went.sum()), 1)
    model = world.features.fitted_model
    coat = ((model.eta - 1.0) / (model.eta + 1.0)) ** 2 if isinstance(model, PrincipledModel) else 0.0  # head on
    return Transport(
        direct, weight, source, mesh.cpu().numpy(), np.concatenate(view), photographed, floor, escaping, coat
    )  # fmt: skip


def parts_of_scan(number: Tensor, si: SurfaceInteraction, count: int) -> Tensor:
    """Numbers of the surfaces that points [n] are of, by ``number`` [n]: where nearly all of the first ``count`` have
    the same one, as in a scan of a room, what faces the same way has one.
    """
    if int(number[:count].bincount().max()) <= SCAN * count:
        return number
    axis = (facing := faceforward(si)).abs().argmax(-1, keepdim=True)
    return 6 * number + (2 * axis + (facing.gather(-1, axis) < 0)).squeeze(-1)


def _bounce(world: World, si: SurfaceInteraction, seed: int, key: int) -> Bounce:
    """One bounce in each of some directions from points."""
    si = si.repeat(DIRECTIONS)
    surface = Surface(torch.full_like(si.p, _ALBEDO), torch.ones_like(si.p[:, :1]))
    return bounce(world, si, surface, Stream(seed, key, device=si.p.device).uniform(len(si), DIMENSIONS), guided=False)


def _places(si: SurfaceInteraction, scale: float) -> Float64Array:
    """Positions and normals on the viewer's side, so that the nearest is a point on the same side of the same thing."""
    return torch.cat((si.p / scale, _TURN * faceforward(si)), -1).double().cpu().numpy()
