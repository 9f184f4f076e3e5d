"""A texture of its own for every mesh: with its own coordinates, those of an atlas, or squares for its triangles."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from neurad.core.errors import InputError
from neurad.core.records import Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.export.atlas import AtlasMaker, Spare, atlas_chart
from neurad.export.charts import Chart, own_chart, triangle_areas
from neurad.export.texels import LARGEST, SMALLEST, rounded, wanted_size
from neurad.runtime import threads

PLANNED = 0.7
"""Fraction of the budget that is dealt out before atlases are made; the rest goes where charts turn out to need it."""
SMALLEST_SQUARE = 4
"""Side in texels of the smallest square of a grid: two triangles of a quarter of a texel, two texels apart."""
_EDGE, _GAP = 0.75, 3.75  # texels of a triangle from the sides of its square, and by which its legs are shorter


def unwrap(
    meshes: list[Mesh],
    density: Array,
    budget: int,
    side: int | None = None,
    done: Callable[[int], None] = lambda meshes: None,
    share: Array | None = None,
) -> list[Chart]:
    """Every mesh with texture coordinates that are unique in a texture of its own.

    Args:
        meshes: each with at least one triangle.
        density: texels per unit of length that each needs [m].
        budget: texels of all textures; meshes of very many charts may exceed it.
        side: of every texture, whatever it needs.
        done: called with 1 for each mesh that is done.
        share: of the photographs that each has [m]: who has most gets first what is left of the budget.
    """
    sizes = [wanted_size(mesh, float(d)) for mesh, d in zip(meshes, density, strict=True)]
    texels = rounded(sizes, budget, side)
    own = [own_chart(mesh, int(w), int(h)) for mesh, (w, h) in zip(meshes, texels, strict=True)]
    areas = [float(triangle_areas(mesh.vertices[mesh.faces]).sum()) for mesh in meshes]
    # Without the coordinates that turned out not to be unique, textures are sized as atlases; room for one of the
    # smallest stays for each of the others.
    bare = {index: replace(meshes[index], uvs=None) for index, found in enumerate(own) if found is None}
    settled = [found.texels for found in own if found is not None]
    planned = int(PLANNED * max(budget - sum(settled), budget // 4)) - SMALLEST**2 * len(settled)
    sizes = [wanted_size(mesh, float(density[index])) for index, mesh in bare.items()]
    texels[list(bare)] = rounded(sizes, planned, side)

    first = np.array([len(mesh.faces) for mesh in meshes]) if share is None else share
    order = [int(index) for index in np.argsort(-first, kind="stable")]
    spare = Spare(max(budget - int(texels.prod(1).sum()), 0) if side is None else 0, order)

    makers = [AtlasMaker(number) for number in range(threads.threads(len(meshes), 1))]
    idle = makers.copy()

    def chart(index: int) -> Chart:
        maker = idle.pop()
        try:
            found = own[index]
            if found is None:
                width, height = (int(x) for x in texels[index])
                take = partial(spare.take, index)
                found = atlas_chart(bare[index], width, height, areas[index], float(density[index]), maker, take)
                if found is None:
                    grid = float(np.sqrt(0.35 * width * height / areas[index])) if areas[index] > 0 else 1.0
                    found = grid_chart(bare[index], grid, LARGEST, width * height)
        finally:
            idle.append(maker)
            spare.done(index)
        done(1)
        return found

    try:
        with ThreadPoolExecutor(len(makers)) as pool:
            futures = {index: pool.submit(chart, index) for index in order}
            return [futures[index].result() for index in range(len(meshes))]
    finally:
        for maker in makers:
            maker.close()


def grid_chart(mesh: Mesh, density: float, largest: int, texels: int | None = None) -> Chart:
    """The mesh with every triangle apart, each in half of a square of its own, in a texture that holds them: for meshes
    that no atlas can be made of. The squares have powers of two as sides, so that they fill a texture without gaps.

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
        power = np.ceil(np.log2(np.maximum(long_side * density / 2**0.5 + _GAP, SMALLEST_SQUARE)))
        squares = np.minimum(2**power, largest // 4).astype(np.int64)  # at most a quarter of the largest texture
        order = np.argsort(-squares, kind="stable")
        side = squares[order][::2]  # of each pair, the larger one
        area = int((side**2).sum())
        width = 1 << max(int(np.ceil(np.log2(max(area, 16)) / 2)), 2)
        height = width // 2 if area * 2 <= width * width and width // 2 >= side[0] else width
        smallest = bool((squares == SMALLEST_SQUARE).all())
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
