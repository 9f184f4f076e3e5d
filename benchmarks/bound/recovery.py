"""The best linear estimate of surface maps from pixels: what light, noise and footprints leave of them.

Pixels are ``y = J B x + noise``: ``B`` averages the finest cells over a pixel's footprint, ``J`` says how a pixel
answers to the mean of its materials. The maps are ``x = mean + U z`` with ``z`` of unit variance: on every level of
cells the details have the covariance that the true maps have there, albedo and roughness together. It minimises
``|J B x - y|^2 / sigma^2 + |z|^2``: the Wiener filter, of all linear estimates the one of least squared error (van
Trees' bound were all of it Gaussian). Details are not everywhere alike: a plain wall has none, a pattern many, and what
recovers well finds that out. So the prior knows the power of the details around every place, from the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from scipy.sparse import csr_array

from benchmarks.bound.cells import SurfaceCells
from neurad.core.groups import group_sums
from neurad.core.records import Float64Array, FloatArray, IntArray

AROUND = 2
"""Levels above a cell, whose details' power it shares: about 16 cells of a plane have one."""
MIN_POWER = 1e-4
"""Least power of details anywhere, as a fraction of the level's mean."""
ITERATIONS = 100
TOLERANCE, LOOSE_TOLERANCE = 1e-3, 2e-2
"""Relative residuals at which solving ends: of what is observed, and of small differences in it."""


