"""How bright photographs are beside a picture of the scene with its own lights and materials."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.protocols import Materials
from neurad.core.records import Camera, FloatArray, PixelBatch
from neurad.core.rng import Stream, mix
from neurad.integrators.film import pixel_positions
from neurad.integrators.method import SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import MethodRenderer
from neurad.integrators.world import World

SPP = 4
"""Samples in each pixel; it is the mean over pixels that counts."""
_DEPTH, _RR_DEPTH = 12, 4
_GROUPS = 15
"""Parts that the pixels of a view are split into: the median of their means leaves fireflies out."""


@torch.no_grad()
def rendered(world: World, materials: Materials, cameras: Sequence[Camera], pixels: PixelBatch, seed: int) -> Tensor:
    """What the scene's lights and materials give in some pixels, without what surfaces emit [n, 3]; noisy."""
    device = world.geometry.vertices.device
    tracer = MethodRenderer(PathTracing(_DEPTH, _RR_DEPTH), SceneModel(world, materials))
    found = torch.zeros(len(pixels.view), 3, device=device)
    with world.tracer.uncounted():
        for index in sorted(set(pixels.view.tolist())):
            lanes = (pixels.view == index).nonzero().squeeze(-1).to(device)
            stream = Stream(seed, index, 33, device=device)
            xy = pixel_positions(cameras[index].width, pixels.pixel.to(device)[lanes], SPP, stream)
            rays = camera_rays(cameras[index], xy.view(-1, 2))
            found[lanes] = tracer(rays, mix(seed, index, 34)).view(-1, SPP, 3).mean(1)
    return found.cpu()


def exposure_ratios(photographed: Tensor, expected: Tensor, view: Tensor, views: int) -> FloatArray:
    """Photographed over expected brightness of each view [views], by random pixels [n, 3] of views ``view`` [n]; NaN
    where there are too few pixels or no light.
    """
    ratios = np.full(views, np.nan, np.float32)
    a, b = (x.double().mean(-1).numpy() for x in (photographed, expected))
    for index in range(views):
        mine = np.flatnonzero(view.numpy() == index)
        if len(mine) >= 4 * _GROUPS:
            parts = np.array_split(mine, _GROUPS)
            shown, given = (float(np.median([x[part].mean() for part in parts])) for x in (a, b))
            if shown > 0.0 and given > 0.0:
                ratios[index] = shown / given
    return ratios
