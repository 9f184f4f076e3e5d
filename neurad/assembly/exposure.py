"""How bright the photographs are, and whether they belong to these lights: a factor would end up in the materials."""

from __future__ import annotations

import sys

import torch

from neurad.core.records import DatasetStats, PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.integrators.bounce import bounce
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.vertex import DIMENSIONS
from neurad.losses.firefly import typical_square

FAR = 50.0
"""Ratio from which on no material explains the photographs; a white closed room may be some tens of times brighter."""
_PIXELS = 4096


def mean_square_radiance(stats: DatasetStats, firefly_clamp: float) -> float:
    """Mean squared radiance of the photographs, the square of the unit of radiance.

    Args:
        stats: of the pixels that show no emitter.
        firefly_clamp: with a positive one no value counts more than so many times a large one, see
            :func:`neurad.losses.firefly.typical_square`: a few fireflies must not set the unit.
    """
    if firefly_clamp > 0 and stats.mean_square_radiance > 0:
        return typical_square(stats.sample.color, firefly_clamp) or stats.mean_square_radiance
    return stats.mean_square_radiance


@torch.no_grad()
def brightness(primary: PrimaryHits, sample: PixelBatch, seed: int) -> float:
    """How many times as bright as expected the photographs are.

    Expected is what the lights give surfaces of albedo 0.5 directly, times 2 for the light that bounces on.

    Args:
        primary: camera rays of the training views.
        sample: random photographed pixels that show no emitter; of more than 4096 some are drawn.
        seed: of the draws.
    """
    world, device = primary.world, primary.origin.device
    stream = Stream(seed, 18, device=device)
    view, pixel, color = (x.to(device) for x in (sample.view, sample.pixel, sample.color))
    if len(view) > _PIXELS:
        index = stream.integers(len(view), _PIXELS)
        view, pixel, color = view[index], pixel[index], color[index]
    with world.tracer.uncounted():
        si = primary(PixelBatch(view, pixel, color, torch.ones_like(view).float(), 0), 1, stream).si
        half = Surface(torch.full_like(si.p, 0.5), torch.ones_like(si.p[:, :1]))
        direct = bounce(world, si, half, stream.uniform(len(si), DIMENSIONS)).direct
    expected = 2.0 * float(direct[si.valid].mean()) if bool(si.valid.any()) else 0.0
    return float(color[si.valid].mean()) / expected if expected > 0 else 1.0


def warn_if_far(factor: float) -> None:
    """One warning if the photographs are out of reach of the lights."""
    if not 1.0 / FAR < factor < FAR:
        words = f"{factor:.3g} times as bright"
        print(
            f"neurad: warning: the photographs are about {words} as the scene's lights make it; "
            "materials cannot explain that, so scale the lights or the photographs",
            file=sys.stderr,
        )
