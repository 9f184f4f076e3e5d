"""Which pixels a training step looks at: pure functions of the counter (seed, iteration, rank)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.rng import Stream

_DRAW = 0  # last number of the stream's key; the training step has streams of its own


_REACH = 2  # pixels on each side of one that its neighbourhood has


@dataclass(frozen=True)
class Corners:
    """Where patches may begin: all upper left corners, or a list of them for every view.

    Attributes:
        views: views to draw from [m], int64.
        begin: where each view's part of ``corner`` begins [m], int64; None if all corners may be drawn.
        count: length of each view's part [m], int64; None if all corners may be drawn.
        corner: row-major pixel index of the corners, view after view, int64; None if all may be drawn.
    """

    views: Tensor
    begin: Tensor | None = None
    count: Tensor | None = None
    corner: Tensor | None = None


def corners(views: int, patch_size: int, alpha: Tensor | None, width: int, height: int) -> Corners:
    """The corners to draw from.

    Without alpha every patch inside the image may be drawn. With alpha only those of which at least half is foreground
    (alpha > 0), so that at least half of any batch is; in a view that has none, those with the most foreground. Views
    without any foreground are left out: their pixels say nothing about surfaces.

    Args:
        views: number of training views.
        patch_size: side of a patch in pixels, at most the image's.
        alpha: coverage [views, height * width], or None.
        width: of the images.
        height: of the images.
    """
    if alpha is None:
        return Corners(torch.arange(views))
    column = torch.arange(width - patch_size + 1)
    row = torch.arange(height - patch_size + 1)
    index = (row[:, None] * width + column).flatten()
    chosen, parts = [], []
    for view in range(views):
        covered = (alpha[view] > 0).view(1, height, width).float()
        share = torch.nn.functional.avg_pool2d(covered, patch_size, 1).flatten()
        best = float(share.max())
        if best > 0:
            chosen.append(view)
            parts.append(index[share >= min(0.5, best) - 1e-6])
    if not chosen:
        return Corners(torch.arange(views))
    count = torch.tensor([len(part) for part in parts])
    return Corners(torch.tensor(chosen), count.cumsum(0) - count, count, torch.cat(parts))


def draw(
    where: Corners, iteration: int, seed: int, rank: int, patches: int, patch_size: int, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """The pixels of one batch: ``patches`` squares, each of a random view.

    Returns:
        View and row-major pixel index, patch by patch [patches * patch_size^2], int64.
    """
    stream = Stream(seed, iteration, rank, _DRAW)
    u = torch.rand(3, patches, generator=stream.generator, dtype=torch.float64)
    slot = (u[0] * len(where.views)).long()
    view = where.views[slot]
    if where.corner is None or where.begin is None or where.count is None:
        x = (u[1] * (width - patch_size + 1)).long()
        y = (u[2] * (height - patch_size + 1)).long()
        corner = y * width + x
    else:
        corner = where.corner[where.begin[slot] + (u[1] * where.count[slot]).long()]
    if patch_size == 1:
        return view, corner
    step = torch.arange(patch_size)
    offset = (step[:, None] * width + step).flatten()
    return view.repeat_interleave(len(offset)), (corner[:, None] + offset).flatten()


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
