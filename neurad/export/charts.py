"""Texture coordinates that name one place of a mesh each: what makes them so, and whether a mesh's own are."""

from dataclasses import dataclass, replace

import numpy as np

from neurad.core.records import Array, BoolArray, IntArray
from neurad.core.scene_records import Mesh
from neurad.export import raster_kernels as kernels
from neurad.scene.connected import linked
from neurad.scene.triangles import normals_and_areas

REACH = 1.0
"""Texels around a chart that a bilinear lookup on it reads."""
MARGIN = 1.5
"""Texels that stay free along the sides of a texture, so that a lookup never reads across them: pictures repeat."""
NOTHING = 0.05
"""Texels that a chart of nothing but slivers may cover."""
NOTHING_FRACTION = 1e-4
"""Largest fraction of a mesh's area that may lie on such charts."""
SHRUNK = 16.0
"""A triangle is shrunk if its texture is so many times smaller, for its area, than the mean over the mesh."""
SHRUNK_FRACTION = 0.02
"""Largest fraction of a mesh's area that may lie on shrunk triangles."""


@dataclass(frozen=True)
class Chart:
    """A mesh whose texture coordinates lie inside the unit square and name one place of it each."""

    mesh: Mesh
    """Vertices as they were, some of them several times; triangles in the same order."""
    chart: IntArray
    """Chart of each triangle: those of one chart hang together in the texture [f]."""
    width: int
    """Width of the texture in texels; a power of two."""
    height: int
    kind: str
    """'own', 'atlas' or 'grid': where the coordinates come from."""

    @property
    def texels(self) -> int:
        """Number of texels of the texture."""
        return self.width * self.height

    @property
    def corners(self) -> Array:
        """The triangles in texture space, in texels, from the coordinates as they are written: float64 [f, 3, 2]."""
        return in_texels(self.mesh, self.width, self.height)


def in_texels(mesh: Mesh, width: int, height: int) -> Array:
    """The triangles of a mesh in its texture space, in texels [f, 3, 2], float64."""
    assert mesh.uvs is not None
    corners: Array = mesh.uvs[mesh.faces].astype(np.float64) * np.array([width, height], np.float64)
    return np.ascontiguousarray(corners)


def edge_keys(values: Array, faces: IntArray) -> IntArray:
    """Numbers [3 f] that are equal for edges of triangles [f, 3] whose ends have the same ``values`` [v, c], to the
    bit; edge k of a triangle leads from corner k to the next.
    """
    place = np.ascontiguousarray(values, np.float32) + np.float32(0.0)  # no negative zeros
    _, vertex = np.unique(place.view([("", place.dtype)] * place.shape[1]).ravel(), return_inverse=True)
    corner = vertex.astype(np.int64)[faces]  # [f, 3]
    following = corner[:, [1, 2, 0]]
    keys: IntArray = (np.minimum(corner, following) * (len(vertex) + 1) + np.maximum(corner, following)).ravel()
    return keys


