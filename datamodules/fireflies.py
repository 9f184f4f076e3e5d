"""Fireflies in photographs: found by the pixels around them, and spread with all of their light kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

RATIO = 2.0
"""A firefly is more than so many times as bright as the fourth largest of its 24 neighbours."""
WORTH = 0.02
"""Fraction of all light from which fireflies are spread. Photographs of ordinary rooms have a tenth of that in
reflections of small lamps and the like, which are there indeed; they stay as they are."""
_HALF = 2
"""Half the side of the square of 5 x 5 pixels in which a firefly stands out."""
_RANK = 4
"""Rank by brightness among 24 neighbours, in proportion among fewer: a line one pixel wide has four others in the
square, and fewer at the border."""
_NEIGHBOURS = 12
"""Neighbours that a pixel needs to be compared at all."""
_SHARE = 0.1
"""Most that a firefly brightens the pixels which take its excess over, as a fraction of what they have."""
_MEASURED = 8
"""Photographs that are measured, evenly over all."""
_LOOKED_AT = 1 << 17
"""Pixels of each that are, whole rows of them."""
_BAND = 1 << 18
"""Pixels that are compared at a time."""


@dataclass(frozen=True)
class Fireflies:
    """What fireflies there are in the photographs that were measured."""

    count: int
    """Pixels."""
    light: float
    """Fraction of all light that is beyond what their neighbours explain."""

    @property
    def spread(self) -> bool:
        """Whether they are worth spreading."""
        return self.light > WORTH

    @classmethod
    def measure(cls, read: Callable[[int], Tensor], left_out: Sequence[Tensor], widths: Sequence[int]) -> Fireflies:
        """Look for fireflies in at most 8 photographs, in large ones in a band of rows, each time another.

        Args:
            read: reads the photograph of a view [h * w, 3 or 4].
            left_out: pixels that do not count, of each view [h * w], bool.
            widths: of the photographs in pixels.
        """
        views = len(left_out)
        count, excess, total = 0, 0.0, 0.0
        number = min(views, _MEASURED)
        for i in range(number):
            view = i * views // number
            pixels, width = read(view), widths[view]
            height = len(pixels) // width
            rows = min(height, max(1, _LOOKED_AT // width))
            first = (height - rows) * i // max(1, number - 1)
            band = slice(first * width, (first + rows) * width)
            lum, counts = _brightness(pixels[band], left_out[view][band], width)
            index, bound = _stand_out(lum, counts)
            count += len(index)
            excess += float((lum.view(-1)[index] - bound).sum(dtype=torch.float64))
            total += float(lum.sum(dtype=torch.float64))
        return cls(count, excess / total if total > 0 else 0.0)


def find_fireflies(
    read: Callable[[int], Tensor],
    left_out: Sequence[Tensor],
    widths: Sequence[int],
    beyond: Callable[[], Tensor] | None = None,
) -> tuple[Fireflies, Sequence[Tensor]]:
    """What fireflies there are, and the pixels that neither are any nor receive light of one [h * w] of each view.

    Args:
        read: as in :meth:`Fireflies.measure`, and so are ``widths`` and ``left_out``, which show emitters.
        beyond: finds pixels that may show small lights indeed [views, pixels], bool; asked where fireflies seem to be
            worth spreading, and left out as well.
    """
    found = Fireflies.measure(read, left_out, widths)
    if found.spread and beyond is not None:
        left_out = [mask | more[: len(mask)] for mask, more in zip(left_out, beyond(), strict=True)]
        found = Fireflies.measure(read, left_out, widths)
    return found, left_out


@torch.no_grad()
def spread_fireflies(pixels: Tensor, left_out: Tensor, width: int) -> Tensor:
    """A photograph whose fireflies are cut off and whose light is all there still.

    What a firefly has beyond :data:`RATIO` times its neighbours goes to the pixels of the smallest square around it
    that it brightens by a tenth at most, in proportion to their brightness: the sum of each channel stays, and textures
    and shadows keep their contrast. The sum decides what walls receive from each other; the spike itself only says that
    light came by a path too rare to be found in every pixel. Of a single pixel that outshines a tenth of the whole
    photograph only that tenth is kept.

    Args:
        pixels: linear colours, perhaps with alpha [h * w, 3 or 4].
        left_out: pixels that neither are fireflies nor receive any light [h * w], bool: those that show emitters.
        width: of the photograph in pixels.

    Returns:
        The photograph; ``pixels`` itself where nothing stands out.
    """
    lum, counts = _brightness(pixels, left_out, width)
    index, bound = _stand_out(lum, counts)
    if len(index) == 0:
        return pixels
    lum = lum.double()
    removed = torch.zeros(len(pixels), 3, dtype=torch.float64)
    removed[index] = pixels[index, :3] * (1.0 - bound / lum.view(-1)[index]).unsqueeze(-1)
    removed = removed.view(*lum.shape, 3)
    excess = removed.mean(-1)
    base = (lum - excess).clamp_min(0.0)  # [h, w]
    gain, waiting, half = torch.zeros_like(removed), excess > 0, _HALF
    while bool(waiting.any()):
        whole = half >= max(lum.shape)
        around = _box_sum(base.unsqueeze(-1), half).squeeze(-1)
        here = waiting & ((excess <= _SHARE * around) | whole)
        kept = (_SHARE * around / excess.clamp_min(1e-300)).clamp_max(1.0)  # below 1 in the whole photograph only
        gain += _box_sum(torch.where(here, kept / around, 0.0).unsqueeze(-1) * removed, half)
        waiting, half = waiting & ~here, 2 * half
    result = pixels.clone()
    result[:, :3] += (base.unsqueeze(-1) * gain - removed).view(-1, 3).to(pixels.dtype)
    return result


def _brightness(pixels: Tensor, left_out: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Mean over the channels [h, w], 0 where a pixel does not count, and whether it does [h, w]."""
    counts = ~left_out if pixels.shape[1] < 4 else ~left_out & (pixels[:, 3] > 0)
    lum = torch.where(counts, pixels[:, :3].mean(-1), 0.0)
    return lum.view(-1, width), counts.view(-1, width)


