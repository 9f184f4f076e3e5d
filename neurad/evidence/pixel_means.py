"""What training pixels say of the materials in them, means over many samples."""

from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch

from neurad.core.parameters import ALBEDO, ROUGHNESS
from neurad.core.records import FloatArray, IntArray, PixelBatch
from neurad.core.rng import Stream
from neurad.evidence.pixel_derivatives import DARK, LIMIT, TrainingPixels, group_of_samples

_STREAM = 37  # last number of the stream's key


@dataclass(frozen=True)
class PixelMeans:
    """Derivatives by roughness R and albedo D and residuals e of pixels, in units of their brightness."""

    view: IntArray
    """[n]."""
    corner: IntArray
    """Column and row of the pixel [n, 2]."""
    p: FloatArray
    """One of the surface points in each pixel [n, 3]."""
    prim: IntArray
    """Triangle that it lies on [n]."""
    r: FloatArray
    """Derivative by roughness [n, 3]; so are the next ones, a value a channel."""
    d: FloatArray
    """Derivative by the albedo of the same channel."""
    e: FloatArray
    """Photograph less estimate."""

    def __len__(self) -> int:
        return len(self.p)

    @property
    def number(self) -> IntArray:
        """One for every pixel of the training views [n]."""
        return np.asarray((self.view * (1 << 20) + self.corner[:, 1]) * (1 << 20) + self.corner[:, 0])

    def __getitem__(self, part: IntArray) -> Self:
        """Some of the pixels."""
        return type(self)(**{f.name: getattr(self, f.name)[part] for f in fields(self)})


def pixel_means(source: TrainingPixels, first: int, pixels: int, groups: int, samples: int) -> PixelMeans | None:
    """Means of about ``pixels`` training pixels at the present materials; None if no pixel is left.

    Args:
        first: iteration whose batch is the first one taken.
        groups: of samples in each pixel, independent of each other.
        samples: in a group, which are stratified together.
    """
    estimator, primary = source.estimator, source.primary

    def of_batch(index: int, batch: PixelBatch) -> list[FloatArray]:
        """The arrays of :class:`PixelMeans`, in the order of its fields."""
        stream = Stream(source.seed, first, index, _STREAM, device=primary.origin.device)
        # The unit needs no average over all groups, and the radiance field is a part of the cost.
        one = group_of_samples(estimator, primary, batch, stream, n=samples)
        found = [(one.by[ROUGHNESS.name], one.by[ALBEDO.name], one.image)]
        kept = one.valid
        for _ in range(1, groups):
            group = group_of_samples(estimator, primary, batch, stream, False, samples)
            found.append((group.by[ROUGHNESS.name], group.by[ALBEDO.name], group.image))
            kept = kept & group.valid
        r, d, image = (torch.stack(values) for values in zip(*found, strict=True))  # [groups, b, 3]
        # ---------------------- In units of the brightness ----------------------

        predicted = image.mean(0) if one.field is None else one.field  # [b, 3]
        unit = (predicted.square() + DARK * source.mean_square_radiance + 1e-30).sqrt()
        d, r, e = d / unit, r / unit, ((batch.color - image) / unit).clamp(-LIMIT, LIMIT)
        # ---------------------- Means over the groups ----------------------

        kept &= torch.isfinite(torch.cat((d, r, e), -1)).all(-1).all(0)
        corner = primary.views.corner(batch.view, batch.pixel)
        columns = [batch.view, corner, one.p[:, 0], one.prim[:, 0], *(value.mean(0) for value in (r, d, e))]
        return [column[kept].cpu().numpy() for column in columns]

    parts = source.of_batches(of_batch, first, pixels)
    if not sum(len(part[0]) for part in parts):
        return None
    means = PixelMeans(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    # Views of few pixels, and those of which only a part shows a surface, are drawn from more than once.
    return means[np.unique(means.number, return_index=True)[1]]
