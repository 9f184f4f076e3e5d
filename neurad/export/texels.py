"""How large the texture of each mesh has to be for what the photographs show."""

import math
from dataclasses import dataclass

import numpy as np
import torch

from neurad.core.camera import Cameras
from neurad.core.protocols import Tracer
from neurad.core.records import Array, IntArray
from neurad.core.rng import Stream
from neurad.core.scene_records import Mesh
from neurad.export.charts import in_texels, is_candidate, triangle_areas
from neurad.runtime.progress import Phase
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

RAYS, CHUNK = 1 << 20, 1 << 17
"""Camera rays behind the figures, and those in flight."""
CLOSER_FRACTION = 0.1
"""Fraction of what the photographs show of a mesh that is seen closer than its texels say."""
FINER = 2.0
"""Texels along the side of such a pixel. With one the albedo of the built-in patterned kitchen lost 0.61 dB, with two
none, and with three or four nothing more was gained (a fit of 30.5 dB)."""
UNSEEN = 0.25
"""Texels a length of a mesh that no photograph shows, over those of the room."""
FILLED = 0.6
"""Fraction of an atlas that charts cover: what is expected before it is made."""
LARGEST = 8192
"""Side of the largest texture."""
SMALLEST = 8
"""Side of the smallest one, but for what a grid of squares needs."""
PER_TRIANGLE = 16
"""Texels a triangle that a mesh gets at least: where triangles are smaller than texels, those that lie side by side in
the texture belong to planes too far apart, and seams show."""
MIN_SIDE, MAX_REQUIRED_SIDE = 64, 1024
"""Smallest and largest side of a texture that is asked for because of that."""
HELD, HELD_STEPS = 256, 32
"""When all get smaller for the budget, textures are held at this side, or what is asked for if less, until the others
are so many eighths of a halving smaller."""


@dataclass(frozen=True)
class TextureSize:
    """A texture before it is rounded to powers of two."""

    width: float
    height: float
    least: float = 0.0
    """Side of a square that it is not to be smaller than, as long as the budget allows."""


@torch.no_grad()
def densities(tracer: Tracer, geometry: Geometry, scene: Scene, progress: Phase) -> tuple[Array, Array]:
    """Texels per unit of length that each mesh needs [m], and the fraction of the rays that ended on it [m].

    A texel is half as wide as the pixels that see the mesh closest, a tenth of them. What no photograph shows gets a
    quarter of what the whole room would need.
    """
    cameras = Cameras.of([view.camera for view in scene.train], "cpu")
    count = min(RAYS, 4 * sum(view.camera.width * view.camera.height for view in scene.train))
    progress.stage("measuring", count)
    stream = Stream(0, 7)
    footprints, meshes = [], []
    for begin in range(0, count, CHUNK):
        lanes = min(CHUNK, count - begin)
        view = stream.integers(len(scene.train), lanes)
        xy = stream.uniform(lanes, 2) * cameras.size[view]
        rays = cameras.rays(view, xy)
        hit = tracer.closest(rays)
        footprints.append((hit.t * cameras.footprint(view, xy))[hit.valid].numpy().astype(np.float64))
        meshes.append(geometry.mesh_index[hit.prim[hit.valid]].numpy())
        progress.step(lanes)
    footprint, mesh = np.concatenate(footprints), np.concatenate(meshes)
    extent = float(np.linalg.norm(scene.bounds[1] - scene.bounds[0])) or 1.0
    room = float(np.quantile(footprint, CLOSER_FRACTION)) if len(footprint) else extent / 256
    size = np.full(len(scene.meshes), max(room, 1e-6 * extent) / UNSEEN)
    order = np.argsort(mesh, kind="stable")
    found, start = np.unique(mesh[order], return_index=True)
    for index, part in zip(found, np.split(footprint[order], start[1:]), strict=True):
        size[index] = max(float(np.quantile(part, CLOSER_FRACTION)), 1e-6 * extent)
    return FINER / size, np.bincount(mesh, minlength=len(size)) / max(count, 1)


def wanted_size(mesh: Mesh, density: float) -> TextureSize:
    """The texture of a mesh at ``density`` texels per unit of length.

    Where the mesh's own coordinates may serve, each axis is as long as it is stretched over the surface; otherwise it
    is a square that the surface fills in part.
    """
    least = min(max(MIN_SIDE, math.sqrt(PER_TRIANGLE * len(mesh.faces) / FILLED)), MAX_REQUIRED_SIDE)
    if is_candidate(mesh):
        along_u, along_v = _stretch(mesh)
        return TextureSize(along_u * density, along_v * density, least)
    area = float(triangle_areas(mesh.vertices[mesh.faces]).sum())
    side = math.sqrt(area / FILLED) * density
    return TextureSize(side, side, least)


def _stretch(mesh: Mesh) -> tuple[float, float]:
    """Lengths on the surface of a step from 0 to 1 along u and along v, means over the mesh's area."""
    points = mesh.vertices[mesh.faces].astype(np.float64)
    corners = in_texels(mesh, 1, 1)
    first, second = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    area = triangle_areas(points)
    good = (np.abs(det) > 1e-12) & (area > 0)
    if not good.any():
        return 0.0, 0.0
    by_u = (first * b[:, 1:] - second * a[:, 1:])[good] / det[good, None]
    by_v = (second * a[:, :1] - first * b[:, :1])[good] / det[good, None]
    weight = area[good] / area[good].sum()
    return float(weight @ np.linalg.norm(by_u, axis=1)), float(weight @ np.linalg.norm(by_v, axis=1))


def rounded(sizes: list[TextureSize], budget: int, side: int | None = None) -> IntArray:
    """Widths and heights [m, 2]: the nearest powers of two that have at most ``budget`` texels together.

    Args:
        budget: texels of all textures; what is wanted is made smaller by one factor until it fits, the small ones last.
        side: of every texture instead.
    """
    wanted = np.array([(s.width, s.height) for s in sizes], np.float64).reshape(-1, 2)
    least = np.array([s.least for s in sizes])
    if side is not None:
        return np.full(wanted.shape, side, np.int64)
    found: IntArray = np.full(wanted.shape, SMALLEST, np.int64)
    for step in range(200):
        scaled = np.maximum(wanted * 2.0 ** (-step / 8.0), 1.0)
        held = np.minimum(least, HELD) * 2.0 ** (-max(step - HELD_STEPS, 0) / 8.0)
        kept = np.maximum(least * 2.0 ** (-step / 8.0), held)
        scaled *= np.maximum(kept / np.sqrt(scaled.prod(1)), 1.0)[:, None]
        found = (2 ** np.clip(np.round(np.log2(scaled)), math.log2(SMALLEST), math.log2(LARGEST))).astype(np.int64)
        if found.prod(1).sum() <= budget:
            break
    return found
