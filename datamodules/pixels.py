"""How many pixels a batch has, and what is around them."""

from __future__ import annotations

import torch
from torch import Tensor

_REACH = 2  # pixels on each side of one that its neighbourhood has

VISITS = 3
"""Times that each patch is drawn at the greatest pixel_multiplier; at half of it twice as often, and so on."""


def breadth_at(iteration: int, patches: int, pixel_multiplier: int, total: int) -> tuple[int, int]:
    """How much broader than usual a batch is, and how many patches those before it had.

    Args:
        iteration: of the batch.
        patches: of a usual batch.
        pixel_multiplier: times that number in the first batches, a power of two.
        total: patches that there are.
    """
    first, now, visits = 0, pixel_multiplier, VISITS
    while now > 1:
        steps = -(-visits * total // (now * patches))
        if iteration < steps:
            break
        first, iteration = first + steps * now * patches, iteration - steps
        now, visits = now // 2, 2 * visits
    return now, first + iteration * now * patches


def neighbourhood(images: Tensor, image: Tensor, pixel: Tensor, width: int) -> Tensor:
    """Mean over the 5 x 5 pixels around some, as far as they lie in the image; with alpha over what is covered.

    Args:
        images: premultiplied colours [n, h * w, 3], with alpha [n, h * w, 4].
        image: which of the images [b], int64.
        pixel: row-major index in it [b], int64.
        width: of the images in pixels.

    Returns:
        Premultiplied colours [b, 3].
    """
    pixels, channels = images.shape[1:]
    step = torch.arange(-_REACH, _REACH + 1)
    x = (pixel % width).unsqueeze(1) + step.repeat(len(step))
    y = (pixel // width).unsqueeze(1) + step.repeat_interleave(len(step))
    inside = ((x >= 0) & (x < width) & (y >= 0) & (y < pixels // width)).unsqueeze(-1)
    index = torch.where(inside.squeeze(-1), y * width + x, pixel.unsqueeze(1)) + image.unsqueeze(1) * pixels
    values = images.view(-1, channels)[index]
    mean = (values * inside).sum(1) / inside.sum(1)
    if channels < 4:
        return mean
    own = images.view(-1, channels)[image * pixels + pixel, 3:]
    return mean[:, :3] / mean[:, 3:].clamp_min(1e-6) * own
