"""Path guiding: directions are drawn towards the indirect light that earlier samples found.

Most noise of a one-bounce estimate comes from the direction of its BSDF sample: light that enters a dim room through a
door lies in a few directions out of many. A guide keeps, for cells of space and six facings of the surface, how much
light arrived by bins of the square that :func:`neurad.core.sampling.cosine_hemisphere` maps to directions, and draws
bins by the root of the mean square of it (Guo et al. 2018, "Primary Sample Space Path Guiding", on one bounce). The
density is known and bounded below, so estimates keep their mean whatever the guide holds.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from neurad.core.frame import faceforward
from neurad.core.protocols import BSDF
from neurad.core.records import BSDFSample, FloatArray, Surface, SurfaceInteraction
from neurad.core.sampling import INV_PI, disk_to_square
from neurad.integrators import guide_kernels as kernels
from neurad.runtime.dispatch import use_kernel

FACINGS = 6
"""Classes of normals: by their largest component and its sign."""


class Guide(nn.Module):
    """A histogram of incident light over space, facing and direction.

    It holds samples of earlier iterations and changes between iterations only, so samples of one iteration stay
    independent of each other. All of it is state: a continued run draws what an unbroken one would (on a GPU up to
    the order of sums).

    Args:
        bounds: smallest and largest corner of the scene [2, 3].
        cells: cells along its longest side.
        bins: bins along each side of the square of directions.
        uniform: fraction of the samples that are drawn as without a guide; weights grow by at most its inverse.
        refresh: iterations after which the distribution is recomputed.
        decay: factor on the histogram at each refresh, since light changes while materials are found.
        use_kernels: use the compiled kernels where they apply (float32 on the CPU).
    """

    lowest: Tensor
    counts: Tensor
    squares: Tensor
    cdf: Tensor

    def __init__(
        self,
        bounds: Tensor,
        cells: int = 16,
        bins: int = 8,
        uniform: float = 0.3,
        refresh: int = 64,
        decay: float = 0.97,
        use_kernels: bool = True,
    ) -> None:
        super().__init__()
        extent = (bounds[1] - bounds[0]).float()
        side = float(extent.max().clamp_min(torch.finfo(torch.float32).tiny)) / cells
        self.inverse_side = 1.0 / side
        self.shape = [max(1, math.ceil(float(x) / side - 1e-3)) for x in extent]
        self.bins, self.uniform, self.refresh, self.decay, self.use_kernels = bins, uniform, refresh, decay, use_kernels
        rows, count = FACINGS * math.prod(self.shape), bins * bins
        self.register_buffer("lowest", bounds[0].float().clone(), persistent=False)
        self.register_buffer("counts", torch.zeros(rows, count))
        self.register_buffer("squares", torch.zeros(rows, count))
        self.register_buffer("cdf", torch.arange(1, count + 1).div(count).repeat(rows, 1))

    def rows(self, si: SurfaceInteraction, n: Tensor) -> Tensor:
        """Row of the histogram [n] for lanes with unit normals ``n`` [n, 3] on the viewer's side."""
        if use_kernel(self.use_kernels, n):
            out = torch.empty(len(n), dtype=torch.int64)
            read = (x.contiguous().numpy() for x in (si.p, n, self.lowest))
            arrays: list[Any] = [*read, self.inverse_side, *self.shape, out.numpy()]
            kernels.rows(*arrays)
            return out
        cell = ((si.p - self.lowest) * self.inverse_side).floor().clamp_min(0).long()
        x, y, z = (c.clamp_max(most - 1) for c, most in zip(cell.unbind(-1), self.shape, strict=True))
        axis = n.abs().argmax(-1)
        facing = 2 * axis + (n.gather(1, axis.unsqueeze(-1)).squeeze(-1) > 0)
        return ((x * self.shape[1] + y) * self.shape[2] + z) * FACINGS + facing

    def warp(self, rows: Tensor, u: Tensor) -> Tensor:
        """Numbers [n, 2] with the density of :meth:`density` from uniform numbers ``u`` [n, 2]."""
        cdf = self.cdf[rows]
        chosen = torch.searchsorted(cdf, u[:, :1].contiguous(), right=True).clamp_max(self.bins**2 - 1)
        high = cdf.gather(1, chosen)
        low = torch.where(chosen > 0, cdf.gather(1, (chosen - 1).clamp_min(0)), 0.0)
        inside = ((u[:, :1] - low) / (high - low)).clamp(0.0, _BELOW_ONE)
        first = (chosen // self.bins + inside) / self.bins
        second = (chosen % self.bins + u[:, 1:]) / self.bins
        return torch.cat((first, second), -1).clamp_max(_BELOW_ONE)

    def density(self, rows: Tensor, wi: Tensor) -> Tensor:
        """How much likelier than by the cosine alone the guide draws local directions ``wi`` [n, 3]: [n], mean 1."""
        chosen = self._bin(wi)
        low = torch.where(chosen > 0, self.cdf[rows, (chosen - 1).clamp_min(0)], 0.0)
        return (self.cdf[rows, chosen] - low) * self.bins**2

    def _bin(self, wi: Tensor) -> Tensor:
        """Bin [n] of local directions [n, 3]."""
        x, y = (disk_to_square(wi[:, :2]) * self.bins).long().clamp(0, self.bins - 1).unbind(-1)
        return x * self.bins + y

    @torch.no_grad()
    def bin_samples(self, si: SurfaceInteraction, wi: Tensor, light: Tensor) -> tuple[Tensor, Tensor]:
        """Entries [n] of the flat histogram of samples, and what is to be added there [n, 2]: 1 and radiance^2.

        Args:
            si: vertices that light arrived at [n].
            wi: local directions that it came from [n, 3].
            light: radiance [n, 3].
        """
        if use_kernel(self.use_kernels, wi, light):
            places, values = torch.empty(len(wi), dtype=torch.int64), torch.empty(len(wi), 2)
            read = (x.contiguous().numpy() for x in (si.p, si.n, si.wo, si.valid, wi, light, self.lowest))
            arrays: list[Any] = [*read, self.inverse_side, *self.shape, self.bins, places.numpy(), values.numpy()]
            kernels.bin_samples(*arrays)
            return places, values
        known = (si.valid & (wi[:, 2] > 0)).to(light.dtype)
        places = self.rows(si, faceforward(si)) * self.bins**2 + self._bin(wi)
        return places, torch.stack((known, light.mean(-1).square() * known), -1)

    @torch.no_grad()
    def record(self, places: Tensor, values: Tensor) -> None:
        """Add what :meth:`bin_samples` found, here or in other processes, to the histogram."""
        if use_kernel(self.use_kernels, values, self.counts):
            kernels.record(*(x.contiguous().numpy() for x in (places, values, self.counts, self.squares)))
            return
        self.counts.view(-1).index_add_(0, places, values[:, 0])
        self.squares.view(-1).index_add_(0, places, values[:, 1])

    @torch.no_grad()
    def update(self) -> None:
        """Recompute the distribution from the histogram, and let the histogram decay."""
        # Root of the mean square radiance of each bin
        found = self.counts.sum(1) > 0  # rows with samples [rows]
        counts, squares = self.counts[found], self.squares[found]
        mean = squares.sum(1, keepdim=True) / counts.sum(1, keepdim=True)
        # Two samples' worth of the row's mean keep the density of bins without samples above zero.
        root = ((squares + 2.0 * mean) / (counts + 2.0)).sqrt()

        # Distribution: a mixture with the uniform one, as running sums
        total = root.sum(1, keepdim=True)
        even = 1.0 / self.bins**2
        fraction = torch.where(total > 0, root / total.clamp_min(torch.finfo(root.dtype).tiny), even)
        cdf = (self.uniform * even + (1.0 - self.uniform) * fraction).cumsum(1)
        self.cdf[found] = cdf / cdf[:, -1:]  # [k, bins^2]

        # Light changes while materials are found
        self.counts.mul_(self.decay)
        self.squares.mul_(self.decay)


@dataclass(frozen=True)
class Guided:
    """A guide at the lanes of a bounce: of samples of the diffuse lobe; the density is that of both lobes."""

    guide: Guide
    rows: Tensor
    fraction: float | Tensor
    """Probability of the diffuse lobe [n]."""

    def pdf_delta(self, wi: Tensor) -> Tensor:
        """Density of local directions [n] with the guide less that without; it integrates to 0."""
        return self.fraction * (wi[:, 2].clamp_min(0.0) * INV_PI) * (self.guide.density(self.rows, wi) - 1.0)

    def add_pdf(self, wi: Tensor, pdf: Tensor) -> None:
        """Add :meth:`pdf_delta` to the densities ``pdf`` [n] that are above 0, by a kernel."""
        guide = self.guide
        arrays = self.rows.numpy(), wi.numpy(), self._fractions(), guide.cdf.numpy(), guide.bins
        kernels.add_pdf(*arrays, pdf.numpy())

    def _fractions(self) -> FloatArray:
        """The fraction as an array [1] or [n]."""
        return np.asarray(self.fraction, np.float32).reshape(-1)

    def warp(self, u: Tensor) -> Tensor:
        """Numbers for the BSDF [n, 3] from uniform ones."""
        guide = self.guide
        if use_kernel(guide.use_kernels, u):
            out = torch.empty(len(u), 3)
            arrays = self.rows.numpy(), u.contiguous().numpy(), self._fractions(), guide.cdf.numpy(), guide.bins
            kernels.warp(*arrays, out.numpy())
            return out
        by_cosine = u[:, 0] < self.fraction
        warped = torch.where(by_cosine.unsqueeze(-1), guide.warp(self.rows, u[:, 1:]), u[:, 1:])
        return torch.cat((u[:, :1], warped), -1)


class GuidedBSDF:
    """A BSDF whose samples of the diffuse lobe are drawn with a guide: values are those of the BSDF, densities are of
    both.

    Args:
        rows: the guide's rows at the vertices [n].
    """

    def __init__(self, bsdf: BSDF, guide: Guide, rows: Tensor) -> None:
        self.bsdf, self.guide, self.rows = bsdf, guide, rows
        self.varying_weight = bsdf.varying_weight

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value [n, 3] of the BSDF, and the detached density [n] of :meth:`sample`."""
        value, pdf = self.bsdf.eval_pdf(surface, wo, wi)
        return value, pdf + self._guided(surface, wo).pdf_delta(wi)

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Draw ``wi`` from three uniform numbers ``u`` [n, 3], those of the diffuse lobe warped by the guide."""
        guided = self._guided(surface, wo)
        sample = self.bsdf.sample(surface, wo, guided.warp(u))
        pdf = torch.where(sample.pdf > 0, sample.pdf + guided.pdf_delta(sample.wi), 0.0)
        ratio = torch.where(pdf > 0, sample.pdf / pdf, 0.0)
        return BSDFSample(sample.wi, pdf, sample.weight * ratio.unsqueeze(-1))

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Mean of the weights [n, 3]: that of the BSDF, as a guide changes no mean."""
        return self.bsdf.mean_weight(surface, wo)

    def _guided(self, surface: Surface, wo: Tensor) -> Guided:
        return Guided(self.guide, self.rows, self.bsdf.diffuse_fraction(surface, wo))


_BELOW_ONE = 1.0 - 2.0**-24
