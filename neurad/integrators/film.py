"""Pictures: camera rays through every pixel, averaged over a box filter."""

import math

import torch
from torch import Tensor

from neurad.core.camera import camera_rays
from neurad.core.protocols import Integrator
from neurad.core.rng import Stream, mix
from neurad.core.scene_records import Camera
from neurad.runtime.progress import partly

CHUNK = 1 << 16
"""Camera rays in flight: bounds the memory, and intermediate results stay in the processor's cache."""


def pixel_positions(width: int | Tensor, pixels: Tensor, spp: int, stream: Stream) -> Tensor:
    """Stratified positions, ``spp`` for each of the row-major ``pixels`` [n]: film coordinates [n, spp, 2].

    The pixel is cut into a grid of about ``spp`` cells; what a square grid leaves over is uniform. The ``width`` of the
    film is one of all pixels or of each [n].
    """
    side = math.isqrt(spp)
    jitter = stream.uniform(len(pixels), spp, 2)
    cell = torch.arange(side * side, device=pixels.device)
    offset = torch.stack((cell % side, cell // side), -1).to(jitter.dtype)
    jitter[:, : side * side] = (jitter[:, : side * side] + offset) / side
    corner = torch.stack((pixels % width, pixels // width), -1).to(jitter.dtype)
    return corner.unsqueeze(1) + jitter


def strided(width: int, index: Tensor, stride: int) -> Tensor:
    """Row-major pixels of a film ``width`` pixels wide, from their numbers among every ``stride``-th row and column."""
    if stride == 1:
        return index
    columns = -(-width // stride)
    return (index // columns * width + index % columns) * stride


def box_mean(image: Tensor, size: int) -> Tensor:
    """Means over ``size`` x ``size`` pixels around each [h, w, c], of those that the picture has; ``size`` is odd."""
    picture = image.permute(2, 0, 1).unsqueeze(0)
    mean = torch.nn.functional.avg_pool2d(picture, size, 1, size // 2, count_include_pad=False)
    return mean[0].permute(1, 2, 0)


def render(
    camera: Camera,
    integrator: Integrator,
    spp: int,
    seed: int,
    device: torch.device | str = "cpu",
    chunk: int = CHUNK,
    stride: int = 1,
) -> Tensor:
    """The mean of ``spp`` samples in every pixel [h, w, c] (paper Eq. 2), or in those of every ``stride``-th row and
    column.

    The result depends on ``seed`` and ``spp`` and not on the chunk of any other view.
    """
    height, width = -(-camera.height // stride), -(-camera.width // stride)
    count = width * height
    batch = max(1, min(spp, chunk // 1024))
    rows = max(1, chunk // batch)
    image: Tensor | None = None
    for done in range(0, spp, batch):
        n = min(batch, spp - done)
        parts = []
        for begin in range(0, count, rows):
            pixels = strided(camera.width, torch.arange(begin, min(begin + rows, count), device=device), stride)
            stream = Stream(seed, done, begin, device=device)
            xy = pixel_positions(camera.width, pixels, n, stream)
            rays = camera_rays(camera, xy.reshape(-1, 2))
            values = integrator(rays, mix(seed, done, begin, 1))
            parts.append(values.view(len(pixels), n, -1).sum(1))
            partly((done + n * min(begin + rows, count) / count) / spp)
        total = torch.cat(parts)
        image = total if image is None else image + total
    assert image is not None
    return (image / spp).view(height, width, -1)