def find_charts(mesh: Mesh) -> IntArray:
    """The chart of each triangle [f]: triangles that share an edge, in space and in the texture, are of one."""
    assert mesh.uvs is not None
    edge = edge_keys(np.concatenate((mesh.vertices, mesh.uvs), 1), mesh.faces)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order[1:]] == edge[order[:-1]])
    return linked(order[same] // 3, order[same + 1] // 3, len(mesh.faces))


def find_borders(mesh: Mesh) -> IntArray:
    """Sides of triangles [k], 3 times the triangle plus the edge, that another triangle shares in space, but not in the
    texture: there two charts meet, or one meets itself.
    """
    assert mesh.uvs is not None
    here = mesh.vertices[mesh.faces]
    in_space, in_texture = (
        np.unique(edge_keys(values, mesh.faces), return_inverse=True, return_counts=True)
        for values in (mesh.vertices, np.concatenate((mesh.vertices, mesh.uvs), 1))
    )
    shared = in_space[2][in_space[1]] > in_texture[2][in_texture[1]]
    return np.flatnonzero(shared & (here != here[:, [1, 2, 0]]).any(-1).ravel())


def four_texels(x: Array, y: Array) -> list[tuple[Array, Array, Array]]:
    """Columns, rows and weights [n] of the four texels that bilinear lookups at (x, y) [n], in texels, read."""
    left, top = np.floor(x - 0.5), np.floor(y - 0.5)
    right, down = x - 0.5 - left, y - 0.5 - top
    return [
        (left + i, top + j, ((right if i else 1.0 - right) * (down if j else 1.0 - down)).astype(np.float32))
        for j in (0, 1)
        for i in (0, 1)
    ]


def texels_read(chart: Chart, x: Array, y: Array) -> BoolArray:
    """Which texels [h, w] bilinear lookups at (x, y) [n], in texels, read; textures repeat."""
    read = np.zeros((chart.height, chart.width), bool)
    for column, row, _ in four_texels(x, y):
        read[row.astype(np.int64) % chart.height, column.astype(np.int64) % chart.width] = True
    return read


def border_texels(chart: Chart) -> BoolArray:
    """Texels [h, w] that lookups on borders between charts read, seen every half texel along them."""
    border = find_borders(chart.mesh)
    corners, face, edge = chart.corners, border // 3, border % 3
    a, b = corners[face, edge], corners[face, (edge + 1) % 3]
    count = np.ceil(2.0 * np.abs(b - a).max(1, initial=0.0)).astype(np.int64) + 1
    side = np.arange(len(border)).repeat(count)
    part = (np.arange(len(side)) - (np.cumsum(count) - count).repeat(count)) / np.maximum(count - 1, 1)[side]
    at = a[side] + (b - a)[side] * part[:, None]
    return texels_read(chart, at[:, 0], at[:, 1])


def triangle_areas(points: Array) -> Array:
    """Areas of triangles [f, 3, 2 or 3]: float64 [f]."""
    if points.shape[-1] == 3:
        return normals_and_areas(points.astype(np.float64))[1]
    a, b = (points[:, k].astype(np.float64) - points[:, 0] for k in (1, 2))
    flat: Array = 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return flat


def is_candidate(mesh: Mesh) -> bool:
    """Whether the texture coordinates of a mesh may be unique: inside the unit square, of some area, and not so uneven
    that much of the mesh would get next to no texels.
    """
    if mesh.uvs is None or not np.isfinite(mesh.uvs).all():
        return False
    used = mesh.uvs[mesh.faces]
    if used.min(initial=0.0) < -1e-6 or used.max(initial=0.0) > 1.0 + 1e-6:
        return False
    space, texture = triangle_areas(mesh.vertices[mesh.faces]), triangle_areas(used)
    if texture.sum() <= 0.0 or texture.sum() > 1.0 + 1e-3:
        return False
    shrunk = texture * SHRUNK * space.sum() < space * texture.sum()
    return bool(space[shrunk].sum() <= SHRUNK_FRACTION * space.sum())


def own_chart(mesh: Mesh, width: int, height: int) -> Chart | None:
    """The mesh with its own texture coordinates, if in a texture of this size no texel belongs to two places.

    Coordinates that come within :data:`MARGIN` of the sides are drawn in by it.
    """
    if not is_candidate(mesh):
        return None
    assert mesh.uvs is not None
    size = np.array([width, height], np.float64)
    used = mesh.uvs[mesh.faces].reshape(-1, 2) * size
    if (used.min(0) < MARGIN).any() or (used.max(0) > size - MARGIN).any():
        drawn_in = (MARGIN + np.clip(mesh.uvs, 0.0, 1.0) * (size - 2.0 * MARGIN)) / size
        mesh = replace(mesh, uvs=drawn_in.astype(np.float32))
    found = Chart(mesh, find_charts(mesh), width, height, "own")
    return found if is_unique(found) else None


def is_unique(chart: Chart, folded: float = 0.0) -> bool:
    """Whether no texel is owned by two triangles, and none is needed by two charts.

    Charts that are nothing but slivers count for neither as long as nothing of the mesh is on them: packers put them
    where others lie, and nobody sees them. A fraction ``folded`` of the texels may be owned twice.
    """
    corners = chart.corners
    label, of_chart = np.unique(chart.chart, return_inverse=True)
    nothing = (np.bincount(of_chart, triangle_areas(corners), len(label)) < NOTHING)[of_chart]
    if nothing.any():
        area = triangle_areas(chart.mesh.vertices[chart.mesh.faces])
        if area[nothing].sum() > NOTHING_FRACTION * area.sum():
            nothing[:] = False
    needed, owner = np.full((2, chart.height, chart.width), -1, np.int32)
    twice, overlap = kernels.conflicts(
        np.ascontiguousarray(corners[~nothing]), chart.chart[~nothing], REACH, needed, owner
    )
    return int(twice) == 0 and int(overlap) <= folded * owner.size
