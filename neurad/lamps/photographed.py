"""Lamps as photographs show them: how bright they are, beside what the scene says."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import Cameras
from neurad.core.protocols import Materials, PhotoSource
from neurad.core.records import BoolArray, Float64Array, IntArray, Lanes, PixelBatch
from neurad.core.rng import Stream, mix
from neurad.core.sampling import evenly
from neurad.core.scene_records import Camera
from neurad.integrators.emitter_pixels import POSITIONS, shown_in
from neurad.integrators.film import pixel_positions
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import MethodRenderer
from neurad.integrators.world import World
from neurad.lamps.scores import MIN_CHANNEL
from neurad.lamps.surfaces import showing_one_side
from neurad.scene.description import Scene

WARN, REFUSE = 1.2, 3.0
"""Factors between the photographed and the declared radiance, in either direction."""
MIN_PIXELS = 8
"""Pixels below which a lamp is not known well enough to refuse a fit."""
CEILINGS = (1.0, 65504.0)
"""Largest values of formats: of pictures that were 8-bit once, and of half floats."""
_MAX_PIXELS = 4096  # pixels of a view that are looked at
_LIT, _LIT_SPP = 64, 16  # pixels of a lamp and samples in each that say how much it reflects
_DEPTH = 6  # of their paths: what a lamp reflects is a few per cent of what it sends
_CHUNK = 1 << 14


@dataclass(frozen=True)
class PhotographedLamp:
    """One lamp mesh in the training photographs."""

    mesh: int
    """Index into ``Scene.meshes``."""
    name: str
    declared: Float64Array
    """Radiance that the scene says [3]."""
    reflected: Float64Array
    """What the lamp reflects of all declared light besides [3], roughly: the room counts as what it is so far."""
    photographed: Float64Array
    """Median of the pixels that show nothing else, where they are not clipped, a channel [3]; NaN where all are."""
    pixels: int
    """Pixels that show nothing but the lamp."""
    views: int
    """Views that these are of."""
    clipped: int
    """How many of the pixels do not count: those at their photograph's ceiling in some channel, and all of a photograph
    where half of them or more are."""

    @property
    def factor(self) -> Float64Array:
        """Photographed over declared radiance [3], both with what the lamp reflects: light that is too bright by a
        factor is reflected as much too brightly.
        """
        expected = self.declared + self.reflected
        dark = np.where(self.photographed > 0.0, math.inf, 1.0)
        return np.where(expected > 0.0, self.photographed / np.where(expected > 0.0, expected, 1.0), dark)

    @property
    def radiance(self) -> Float64Array:
        """What the photographs say that the lamp sends [3], without what it reflects."""
        factor = self.factor
        return np.where(
            self.declared > 0.0, self.declared * factor, np.maximum(self.photographed - self.reflected, 0.0)
        )

    @property
    def compared(self) -> Float64Array:
        """:attr:`factor` in those channels that tell [3], NaN in others: where a lamp of one colour sends next to
        nothing, what it reflects decides, and that is a guess.
        """
        both = np.fmax(self.declared, self.photographed)
        return np.where(both >= MIN_CHANNEL * both.max(), self.factor, math.nan)

    def beyond(self, limit: float) -> bool:
        """Whether a channel differs by more than a factor, in either direction; False where nothing is known."""
        known = self.compared[~np.isnan(self.compared)]
        return bool(((known > limit) | (known < 1.0 / limit)).any())


@dataclass(frozen=True)
class LampPixels(Lanes):
    """Pixels that show one lamp and nothing else."""

    view: Tensor
    """[n], int64."""
    pixel: Tensor
    """Row-major pixel index [n], int64."""
    mesh: Tensor
    """Index of the lamp's mesh [n], int64."""


