"""How well texels are known: which ones a photograph saw, and the error bars of what was recovered there."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from neurad.assembly.build import Assembly
from neurad.assembly.fitted_materials import FittedMaterials
from neurad.core.records import BoolArray, FloatArray, IntArray, SurfaceInteraction
from neurad.evidence.bar_maps import bars_at
from neurad.evidence.error_bars import ErrorBars
from neurad.export import raster_kernels as kernels
from neurad.export.bake import BakedRoom
from neurad.export.charts import Chart, in_texels
from neurad.export.texel_means import GUTTER, numbers_of
from neurad.images.image_io import png, write_exr
from neurad.metrics.seen import SeenBy
from neurad.runtime import threads
from neurad.runtime.progress import Phase
from neurad.scene.geometry import Geometry

COARSER = 4
"""Texels along the side of one of the evidence: it costs a ray for every camera."""
AT_ONCE = 1 << 22
"""Coarse texels that are held at once, of 160 bytes: cameras are asked for many points more cheaply."""
SEEN, UNSEEN, NO_SURFACE = 255, 96, 0
"""Grey of texels that a training view sees, that none does, and that lie on no surface."""


@dataclass(frozen=True)
class CoarseTexels:
    """A mesh's texels, :data:`COARSER` times larger, that lie on it or in the gutter."""

    shape: tuple[int, int]
    """Rows and columns."""
    lane: IntArray
    """The texels, row by row [n]."""
    si: SurfaceInteraction
    """The points in the middle of them, moved onto the mesh [n]."""


def coarse_size(chart: Chart) -> tuple[int, int]:
    """Rows and columns of a mesh's coarse texels."""
    return max(chart.height // COARSER, 4), max(chart.width // COARSER, 4)


def owners(chart: Chart, height: int, width: int) -> IntArray:
    """The triangle of a mesh that each texel of a picture of it shows [height * width], in the gutter the nearest; -1
    for none.
    """
    corners = in_texels(chart.mesh, width, height)
    owner = np.full((height * width, 1), -1, np.int64)
    slot = np.arange(height * width, dtype=np.int32).reshape(height, width)
    reach = GUTTER * width / chart.width
    kernels.nearest(corners, np.arange(len(corners)), slot, 0, 1, reach, np.full(owner.shape, reach**2), owner)
    return owner.ravel()


@torch.no_grad()
def coarse_texels(chart: Chart, first: int | IntArray, geometry: Geometry) -> CoarseTexels:
    """The coarse texels of a mesh, whose ``first`` triangle is as in :class:`neurad.export.texel_means.TexelMeans`."""
    height, width = coarse_size(chart)
    corners, owner = in_texels(chart.mesh, width, height), owners(chart, height, width)
    lane = np.flatnonzero(owner >= 0)
    y, x = np.divmod(lane, width)
    u, v = np.empty((2, len(lane)))
    points = chart.mesh.vertices[chart.mesh.faces].astype(np.float64)
    kernels.locate(corners, points, owner[lane], x + 0.5, y + 0.5, 0.0, u, v)  # limit 0: on the triangle
    prim = torch.from_numpy(numbers_of(chart, first)[owner[lane]])
    at_u, at_v = (torch.from_numpy(z).float() for z in (u, v))
    si = geometry.interact_at(prim, at_u, at_v, geometry.face_normal[prim], torch.ones_like(prim, dtype=torch.bool))
    return CoarseTexels((height, width), lane, si)


@torch.no_grad()
def seen_texels(texels: list[CoarseTexels], seen_by: SeenBy) -> list[BoolArray]:
    """Which coarse texels of each mesh some training view sees; of many meshes at once, as every camera is asked."""
    if not texels:
        return []
    seen = seen_by.any(SurfaceInteraction.cat(*(of_mesh.si for of_mesh in texels))).numpy()
    return np.split(seen, np.cumsum([len(of_mesh.lane) for of_mesh in texels])[:-1])


def std_maps(texels: CoarseTexels, bars: ErrorBars | None, assembly: Assembly) -> dict[str, FloatArray]:
    """Standard deviations of a mesh: ``albedo`` [h, w, 3] and, where there is one, ``roughness`` [h, w, 1]; 0 on
    emitters and where nothing lies. Empty without error bars.
    """
    maps: dict[str, FloatArray] = {}
    if bars is None or not isinstance(assembly.materials, FittedMaterials):
        return maps
    emits = (assembly.world.geometry.emission > 0).any(-1)
    for name, std in bars_at(bars, assembly.materials, texels.si, emits).items():
        picture = np.zeros((texels.shape[0] * texels.shape[1], std.shape[1]), np.float32)
        picture[texels.lane] = std
        maps[name] = picture.reshape(*texels.shape, -1)
    return maps


def write_evidence(
    room: BakedRoom, assembly: Assembly, folder: Path, bars: ErrorBars | None, bar: Phase
) -> list[float | None]:
    """Write ``evidence/MESH.png``, ``albedo_std/MESH.exr`` and the like of every recovered parameter; returns what
    fraction of each mesh's texels a photograph saw.
    """
    (folder / "evidence").mkdir()
    geometry = assembly.world.geometry
    seen_by = SeenBy.of(geometry, assembly.world.tracer.tracer, room.scene.train)
    first = np.cumsum([0, *(len(mesh.faces) for mesh in room.scene.meshes)])
    charts = {index: chart for index, chart in enumerate(room.charts) if chart is not None}
    found: list[float | None] = [None] * len(room.names)
    bar.stage("evidence", len(charts))
    for group in grouped({index: math.prod(coarse_size(chart)) for index, chart in charts.items()}, AT_ONCE):
        texels = list(threads.parallel_map(lambda i: coarse_texels(charts[i], int(first[i]), geometry), group))
        for index, of_mesh, seen in zip(group, texels, seen_texels(texels, seen_by), strict=True):
            picture = np.full(of_mesh.shape, NO_SURFACE, np.uint8)
            picture.ravel()[of_mesh.lane] = np.where(seen, SEEN, UNSEEN)
            (folder / "evidence" / f"{room.names[index]}.png").write_bytes(png(picture))
            found[index] = round(float(seen.mean()), 4) if len(seen) else 0.0
            for of, std in std_maps(of_mesh, bars, assembly).items():
                (folder / f"{of}_std").mkdir(exist_ok=True)
                write_exr(folder / f"{of}_std" / f"{room.names[index]}.exr", std)
            bar.step()
    return found


def grouped(sizes: dict[int, int], most: int) -> Iterator[list[int]]:
    """Keys in order, in groups whose sizes add up to at most ``most``; what is larger by itself is its own group."""
    group: list[int] = []
    for index, size in sizes.items():
        if group and sum(sizes[i] for i in group) + size > most:
            yield group
            group = []
        group.append(index)
    if group:
        yield group
