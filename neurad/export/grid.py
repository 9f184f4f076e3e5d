"""Texture coordinates for any triangles at all: each gets half of a square of its own.

For meshes that no atlas can be made of. The squares have powers of two as sides, so that they fill a texture without
gaps; two triangles of about one size share one.
"""

from dataclasses import replace

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.export.charts import Chart

SMALLEST = 4
"""Side of the smallest square in texels: two triangles of a quarter of a texel, two texels apart."""
_EDGE, _GAP = 0.75, 3.75  # texels of a triangle from the sides of its square, and by which its legs are shorter


def grid_chart(mesh: Mesh, density: float, largest: int, texels: int | None = None) -> Chart:
    """The mesh with every triangle apart, in a texture of a power of two that holds them.

    Args:
        mesh: what it has of texture coordinates is dropped.
        density: wanted texels per unit of length; it is made smaller until all fits.
        largest: side of the largest texture.
        texels: of the texture, more only if the smallest squares need them; None for as many as it takes.

    Raises:
        InputError: the mesh has so many triangles that even the largest texture is too small.
    """
    points = mesh.vertices[mesh.faces].astype(np.float64)
    edges = np.linalg.norm(points - points[:, [1, 2, 0]], axis=-1)
    long_side = edges.max(1)
    while True:
        power = np.ceil(np.log2(np.maximum(long_side * density / 2**0.5 + _GAP, SMALLEST)))
        squares = np.minimum(2**power, largest // 4).astype(np.int64)  # at most a quarter of the largest texture
        order = np.argsort(-squares, kind="stable")
        side = squares[order][::2]  # of each pair, the larger one
        area = int((side**2).sum())
        width = 1 << max(int(np.ceil(np.log2(max(area, 16)) / 2)), 2)
        height = width // 2 if area * 2 <= width * width and width // 2 >= side[0] else width
        smallest = bool((squares == SMALLEST).all())
        if width <= largest and (smallest or texels is None or width * height <= texels):
            break
        if smallest:
            raise InputError(f"mesh {mesh.name}: {len(mesh.faces)} triangles do not fit in a texture of {largest}")
        density *= 0.8
    corner = _morton(np.concatenate(([0], np.cumsum(side**2)[:-1])))  # [pairs, 2]
    pair = np.arange(len(order)) // 2
    uvs = np.empty((len(order), 3, 2))
    uvs[order] = _placed(corner[pair], side[pair], np.arange(len(order)) % 2 == 1)
    start = np.argmax(np.where(edges == long_side[:, None], 1, 0), 1)  # the longest edge lies along the diagonal
    turned = (np.arange(3) - start[:, None] - 2) % 3
    uvs = np.take_along_axis(uvs, np.broadcast_to(turned[..., None], uvs.shape), 1)
    flat = (uvs / np.array([width, height], np.float64)).reshape(-1, 2).astype(np.float32)
    apart = mesh.of_vertices(mesh.faces.ravel(), np.arange(mesh.faces.size).reshape(-1, 3))
    return Chart(replace(apart, uvs=flat), np.arange(len(order)), width, height, "grid")


def _placed(corner: IntArray, side: IntArray, second: np.ndarray) -> Array:
    """Corners [n, 3, 2] of right triangles in squares at ``corner`` [n, 2]: the right angle first, at the square's
    origin or, of ``second`` ones, opposite to it.
    """
    leg = (side - _GAP)[:, None]
    origin = corner + _EDGE
    right, down = np.array([[1.0, 0.0]]) * leg, np.array([[0.0, 1.0]]) * leg
    here = np.stack((origin, origin + right, origin + down), 1)
    end = corner + side[:, None] - _EDGE
    there = np.stack((end, end - right, end - down), 1)
    return np.where(second[:, None, None], there, here)


def _morton(index: IntArray) -> IntArray:
    """Positions (x, y) [n, 2] of places along a Z-order curve: every other bit."""
    x, y = np.zeros((2, len(index)), np.int64)
    for bit in range(31):
        x |= ((index >> (2 * bit)) & 1) << bit
        y |= ((index >> (2 * bit + 1)) & 1) << bit
    return np.stack((x, y), 1)