@torch.no_grad()
def lamp_pixels(world: World, cameras: Sequence[Camera], seed: int, ignored: Tensor | None = None) -> LampPixels:
    """Pixels in which every one of some rays first meets the shining side of one and the same lamp.

    Of a view at most some thousand pixels are looked at closely, or as many of each lamp, evenly over those that show
    it.

    Pixels that a mask leaves out [views, pixels], bool, are ``ignored``.
    """
    geometry = world.geometry
    device = geometry.vertices.device
    emits = geometry.emission.amax(-1) > 0
    triangles = geometry.vertices[geometry.faces[emits]].double()
    none = torch.zeros(0, dtype=torch.int64, device=device)
    found = [LampPixels(none, none, none)]
    for index, camera in enumerate(cameras):
        candidates = shown_in(triangles, camera, geometry.scale)
        if ignored is not None:
            candidates &= ~ignored[index, : len(candidates)].to(device)
        pixels = candidates.nonzero().squeeze(-1)
        if len(pixels) > _MAX_PIXELS:  # of each lamp, else a small one beside a window would hardly be looked at
            middles = _lamps_shown(world, emits, camera, pixels, 1, Stream(seed, index, 33, device=device))
            of_lamp = [pixels[middles == lamp] for lamp in torch.unique(middles[middles >= 0])]
            some = [own[evenly(len(own), _MAX_PIXELS, device)] for own in of_lamp]
            pixels = torch.cat([pixels[:0], *some]).sort().values
        lamp = _lamps_shown(world, emits, camera, pixels, POSITIONS, Stream(seed, index, 29, device=device))
        pixels, lamp = pixels[lamp >= 0], lamp[lamp >= 0]
        found.append(LampPixels(torch.full_like(pixels, index), pixels, lamp))
    return LampPixels.cat(*found)


