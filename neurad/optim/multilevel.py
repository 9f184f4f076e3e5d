"""Least squares for a smooth function on surfaces: details on grids from coarse to fine, each with its own prior."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from neurad.core.grid import trilinear
from neurad.core.records import Float64Array, IntArray

TOLERANCE, ITERATIONS = 1e-4, 400


def solve(
    x: Float64Array, information: Float64Array, gradient: Float64Array, levels: Sequence[int], stds: Sequence[float]
) -> Float64Array:
    """The function ``f`` that minimises ``sum of information f(x)^2 - 2 gradient f(x)`` and ``sum of (detail / std)^2``
    over the nodes of all levels, at the nodes of the last one: the posterior mean of a Gaussian process whose scales
    are these levels.

    Args:
        x: places in the unit cube [m, 3].
        information: of each [m], not negative.
        gradient: of each [m].
        levels: cells along the unit cube, from coarse to fine, each dividing the last one.
        stds: of the details at the nodes of each level before anything is known.

    Returns:
        [n + 1, n + 1, n + 1] for n cells of the last level; the axes are those of ``x``. Nodes that are not beside
        any of the places have what the coarser levels say there.
    """
    from scipy import sparse  # imported where it is needed: it loads slowly
    from scipy.sparse.linalg import cg

    grids = [_interpolation(x, level) for level in levels]
    rows = sparse.hstack([std * matrix for std, (_, matrix) in zip(stds, grids, strict=True)]).tocsr()
    normal = (rows.T @ sparse.diags(information) @ rows + sparse.identity(rows.shape[1])).tocsr()
    inverse = sparse.diags(1.0 / normal.diagonal())
    z, _ = cg(normal, rows.T @ gradient, rtol=TOLERANCE, maxiter=ITERATIONS, M=inverse)
    finest = levels[-1]
    values = np.zeros((finest + 1,) * 3)
    for level, std, (node, matrix) in zip(levels, stds, grids, strict=True):
        detail = np.zeros((level + 1) ** 3)
        detail[node] = std * z[: matrix.shape[1]]
        z = z[matrix.shape[1] :]
        values += upsample(detail.reshape((level + 1,) * 3), finest // level)
    return values


def _interpolation(x: Float64Array, level: int) -> tuple[IntArray, Any]:
    """The nodes around places [m, 3], numbered with the last axis fastest, and their trilinear weights, sparse
    [m, nodes].
    """
    from scipy import sparse

    number, weight = trilinear(x, level)
    node, place = np.unique(number, return_inverse=True)
    start = np.arange(len(x) + 1) * 8
    return node, sparse.csr_matrix((weight.ravel(), place.ravel(), start), (len(x), len(node)))


def upsample(values: Float64Array, times: int) -> Float64Array:
    """Values at nodes interpolated to a grid with ``times`` as many cells along each axis."""
    for axis in range(3):
        last = values.shape[axis] - 1
        at = np.arange(last * times + 1) / times
        low = np.minimum(at.astype(np.int64), last - 1)
        t = (at - low).reshape([-1 if a == axis else 1 for a in range(3)])
        values = (1.0 - t) * values.take(low, axis) + t * values.take(low + 1, axis)
    return values
