"""A texture of its own for every mesh: with its own coordinates, those of an atlas, or squares for its triangles."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from neurad.core.records import Array
from neurad.core.scene_records import Mesh
from neurad.export.atlas import SECONDS, AtlasMaker, Spare, atlas_chart
from neurad.export.charts import Chart, own_chart, triangle_areas
from neurad.export.grid import grid_chart
from neurad.export.texels import LARGEST, TextureSize, rounded, wanted_size
from neurad.runtime import threads

PLANNED = 0.7
"""Fraction of the budget that is dealt out before atlases are made; the rest goes where charts turn out to need it."""


def unwrap(
    meshes: list[Mesh],
    density: Array,
    budget: int,
    side: int | None = None,
    done: Callable[[str], None] = lambda name: None,
    seconds: float = SECONDS,
    share: Array | None = None,
) -> list[Chart]:
    """Every mesh with texture coordinates that are unique in a texture of its own.

    Args:
        meshes: each with at least one triangle.
        density: texels per unit of length that each needs [m].
        budget: texels of all textures; meshes of very many charts may exceed it.
        side: of every texture, whatever it needs.
        done: called with the name of each mesh that is done.
        seconds: longest time for the atlas of one mesh.
        share: of the photographs that each has [m]: who has most gets first what is left of the budget.
    """
    sizes = [wanted_size(mesh, float(d)) for mesh, d in zip(meshes, density, strict=True)]
    texels = rounded(sizes, budget, side)
    own = [own_chart(mesh, int(w), int(h)) for mesh, (w, h) in zip(meshes, texels, strict=True)]
    areas = [float(triangle_areas(mesh.vertices[mesh.faces]).sum()) for mesh in meshes]
    bare = [mesh if found else replace(mesh, uvs=None) for mesh, found in zip(meshes, own, strict=True)]
    # Without the coordinates that turned out not to be unique, textures are sized as atlases.
    sizes = [s if c else wanted_size(m, float(d)) for s, c, m, d in zip(sizes, own, bare, density, strict=True)]
    settled = sum(found.texels for found in own if found is not None)
    planned = int(PLANNED * max(budget - settled, budget // 4))
    others = [TextureSize(0.0, 0.0) if found else size for size, found in zip(sizes, own, strict=True)]
    kept = np.array([found is not None for found in own]).reshape(-1, 1)
    texels = np.where(kept, texels, rounded(others, planned, side))

    first = np.array([len(mesh.faces) for mesh in meshes]) if share is None else share
    order = [int(index) for index in np.argsort(-first, kind="stable")]
    spare = Spare(max(budget - int(texels.prod(1).sum()), 0) if side is None else 0, order)

    def chart(index: int) -> Chart:
        try:
            found = own[index]
            if found is None:
                width, height = (int(x) for x in texels[index])
                take = partial(spare.take, index)
                found = atlas_chart(
                    bare[index], width, height, areas[index], float(density[index]), of_thread.maker, take
                )
                if found is None:
                    grid = _grid_density(areas[index], width * height)
                    found = grid_chart(bare[index], grid, LARGEST, width * height)
        finally:
            spare.done(index)
        done(meshes[index].name)
        return found

    count = threads.threads(len(meshes), 1)
    makers = [AtlasMaker(number, seconds) for number in range(count)]
    idle = iter(makers)
    of_thread = threading.local()

    def begin() -> None:
        of_thread.maker = next(idle)

    try:
        with ThreadPoolExecutor(count, initializer=begin) as pool:
            futures = {index: pool.submit(chart, index) for index in order}
            return [futures[index].result() for index in range(len(meshes))]
    finally:
        for maker in makers:
            maker.close()


def _grid_density(area: float, texels: int) -> float:
    """Texels per unit of length of which squares for all triangles fill about ``texels`` ones."""
    return float(np.sqrt(0.35 * texels / area)) if area > 0 else 1.0