def _stand_out(lum: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Fireflies of a photograph of brightness ``lum`` [h, w] as flat indices [n], and the largest value of none [n]."""
    width, side = lum.shape[1], 2 * _HALF + 1
    lowest = -torch.nn.functional.max_pool2d(-torch.where(counts, lum, torch.inf)[None, None], side, 1, _HALF)[0, 0]
    candidates = (counts & (lum > RATIO * lowest)).view(-1).nonzero().squeeze(-1)
    padded = torch.nn.functional.pad(torch.where(counts, lum, -1.0), (_HALF,) * 4, value=-1.0).view(-1)
    steps, stride = torch.arange(-_HALF, _HALF + 1), width + 2 * _HALF
    around = (steps[:, None] * stride + steps).view(-1)
    around = around[around != 0]
    found, bounds = [candidates[:0]], [lum.new_empty(0)]
    for index in torch.split(candidates, _BAND):
        centre = (index // width + _HALF) * stride + index % width + _HALF
        others = padded[centre.unsqueeze(1) + around]  # [n, 24]
        count = (others >= 0).sum(1, keepdim=True)
        rank = (_RANK * count / others.shape[1]).round().long().clamp_min(1)
        bound = RATIO * others.topk(_RANK).values.gather(1, rank - 1).squeeze(1)
        good = (lum.view(-1)[index] > bound) & (count.squeeze(1) >= _NEIGHBOURS) & (bound > 0)
        found.append(index[good])
        bounds.append(bound[good])
    return torch.cat(found), torch.cat(bounds)


def _box_sum(values: Tensor, half: int) -> Tensor:
    """Sums over squares of ``2 half + 1`` pixels, as far as they lie in the picture [h, w, c]."""
    for dim in (0, 1):
        size = values.shape[dim]
        total = torch.nn.functional.pad(values.movedim(dim, -1).cumsum(-1), (1, 0))
        place = torch.arange(size)
        high, low = (place + half + 1).clamp_max(size), (place - half).clamp_min(0)
        values = (total[..., high] - total[..., low]).movedim(-1, dim)
    return values