class Response(Protocol):
    """How what is observed answers to the materials [n, 4] of pixels, linearly: rows of a matrix ``J`` a pixel."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """``J x``: [n, 4] to [n, c]."""
        ...

    def transposed(self, y: FloatArray) -> FloatArray:
        """``J^T y``: [n, c] to [n, 4]."""
        ...

    def information(self, weight: FloatArray) -> FloatArray:
        """``J^T W J`` [n, 16] for weights ``W`` [n, c]."""
        ...


class SeenDirectly:
    """The maps themselves are photographed: ``J`` is one."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """What is there."""
        return x

    def transposed(self, y: FloatArray) -> FloatArray:
        """What is there."""
        return y

    def information(self, weight: FloatArray) -> FloatArray:
        """The weights on the diagonal."""
        found: FloatArray = np.einsum("nc,cd->ncd", weight, np.eye(4, dtype=np.float32)).reshape(-1, 16)
        return found


@dataclass(frozen=True)
class Photographed:
    """Photographs answer: each channel to its albedo and to the roughness."""

    jacobian: FloatArray
    """Derivatives of what is observed by albedo and roughness [n, 3, 4]."""

    @classmethod
    def of(cls, by_albedo: FloatArray, by_roughness: FloatArray) -> Photographed:
        """Radiance is observed, whose channels answer to their albedo [n, 3] and all to the roughness [n, 3]."""
        jacobian = np.zeros((len(by_albedo), 3, 4), np.float32)
        for c in range(3):
            jacobian[:, c, c] = by_albedo[:, c]
        jacobian[:, :, 3] = by_roughness
        return cls(jacobian)

    def mixed(self, channels: FloatArray) -> Photographed:
        """Sums of the channels are observed instead [n, 3, 3]."""
        return Photographed(channels @ self.jacobian)

    def __call__(self, x: FloatArray) -> FloatArray:
        """What is observed [n, 3]."""
        answer: FloatArray = np.einsum("ncm,nm->nc", self.jacobian, x)
        return answer

    def transposed(self, y: FloatArray) -> FloatArray:
        """Back to materials [n, 4]."""
        found: FloatArray = np.einsum("ncm,nc->nm", self.jacobian, y)
        return found

    def information(self, weight: FloatArray) -> FloatArray:
        """Information of the photographs, pixel by pixel."""
        weighted = self.jacobian * weight[:, :, None]
        return np.ascontiguousarray(self.jacobian.transpose(0, 2, 1) @ weighted).reshape(-1, 16)


@dataclass(frozen=True)
class Prior:
    """Mean and details of the maps."""

    mean: FloatArray
    """[4]."""
    bases: tuple[FloatArray, ...]
    """Bases of every level: principal axes times standard deviations of the details, by columns [4, 4]."""
    local: tuple[FloatArray, ...]
    """By how much the standard deviation of each differs around every cell [cells, 4]."""

    @classmethod
    def of(cls, cells: SurfaceCells, footprint: csr_array, values: FloatArray) -> Prior:
        """From the truth at single points.

        Args:
            cells: that the points lie in.
            footprint: of the points among the finest cells, one entry a row.
            values: albedo and roughness there [n, 4].
        """
        counted = np.concatenate((values, np.ones((len(values), 1), np.float32)), -1).astype(np.float32)
        sums = [(footprint.T @ counted).astype(np.float64)]
        for index in range(len(cells.codes) - 1, 0, -1):
            sums.insert(0, _summed(cells, index, sums[0]))
        mean = sums[0][:, :4].sum(0) / sums[0][:, 4].sum()
        bases, local, above = [], [], np.zeros((0, 4), np.float32)
        for index, total in enumerate(sums):
            count = total[:, 4:]
            expected = mean if index == 0 else (cells.parents[index - 1] @ above).astype(np.float64)
            found = np.where(count > 0, total[:, :4] / np.maximum(count, 1.0), expected)
            detail = found - expected
            covariance = (count * detail).T @ detail / count.sum()
            power, axes = np.linalg.eigh(covariance)
            bases.append((axes * np.sqrt(np.maximum(power, 0.0))).astype(np.float32))
            relative = count * np.square(detail @ axes) / np.maximum(power, 1e-20)
            local.append(_around(cells, index, relative, count))
            above = found.astype(np.float32)
        return cls(mean.astype(np.float32), tuple(bases), tuple(local))


def _summed(cells: SurfaceCells, index: int, below: Float64Array) -> Float64Array:
    """Sums over what lies in every cell of the level above."""
    parent, count = cells.parent_of(index), cells.counts[index - 1]
    return group_sums(below, parent, count)


def _around(cells: SurfaceCells, index: int, power: Float64Array, count: Float64Array) -> FloatArray:
    """Root of the mean ``power`` [cells, 4] in the cells that have the same ancestor :data:`AROUND` levels above."""
    both, above = np.concatenate((power, count), -1), list[IntArray]()
    while index > 0 and len(above) < AROUND:
        above.append(cells.parent_of(index))
        both, index = _summed(cells, index, both), index - 1
    if len(above) < AROUND:
        both = both.sum(0, keepdims=True).repeat(len(both), 0)
    mean = both[:, :4] / np.maximum(both[:, 4:], 1e-20)
    for parent in reversed(above):
        mean = mean[parent]
    return np.sqrt(np.clip(mean, MIN_POWER, None)).astype(np.float32)


class Recovery:
    """The estimate for one kind of observation.

    Args:
        cells: what the maps are made of.
        prior: of their details.
        footprint: of the pixels, among the finest cells; rows of sum 1, or empty for pixels that do not count.
        response: of the pixels to their materials.
        sigma: standard deviation of what is observed [n, c].
    """

    def __init__(
        self, cells: SurfaceCells, prior: Prior, footprint: csr_array, response: Response, sigma: FloatArray
    ) -> None:
        self.cells, self.prior, self.footprint, self.response = cells, prior, footprint, response
        used = (np.diff(footprint.indptr) > 0)[:, None]
        self.weight = np.where(used, 1.0 / np.maximum(sigma, 1e-20) ** 2, 0.0).astype(np.float32)
        ends = np.cumsum([0, *cells.counts])
        self._parts = [slice(a, b) for a, b in pairwise(ends)]
        self._inverse = self._blocks()

    def __call__(self, observed: FloatArray, tolerance: float = TOLERANCE) -> FloatArray:
        """The estimate's details: values of the cells of all levels [cells, 4], less the prior's mean.

        Args:
            observed: pixels less their response to the mean [n, c]; the estimate is linear in them.
            tolerance: of the residual, relative to the right side, in the norm of the preconditioner.
        """
        right = self._back(self.weight * observed)
        z, r = np.zeros_like(right), right
        s = self._preconditioned(r)
        p, power = s, _dot(r, s)
        first = power
        for _ in range(ITERATIONS):
            if power <= tolerance**2 * first:
                break
            q = p + self._back(self.weight * self.response(self.footprint @ self._values(p)[self._parts[-1]]))
            step = np.float32(power / _dot(p, q))
            z, r = z + step * p, r - step * q
            s = self._preconditioned(r)
            before, power = power, _dot(r, s)
            p = s + np.float32(power / before) * p
        return self._values(z)

    def less_mean(self, pixels: FloatArray) -> FloatArray:
        """What is observed of pixels of these mean materials [n, 4], less what the prior's mean would give [n, c]."""
        return self.response(pixels - self.prior.mean)

    def _values(self, z: FloatArray) -> FloatArray:
        """``U z`` in the cells of all levels."""
        x = np.empty_like(z)
        for index, part in enumerate(self._parts):
            x[part] = (z[part] * self.prior.local[index]) @ self.prior.bases[index].T
            if index > 0:
                x[part] += self.cells.parents[index - 1] @ x[self._parts[index - 1]]
        return x

    def _back(self, y: FloatArray) -> FloatArray:
        """``U^T B^T J^T y``."""
        return self._restricted(self.footprint.T @ self.response.transposed(y))

    def _restricted(self, finest: FloatArray) -> FloatArray:
        """``U^T`` of what belongs to the finest cells."""
        out = np.empty((self._parts[-1].stop, 4), np.float32)
        for index in range(len(self._parts) - 1, -1, -1):
            out[self._parts[index]] = (finest @ self.prior.bases[index]) * self.prior.local[index]
            if index > 0:
                finest = self.cells.parents[index - 1].T @ finest
        return out

    def _preconditioned(self, r: FloatArray) -> FloatArray:
        found: FloatArray = np.einsum("nij,nj->ni", self._inverse, r)
        return found

    def _blocks(self) -> FloatArray:
        """What is solved with, cell by cell, as if no other cell were near: one, and what the pixels of the cell tell
        together. The inverse [cells, 4, 4]: what pixels do not tell, such as roughness where nothing shines, takes one
        step then and not hundreds.
        """
        finest = self.footprint.T @ self.response.information(self.weight)
        blocks = np.empty((self._parts[-1].stop, 4, 4), np.float32)
        for index in range(len(self._parts) - 1, -1, -1):
            basis, local = self.prior.bases[index], self.prior.local[index]
            known = basis.T @ finest.reshape(-1, 4, 4) @ basis
            blocks[self._parts[index]] = np.eye(4) + local[:, :, None] * known * local[:, None, :]
            if index > 0:
                finest = self.cells.parents[index - 1].T @ finest
        inverse: FloatArray = np.linalg.inv(blocks).astype(np.float32)
        return inverse


def _dot(a: FloatArray, b: FloatArray) -> float:
    return float(np.einsum("nc,nc->", a, b, dtype=np.float64))
