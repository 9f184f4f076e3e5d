"""Vertices of a voxel grid near the surfaces of a scene: where the peer keeps its materials.

A full grid of 256^3 vertices holds 268 MB of albedo and roughness, of which surfaces touch a few percent. Here every
vertex of a cell that a surface passes through has an entry, found through an integer grid; the others have none.
"""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from neurad.core.records import FloatArray, IntArray, Surface, SurfaceInteraction
from neurad.scene.description import Scene

MARGIN = 0.01
"""Free space around the scene, as a fraction of its longest side."""
SPACING = 0.4
"""Distance of the points that stand for a triangle, in voxels."""
CHUNK = 1 << 21


class SurfaceVoxels:
    """The vertices of all cells that surfaces pass through.

    Args:
        scene: its triangles count.
        resolution: cells along the longest side.

    Attributes:
        resolution: cells along the longest side; the grid is a cube.
        low: smallest corner of the cube [3].
        side: its side in scene units.
        vertex: linear index ``x + S (y + S z)``, S = resolution + 1, of every vertex with an entry [n], ascending.
        entry: the entry of every vertex of the cube [S^3], uint32; 0 where there is none.
    """

    def __init__(self, scene: Scene, resolution: int) -> None:
        low, high = scene.bounds.astype(np.float64)
        self.resolution = resolution
        self.side = float((high - low).max()) * (1.0 + 2.0 * MARGIN)
        self.low: FloatArray = (0.5 * (low + high) - 0.5 * self.side).astype(np.float32)
        cells = np.zeros((resolution + 1) ** 3, bool)
        for mesh in scene.meshes:
            corners = ((mesh.vertices - self.low) * (resolution / self.side))[mesh.faces]
            _mark(cells, corners, resolution)
        marked = np.zeros_like(cells)
        for offset in self.corners():
            marked[np.flatnonzero(cells) + offset] = True
        self.vertex: IntArray = np.flatnonzero(marked)
        self.entry: npt.NDArray[np.uint32] = np.zeros(len(marked), np.uint32)
        self.entry[self.vertex] = np.arange(len(self.vertex), dtype=np.uint32)

    def __len__(self) -> int:
        return len(self.vertex)

    def corners(self) -> list[int]:
        """Linear index of the eight corners of a cell relative to its first; bit 0 of the corner is x, bit 2 is z."""
        stride = self.resolution + 1
        return [(k & 1) + stride * ((k >> 1 & 1) + stride * (k >> 2)) for k in range(8)]

    def positions(self) -> FloatArray:
        """Where the vertices lie in the scene [n, 3]."""
        unit = np.stack(_coordinates(self.vertex, self.resolution + 1), -1) / self.resolution
        return (self.low + self.side * unit).astype(np.float32)

    def lookup(self, values: Tensor, p: Tensor) -> Tensor:
        """Trilinear values [m, c] at scene positions [m, 3], from values at the vertices [n, c].

        The same function as the renderer's texture: what is scored is what light was traced with.
        """
        resolution, stride = self.resolution, self.resolution + 1
        x = ((p - torch.from_numpy(self.low)) / self.side).clamp(0.0, 1.0) * resolution
        cell = x.long().clamp_max(resolution - 1)
        f = x - cell
        base = cell[:, 0] + stride * (cell[:, 1] + stride * cell[:, 2])
        entry = torch.from_numpy(self.entry.view(np.int32))
        out = values.new_zeros(len(p), values.shape[1])
        for k, offset in enumerate(self.corners()):
            w = torch.ones_like(f[:, 0])
            for axis in range(3):
                w = w * (f[:, axis] if k >> axis & 1 else 1.0 - f[:, axis])
            out += w[:, None] * values.index_select(0, entry.index_select(0, base + offset).long())
        return out


class VoxelMaterials:
    """Voxel values as :class:`neurad.core.protocols.Materials`, for the metrics.

    Args:
        voxels: the vertices.
        values: albedo and roughness at them [n, 4].
    """

    def __init__(self, voxels: SurfaceVoxels, values: Tensor) -> None:
        self.voxels = voxels
        self.values = values

    def __call__(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        both = self.voxels.lookup(self.values, si.p)
        return Surface(both[:, :3], both[:, 3:])

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """The albedo alone [n, 3]."""
        return self(si).albedo


def coarser(vertex: IntArray, resolution: int) -> tuple[IntArray, IntArray]:
    """The grid of half the resolution below a set of vertices.

    Args:
        vertex: linear indices of fine vertices [n], ascending.
        resolution: even number of cells along the fine grid's side.

    Returns:
        Linear indices of the coarse vertices [m], ascending, and for every fine vertex eight of them [n, 8], as places
        in that list, whose mean is the trilinear value: a fine vertex that lies on a coarse one names it eight times,
        one in the middle of an edge names its ends four times each.
    """
    stride = resolution // 2 + 1
    fine = _coordinates(vertex, resolution + 1)
    parents = np.empty((len(vertex), 8), np.int64)
    for k in range(8):
        ends = [(x + (k >> axis & 1)) // 2 for axis, x in enumerate(fine)]
        parents[:, k] = ends[0] + stride * (ends[1] + stride * ends[2])
    known, place = np.unique(parents, return_inverse=True)
    return known, place.reshape(parents.shape)


def _coordinates(vertex: IntArray, stride: int) -> tuple[IntArray, IntArray, IntArray]:
    return vertex % stride, vertex // stride % stride, vertex // (stride * stride)


def _mark(cells: npt.NDArray[np.bool_], corners: FloatArray, resolution: int) -> None:
    """Mark the cells that triangles [f, 3, 3], in voxel units, pass through, by points at most SPACING apart."""
    first, e1, e2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    longest = np.sqrt(np.max([(e * e).sum(-1) for e in (e1, e2, e1 - e2)], axis=0))
    steps = np.maximum(1, np.ceil(longest / SPACING)).astype(int)
    stride = resolution + 1
    for count in np.unique(steps):
        a, b = np.meshgrid(np.arange(count + 1) / count, np.arange(count + 1) / count)
        inside = a + b <= 1.0 + 1e-6
        a, b = a[inside][None, :, None], b[inside][None, :, None]
        chosen = np.flatnonzero(steps == count)
        for part in np.array_split(chosen, -(-len(chosen) * a.size // CHUNK)):
            points = first[part, None] + a * e1[part, None] + b * e2[part, None]
            x, y, z = np.clip(points.reshape(-1, 3), 0, resolution - 1).astype(np.int64).T
            cells[x + stride * (y + stride * z)] = True