def _lamps_shown(world: World, emits: Tensor, camera: Camera, pixels: Tensor, positions: int, stream: Stream) -> Tensor:
    """The meshes whose shining side row-major pixels [n] show alone at so many positions in each [n], -1 for none."""
    found = torch.full_like(pixels, -1)
    for part, lamp in zip(torch.split(pixels, _CHUNK), torch.split(found, _CHUNK), strict=True):
        whole, side, prims, _ = showing_one_side(world, camera, part, positions, stream)
        lamp[whole] = torch.where((side % 2 == 0) & emits[prims].all(-1), side // 2, -1)
    return found


def saturated(view: Tensor, of: Tensor, clipped: Tensor) -> Tensor:
    """Whether half of the pixels or more that show the same thing, 0 or more, in the same view are clipped [n], bool.

    Their median is beyond the ceiling. Those that are not clipped are its border, seldom the thing itself.
    """
    if len(view) == 0:
        return clipped
    _, group = torch.unique(view * (int(of.max()) + 1) + of, return_inverse=True)
    count, full = torch.bincount(group), torch.bincount(group, clipped.double())
    return (2.0 * full >= count)[group]


@dataclass(frozen=True)
class LampPhotographs:
    """What photographs show of lamps alone."""

    at: LampPixels
    color: Float64Array
    """Photographed there [n, 3]."""
    clipped: BoolArray
    """Which values do not count [n, 3]: those at the ceiling, and all of a lamp in a view where half are."""

    def developed(self, develop: Callable[[PixelBatch], PixelBatch] | None) -> LampPhotographs:
        """What photographs show of lamps once these are corrected by ``develop``; None leaves them as they are."""
        if develop is None or len(self.color) == 0:
            return self
        view, pixel = self.at.view.cpu(), self.at.pixel.cpu()
        batch = PixelBatch(view, pixel, torch.from_numpy(self.color).float(), torch.ones(len(view)), 0)
        return replace(self, color=develop(batch).color.double().cpu().numpy())

    def radiance(self, mesh: int) -> Float64Array:
        """Median of the pixels of a mesh in the views where it is not clipped [3]; NaN where there are none.

        The few that are clipped there count: they are above the median, whatever they would be without a ceiling.
        """
        mine, view = self.at.mesh.cpu().numpy() == mesh, self.at.view.cpu().numpy()
        mine &= np.isin(view, view[mine & ~self.clipped.any(1)])
        return np.median(self.color[mine], axis=0) if mine.any() else np.full(3, math.nan)


@torch.no_grad()
def lamp_photographs(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, sample: PixelBatch, seed: int
) -> LampPhotographs:
    """Read the pixels of photographs that show one lamp and nothing else.

    Args:
        sample: random pixels of the photographs that show no lamp: where they reach the largest value of a photograph,
            too, that is its ceiling, unless it is known.
    """
    with world.tracer.uncounted():
        shown = lamp_pixels(world, cameras, seed, photographs.ignored())
    color, known, view = np.zeros((0, 3)), None, shown.view.cpu()
    if len(view):
        color = photographs.colors(view, shown.pixel.cpu()).double().numpy()
        known = photographs.clipped(view, shown.pixel.cpu())
    clipped = _clipped(color, view.numpy(), sample) if known is None else known.numpy()  # [n, 3]
    blown = saturated(view, shown.mesh.cpu(), torch.from_numpy(clipped).any(1))
    return LampPhotographs(shown, color, clipped | blown.numpy()[:, None])


@torch.no_grad()
def photographed_lamps(
    scene: Scene, world: World, materials: Materials, cameras: Sequence[Camera], shown: LampPhotographs, seed: int
) -> list[PhotographedLamp]:
    """Every lamp of a scene as its photographs show it; those that no pixel shows alone have 0 pixels. The materials,
    as far as they are known, decide what lamps reflect, a small part.
    """
    view, mesh = shown.at.view.cpu().numpy(), shown.at.mesh.cpu().numpy()
    lamps = []
    for index, part in enumerate(scene.meshes):
        if part.radiance is None or not part.radiance.any():
            continue
        mine = mesh == index
        lit = reflected_by_lamp(world, materials, cameras, shown.at, index, mix(seed, index))
        declared, views = np.asarray(part.radiance, np.float64), len(np.unique(view[mine]))
        count, full = int(mine.sum()), int(shown.clipped[mine].any(1).sum())
        lamps.append(PhotographedLamp(index, part.name, declared, lit, shown.radiance(index), count, views, full))
    return lamps


def _clipped(color: Float64Array, view: IntArray, sample: PixelBatch) -> BoolArray:
    """Which values [n, 3] of lamps are at the ceiling of their photograph.

    A ceiling is the largest value of a photograph that surfaces reach, too, in two places or more, or the largest that
    its format has. A lamp that alone is the brightest thing is not clipped: it may be of one brightness.
    """
    result = np.zeros(color.shape, np.bool_)
    others, other_view = sample.color.cpu().numpy().astype(np.float64), sample.view.cpu().numpy()
    for index in np.unique(view):
        mine = view == index
        around = others[other_view == index]
        top = max(float(color[mine].max()), float(around.max(initial=0.0)))
        if top in CEILINGS or int((around >= top).sum()) >= 2:
            result[mine] = color[mine] >= top
    return result


@torch.no_grad()
def reflected_by_lamp(
    world: World, materials: Materials, cameras: Sequence[Camera], at: LampPixels, mesh: int, seed: int
) -> Float64Array:
    """What a lamp reflects towards the cameras of some of its pixels, on average [3]; 0 where no pixel shows it."""
    of_lamp = at[at.mesh == mesh]
    if len(of_lamp) == 0:
        return np.zeros(3)
    device = of_lamp.view.device
    some = of_lamp[evenly(len(of_lamp), _LIT, device)]
    views = Cameras.of(list(cameras), device)
    xy = pixel_positions(views.width[some.view], some.pixel, _LIT_SPP, Stream(seed, 30, device=device)).view(-1, 2)
    rays = views.rays(some.view.repeat_interleave(_LIT_SPP), xy)
    tracer = MethodRenderer(PathTracing(_DEPTH, _DEPTH), SceneModel(world, materials))
    with world.tracer.uncounted():
        shown = tracer(rays, mix(seed, 31)) - world.emitted(world.intersect(rays))
    return shown.double().mean(0).clamp_min(0.0).cpu().numpy()
