"""Where the gains of photographs begin: what surfaces that several photographs show say, before anything is known of
materials or light.
"""

from dataclasses import replace

import torch
from torch import Tensor

from neurad.core.camera import project, to_camera
from neurad.core.protocols import PhotoSource
from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.fields.development import FittedDevelopment
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.scene.description import Scene

PIXELS = 1 << 14
"""Pixels of all photographs whose surface points are looked for in the others."""
MIN_SHARED_POINTS = 8
"""Points that two photographs must share for their ratio to count."""
_MAX_POINTS = 400.0  # points from which on a ratio is limited by highlights, not by noise
_ROUNDS = 20
_PRIOR_WEIGHT = 1e-3  # weight that keeps photographs which share nothing with others at 0
_SAMPLE = 1 << 16  # pixels among which they are drawn
_STREAM = 37  # last number of the stream's key


@torch.no_grad()
def shared_gains(
    primary: PrimaryHits, photographs: PhotoSource, sample: PixelBatch, emitter_mask: Tensor, seed: int
) -> Tensor:
    """Logarithms of the photographs' gains by the surface points that they share [views, 3], of mean 0.

    A matt surface has one radiance from wherever it is seen, so the median over the points that two photographs share
    of the logarithms' difference is that of their gains. All pairs together are a least absolute deviations problem.
    Under a light that moves with the camera they say nothing.

    Args:
        photographs: of the training views, known exposures divided out.
        sample: random photographed pixels that show no emitter.
        emitter_mask: pixels that take no part [views, pixels], bool.
    """
    views = len(primary.cameras)
    if primary.world.flash is not None:
        return torch.zeros(views, 3)
    a, b, difference, weight = _pairs(primary, photographs, sample, emitter_mask, seed)
    found = torch.zeros(views, 3, dtype=torch.float64)
    if len(a) == 0:
        return found.float()
    for channel in range(3):
        target, w = difference[:, channel], weight.clone()
        for _ in range(_ROUNDS):  # iteratively reweighted
            matrix = _PRIOR_WEIGHT * torch.eye(views, dtype=torch.float64)
            right = torch.zeros(views, dtype=torch.float64)
            for row, column, sign in ((a, a, 1.0), (b, b, 1.0), (a, b, -1.0), (b, a, -1.0)):
                matrix.index_put_((row, column), sign * w, accumulate=True)
            right.index_add_(0, a, w * target).index_add_(0, b, -w * target)
            solution = torch.linalg.solve(matrix, right)
            w = weight / (solution[a] - solution[b] - target).abs().clamp_min(0.01)
        found[:, channel] = solution - solution.mean()
    return found.float()


@torch.no_grad()
def shared_development(scene: Scene, world: World, photographs: PhotoSource, seed: int) -> FittedDevelopment | None:
    """Photographs developed as far as the surface points that they share say, before anything else is known; None where
    their exposures and colours are known.

    Args:
        world: of the scene, under any light.
    """
    development = FittedDevelopment.of(scene.train, scene.photography)
    if development is None or development.values is None:
        return None
    device, cameras = world.geometry.vertices.device, [view.camera for view in scene.train]
    primary = PrimaryHits(world, cameras, 0, seed, device)
    counts, left_out = torch.tensor([camera.width * camera.height for camera in cameras]), primary.nothing().cpu()
    if (ignored := photographs.ignored()) is not None:
        left_out |= ignored.cpu()
    stream = Stream(seed, 1, _STREAM)
    view = stream.integers(len(cameras), _SAMPLE)
    pixel = (stream.uniform(_SAMPLE) * counts[view]).long().minimum(counts[view] - 1)
    good = ~left_out[view, pixel]
    view, pixel = view[good], pixel[good]
    color, clipped = photographs.colors(view, pixel), photographs.clipped(view, pixel)
    sample = replace(PixelBatch(view, pixel, color, torch.ones(len(view)), 0), clipped=clipped)
    development.begin(shared_gains(primary, photographs, sample, left_out, seed))
    return development.to(device)


def _pairs(
    primary: PrimaryHits, photographs: PhotoSource, sample: PixelBatch, emitter_mask: Tensor, seed: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pairs of photographs that share points: both views [m], the median difference of the logarithms of their colours
    [m, 3], and its weight [m]; on the CPU.
    """
    world, device = primary.world, primary.origin.device
    chosen = Stream(seed, _STREAM).integers(len(sample.view), PIXELS)
    if sample.clipped is not None:
        chosen = chosen[~sample.clipped[chosen].any(-1)]
    mine = sample[chosen].to(device)
    with world.tracer.uncounted():
        si = primary(mine, 1, Stream(seed, 0, _STREAM, device=device)).si
        seen = SeenBy(world.geometry, world.tracer, primary.cameras)
        view, color = mine.view.cpu(), mine.color.cpu()
        rows: list[tuple[int, int, Tensor, float]] = []
        for other, camera in enumerate(primary.cameras):
            lanes, _ = seen.by(other, si)
            lanes = lanes[mine.view[lanes] != other]
            xy = project(camera, to_camera(camera, si.p[lanes])).floor().long()
            xy = torch.minimum(xy.clamp_min(0), xy.new_tensor([camera.width - 1, camera.height - 1]))
            pixel = xy[:, 1] * camera.width + xy[:, 0]
            free = ~emitter_mask[other, pixel.to(emitter_mask.device)].to(device)
            lanes, pixel = lanes[free].cpu(), pixel[free].cpu()
            there = torch.full_like(pixel, other)
            theirs, clipped = photographs.colors(there, pixel), photographs.clipped(there, pixel)
            good = (theirs > 0).all(-1) & (color[lanes] > 0).all(-1)
            good &= True if clipped is None else ~clipped.any(-1)
            ratio = color[lanes[good]].double().log() - theirs[good].double().log()
            for first in sorted(set(view[lanes[good]].tolist())):
                part = ratio[view[lanes[good]] == first]
                if len(part) >= MIN_SHARED_POINTS:
                    rows.append((first, other, part.median(0).values, min(float(len(part)), _MAX_POINTS) ** 0.5))
    a, b = (torch.tensor([row[i] for row in rows], dtype=torch.int64) for i in (0, 1))
    difference = torch.stack([row[2] for row in rows]) if rows else torch.zeros(0, 3, dtype=torch.float64)
    return a, b, difference, torch.tensor([row[3] for row in rows], dtype=torch.float64)
