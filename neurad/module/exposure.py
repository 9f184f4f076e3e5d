"""Do the photographs belong to these lights? A factor between them would end up in the materials."""

from __future__ import annotations

import sys

import torch
from torch import Tensor

from neurad.core.records import PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.integrators.vertex import DIMENSIONS, bounce
from neurad.module.primary import PrimaryHits

FAR = 50.0
"""Ratio from which on no material explains the photographs; a white closed room may be some tens of times brighter."""
_PIXELS = 4096


@torch.no_grad()
def brightness(primary: PrimaryHits, photographs: Tensor, mixed: Tensor, seed: int) -> float:
    """How many times as bright as expected the photographs are.

    Expected is what the lights give surfaces of albedo 0.5 directly, times 2 for the light that bounces on.

    Args:
        primary: camera rays of the training views.
        photographs: linear colours [views, pixels, 3].
        mixed: pixels that show an emitter [views, pixels], bool.
        seed: of the sample of pixels.
    """
    world = primary.world
    stream = Stream(seed, 17, device=mixed.device)
    view, pixel = (~mixed).nonzero().unbind(-1)
    index = stream.integers(len(view), _PIXELS)
    view, pixel = view[index], pixel[index]
    color = photographs.to(view.device)[view, pixel]
    cast = world.rays_cast
    it = primary(PixelBatch(view, pixel, color, torch.ones(_PIXELS, device=view.device), 0), 1, stream).it
    half = Surface(torch.full_like(it.p, 0.5), torch.ones_like(it.p[:, :1]))
    direct = bounce(world, it, half, stream.uniform(len(it), DIMENSIONS)).direct
    world.rays_cast = cast
    expected = 2.0 * float(direct[it.valid].mean()) if bool(it.valid.any()) else 0.0
    return float(color[it.valid].mean()) / expected if expected > 0 else 1.0


def warn_if_far(factor: float) -> None:
    """One warning if the photographs are out of reach of the lights."""
    if not 1.0 / FAR < factor < FAR:
        words = f"{factor:.3g} times as bright"
        print(
            f"neurad: warning: the photographs are about {words} as the scene's lights make it; "
            "materials cannot explain that, so scale the lights or the photographs",
            file=sys.stderr,
        )
