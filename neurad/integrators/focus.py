"""Pixels are drawn more often where they tell more of roughness.

Most of what photographs tell of roughness lies in few pixels, those of highlights, and so does most of the noise of its
gradient. The variance of a mean is least where samples are drawn in proportion to the root of their mean square. Here
blocks of pixels keep how large the gradients by roughness of their pixels have been; a fraction of a batch is drawn by
it, the others without replacement, and weights after the balance heuristic (Veach and Guibas 1995) keep every mean.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from neurad.core.records import PixelBatch
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera

TIMES = 24
"""Candidates for each pixel that is drawn by its score."""
SIDE = 8
"""Smallest side of a block in pixels."""
MAX_BLOCKS = 1 << 18
"""Blocks at most."""
REFRESH = 64
"""Iterations between two updates of the scores."""
DECAY = 0.9
"""Fraction of the sums that an update keeps: gradients change while materials are found."""
FAMILIAR = 1.0
"""Pixels' worth of the mean of all blocks in each."""

USUAL = 3.0
"""Score, over the mean of all blocks, at which a pixel's samples follow the specular lobe half as far as they can."""


class PixelImportance(nn.Module):
    """Scores of blocks of pixels. All of it is state: a continued run has the same.

    Args:
        fraction: of a batch's pixels that is drawn by score.
    """

    width: Tensor
    first: Tensor
    sums: Tensor
    score: Tensor

    def __init__(self, cameras: Sequence[Camera], fraction: float) -> None:
        super().__init__()
        self.fraction, self.side = fraction, SIDE
        while sum(map(self._blocks, cameras)) > MAX_BLOCKS:
            self.side *= 2
        counts = torch.tensor(list(map(self._blocks, cameras)))
        self.register_buffer("width", torch.tensor([camera.width for camera in cameras]), persistent=False)
        self.register_buffer("first", counts.cumsum(0) - counts, persistent=False)
        self.register_buffer("sums", torch.zeros(int(counts.sum()), 2))
        self.register_buffer("score", torch.ones(int(counts.sum())))

    def _blocks(self, camera: Camera) -> int:
        return -(-camera.height // self.side) * -(-camera.width // self.side)

    def blocks(self, view: Tensor, pixel: Tensor) -> Tensor:
        """Block of each pixel [n]; ``view`` and row-major ``pixel`` are [n]."""
        width = self.width[view]
        columns = (width + self.side - 1) // self.side
        return self.first[view] + (pixel // width // self.side) * columns + pixel % width // self.side

    @torch.no_grad()
    def choose(self, batch: PixelBatch, stream: Stream) -> PixelBatch:
        """The batch with as many of its candidates as the fraction says, drawn by score, and with weights.

        With ``c`` the score over its mean over all blocks, both ways to draw a pixel together have ``(1 - fraction) +
        fraction c`` times the uniform density. The weight is one over that; for candidates also the mean score of all
        of them over that of all blocks, since they are chosen among each other. Means of any quantity over the batch
        are those of uniform draws, whatever the scores.
        """
        m = batch.candidates
        if m == 0:
            return batch
        score = self.score[self.blocks(batch.view, batch.pixel)]  # [b + m], mean 1 over all blocks
        b = len(score) - m
        among = score[b:]
        count = m // TIMES
        places = (torch.arange(count, device=score.device) + stream.uniform(count)) / count  # stratified
        cdf = among.double().cumsum(0)
        chosen = torch.searchsorted(cdf, places.double() * cdf[-1]).clamp_max(m - 1)
        kept = torch.cat((torch.arange(b, device=score.device), b + chosen))
        weight = 1.0 / (1.0 - self.fraction + self.fraction * score[kept])
        weight[b:] *= among.mean()
        highlight = score[kept] / (score[kept] + USUAL)
        return replace(batch[kept], candidates=0, weight=weight, highlight=highlight)

    @torch.no_grad()
    def rows(self, batch: PixelBatch, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """Blocks [b] of a batch's pixels, and what is to be added there [b, 2].

        Args:
            batch: as :meth:`choose` left it.
            gradient: by the roughness at each sample [b * n, 1].
        """
        size = gradient.view(len(batch.view), -1).sum(1) * len(batch.view)
        if batch.weight is not None:
            size = size / batch.weight
        return self.blocks(batch.view, batch.pixel), torch.stack((size.square(), torch.ones_like(size)), -1)

    @torch.no_grad()
    def record(self, blocks: Tensor, values: Tensor) -> None:
        """Add what :meth:`rows` found, here or in other processes."""
        self.sums.index_add_(0, blocks, values)

    @torch.no_grad()
    def update(self) -> None:
        """Let the scores follow what was recorded, and forget a part of it."""
        square, count = self.sums.unbind(1)
        usual = (square / count.clamp_min(1.0)).sqrt().mean().square()
        if not bool(usual > 0):
            return
        size = ((square + FAMILIAR * usual) / (count + FAMILIAR)).sqrt()
        self.score.copy_(size / size.mean())
        self.sums.mul_(DECAY)
