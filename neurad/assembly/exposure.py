"""How bright the photographs are, and whether they belong to these lights: a factor would end up in the materials."""

from __future__ import annotations

import sys
from typing import Any

import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.vertex import DIMENSIONS, bounce
from neurad.losses.firefly import typical_square

FAR = 50.0
"""Ratio from which on no material explains the photographs; a white closed room may be some tens of times brighter."""
_PIXELS = 4096


def mean_square_radiance(data: Any, emitter_mask: Tensor, firefly_clamp: float) -> tuple[float, PixelBatch | None]:
    """Mean squared radiance of the training photographs, without what shows an emitter.

    Args:
        data: the data module.
        emitter_mask: pixels that show an emitter [views, pixels], bool.
        firefly_clamp: with a positive one no value counts more than so many times a large one, see
            :func:`neurad.losses.firefly.typical_square`.

    Returns:
        The mean square, and random pixels of the photographs if these are streamed.

    Raises:
        InputError: every photograph is black.
    """
    if getattr(data, "streams", False):
        found = data.dataset_stats(emitter_mask.cpu())
        mean_square, sample = found.mean_square, found.sample
    else:
        mean_square, sample = data.mean_square(~emitter_mask.cpu()), None
    if mean_square <= 0:
        raise InputError(f"scene {data.scene.name}: every training photograph is black")
    if firefly_clamp > 0:  # a few fireflies must not set the unit of light
        values = data.photographs[~emitter_mask.cpu()] if sample is None else sample.color
        mean_square = typical_square(values, firefly_clamp) or mean_square
    return mean_square, sample


def random_pixels(photographs: Tensor, emitter_mask: Tensor, seed: int) -> PixelBatch:
    """Some of the pixels of photographs [views, pixels, 3] that show no emitter."""
    view, pixel = (~emitter_mask).nonzero().unbind(-1)
    index = Stream(seed, 17, device=emitter_mask.device).integers(len(view), _PIXELS)
    view, pixel = view[index], pixel[index]
    return PixelBatch(view, pixel, photographs.to(view.device)[view, pixel], torch.ones_like(view).float(), 0)


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
