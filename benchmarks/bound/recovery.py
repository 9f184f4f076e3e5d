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
TOLERANCE = 1e-3
"""Residual, relative to the right side, in the norm of the preconditioner, at which solving ends."""


@dataclass(frozen=True)
class Response:
    """How what is observed of pixels answers to their materials, linearly."""

    jacobian: FloatArray
    """Derivatives of what is observed by albedo and roughness [n, c, 4]."""

    @classmethod
    def direct(cls, count: int) -> Response:
        """The maps themselves are photographed."""
        return cls(np.broadcast_to(np.eye(4, dtype=np.float32), (count, 4, 4)))

    @classmethod
    def of(cls, by_albedo: FloatArray, by_roughness: FloatArray) -> Response:
        """Radiance is observed, whose channels answer to their albedo [n, 3] and all to the roughness [n, 3]."""
        jacobian = np.zeros((len(by_albedo), 3, 4), np.float32)
        for c in range(3):
            jacobian[:, c, c] = by_albedo[:, c]
        jacobian[:, :, 3] = by_roughness
        return cls(jacobian)

    def mixed(self, channels: FloatArray) -> Response:
        """Sums of the channels are observed instead [n, 3, 3]."""
        return Response(channels @ self.jacobian)

    def __call__(self, x: FloatArray) -> FloatArray:
        """What is observed [n, c] of materials [n, 4]."""
        answer: FloatArray = np.einsum("ncm,nm->nc", self.jacobian, x)
        return answer

    def transposed(self, y: FloatArray) -> FloatArray:
        """From what is observed [n, c] to materials [n, 4]."""
        found: FloatArray = np.einsum("ncm,nc->nm", self.jacobian, y)
        return found

    def information(self, weight: FloatArray) -> FloatArray:
        """``J^T W J`` [n, 16] for weights ``W`` [n, c]."""
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
    return group_sums(below, cells.parent_of(index), cells.counts[index - 1])


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

    def __call__(self, observed: FloatArray) -> FloatArray:
        """The estimate's details: values of the cells of all levels [cells, 4], less the prior's mean.

        Args:
            observed: pixels less their response to the mean [n, c]; the estimate is linear in them.
        """
        right = self._back(self.weight * observed)
        z, r = np.zeros_like(right), right
        s = self._preconditioned(r)
        p, power = s, _dot(r, s)
        first = power
        for _ in range(ITERATIONS):
            if power <= TOLERANCE**2 * first:
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
        finest = self.footprint.T @ self.response.transposed(y)
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
