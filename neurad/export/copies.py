"""Textures of what stands in a room many times: means over all copies, by what is known of each."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from neurad.assembly.build import Assembly
from neurad.core.parameters import PARAMETERS
from neurad.core.records import Array, FloatArray, IntArray
from neurad.core.reflection import DiffuseLobe
from neurad.core.scene_records import Material, Mesh
from neurad.evidence.error_bars import ErrorBars
from neurad.export import raster_kernels
from neurad.export.bake import Baked, bake, push_pull
from neurad.export.base_colour import Coded, Target, base_for, coded
from neurad.export.charts import Chart, find_charts, in_texels, triangle_areas
from neurad.export.evidence import coarse_texels, owners, seen_texels, std_maps
from neurad.export.texel_means import TexelMeans
from neurad.export.unwrap import grid_chart
from neurad.images.image_io import png
from neurad.metrics.seen import SeenBy
from neurad.pages.colours import encode
from neurad.scene.geometry import Geometry

REACH = 2e-5
"""How far corners of one triangle may lie apart in two files, in radii of the room: twenty units in the last place of
float32."""
NEIGHBOURS = 4
"""Triangles that are compared with each: sheets lie back to back."""
FINEST = 1.0 / 255.0
"""Standard deviation below which nothing is known better: a step of an 8-bit texture."""
GUESS = 1e-3
"""Weight of what no photograph shows beside what one does."""
CONSTANT = 64
"""Side of the texture whose mean is taken where a surface has no coordinates."""


Part = tuple[Array, Array | None, IntArray, IntArray]
"""What :class:`Copies` has of one instance."""


@dataclass(frozen=True)
class Copies:
    """Everything that one texture is on, all copies of it."""

    points: Array
    """Corners of the triangles, each as the scene orders those of its own [t, 3, 3], in the scene's frame."""
    uvs: Array | None
    """Texture coordinates of the corners [t, 3, 2]; None where one value has to do."""
    prims: IntArray
    """Numbers of the scene's triangles [t]."""
    thing: IntArray
    """Number of the instance that each belongs to [t]."""

    @classmethod
    def joined(cls, parts: Sequence[Part]) -> Self:
        """All copies, from the fields of each; one without coordinates leaves all without."""
        points, uvs, prims, thing = zip(*parts, strict=True) if parts else ((), (None,), (), ())
        empty = np.zeros(0, np.int64)
        known = [part for part in uvs if part is not None]
        return cls(
            np.concatenate([np.zeros((0, 3, 3)), *points]),
            np.concatenate([np.zeros((0, 3, 2)), *known]) if len(known) == len(uvs) else None,
            np.concatenate([empty, *prims]),
            np.concatenate([empty, *thing]),
        )


class Matcher:
    """Finds the triangles of a scene again among those of another file, which has meshes whose planes were made flat as
    they were.
    """

    def __init__(self, meshes: Sequence[Mesh], geometry: Geometry) -> None:
        self.area = self.known = 0.0
        """Area of all triangles that :meth:`part` was asked for, and of those that the scene has."""
        read = [mesh.vertices if mesh.as_read is None else mesh.as_read for mesh in meshes]
        corners = [vertices[mesh.faces] for vertices, mesh in zip(read, meshes, strict=True)]
        self.corners = np.concatenate([np.zeros((0, 3, 3)), *corners]).astype(np.float32).astype(np.float64)
        self.tree = cKDTree(self.corners.mean(1))
        self.reach = REACH * geometry.scale

    def __call__(self, points: Array) -> tuple[IntArray, IntArray]:
        """The scene's triangles of corners [t, 3, 3], -1 for none [t], and which corner each of theirs is [t, 3]."""
        least = np.full(len(points), 2.0 * self.reach)
        prims, order = np.full(len(points), -1), np.tile(np.arange(3), (len(points), 1))
        _, near = self.tree.query(points.mean(1), [*range(1, NEIGHBOURS + 1)], distance_upper_bound=self.reach)
        for prim in near.T:
            found = np.flatnonzero(prim < len(self.corners))
            apart = np.linalg.norm(self.corners[prim[found], :, None] - points[found, None], axis=-1)
            corner = apart.argmin(-1)
            turned = (corner[:, 1] - corner[:, 0]) % 3 != 1  # the other winding: only where there is nothing else
            error = apart.min(-1).max(-1)
            good = (error <= self.reach) & (corner.sum(1) == 3) & (corner.prod(1) == 0) & (corner.max(1) == 2)
            good &= error + self.reach * turned < least[found]
            found = found[good]
            least[found] = (error + self.reach * turned)[good]
            prims[found], order[found] = prim[found], corner[good]
        return prims, order

    def part(self, points: Array, uvs: Array | None, pose: Array, origin: Array, thing: int) -> Part:
        """The triangles of an instance that the scene has.

        Args:
            points: corners of its triangles [t, 3, 3].
            uvs: their texture coordinates [t, 3, 2].
            pose: takes the corners to the frame of the files [4, 4].
            origin: of the scene in that frame [3].
            thing: number of the instance.
        """
        points = points.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3] - origin
        if np.linalg.det(pose[:3, :3]) < 0:  # it is wound the other way round
            points, uvs = points[:, [0, 2, 1]], None if uvs is None else uvs[:, [0, 2, 1]]
        prims, order = self(points)
        sizes = triangle_areas(points)
        self.area, self.known = self.area + float(sizes.sum()), self.known + float(sizes[prims >= 0].sum())
        good = np.flatnonzero((prims >= 0) & (sizes > 0))
        row, corner = good[:, None], order[good]
        placed = None if uvs is None else uvs[row, corner].astype(np.float64)
        return points[row, corner], placed, prims[good], np.full(len(good), thing)


@dataclass(frozen=True)
class Surface:
    """What a texture of a file is for."""

    name: str
    layout: int | None
    """Number of its layout; None where one value has to do."""
    copies: Copies


@dataclass(frozen=True)
class Painted:
    """The material of a surface."""

    material: Material
    """By its model; its textures are not read."""
    baked: Baked
    """The texture of all copies."""
    layers: int
    """How many copies share a texel at most."""
    apart: float
    """Root of the mean squared difference of shared texels' albedo to the mean."""
    target: Target
    """Whose base colours it gets."""
    lobe: DiffuseLobe
    """Diffuse lobe that they are converted from."""
    glow: FloatArray | None = None
    """Radiance of its texels [h, w, 3], where a part of it shines."""

    def files(self, upwards: bool = False) -> Coded | None:
        """Its textures, from the lowest row if ``upwards``, else from the highest; None where one value has to do."""
        if self.baked.pixels.shape[:2] == (1, 1):
            return None
        maps = {key: x[::-1] if upwards else x for key, x in self.baked.maps.items()}
        return coded(maps, self.target, self.lobe)

    def emission(self, upwards: bool = False) -> tuple[bytes, float] | None:
        """Its radiance as a picture (sRGB, 8 bits) and what that is multiplied by; None where it does not shine."""
        if self.glow is None:
            return None
        strength = float(self.glow.max())
        return png(encode(self.glow[:: -1 if upwards else 1] / strength)), strength

    def values(self) -> tuple[list[float], float, float]:
        """Base colour, roughness and metalness of the first texel."""
        albedo, roughness, metallic = (
            self.baked.maps.get(p.name, np.full((1, 1, p.channels), p.absent))[:1, :1].astype(np.float32)
            for p in PARAMETERS
        )
        base = np.clip(base_for(self.target, albedo, roughness, self.lobe), 0.0, 1.0)
        return base.ravel().tolist(), roughness.item(), metallic.item()


def mixed(
    copies: Copies, side: int, assembly: Assembly, seen_by: SeenBy, bars: ErrorBars | None
) -> tuple[Baked, int, float]:
    """Bake each copy, and take the mean by what is known of each: by the inverse of its variance where the run has
    error bars, otherwise by whether a photograph shows it; of what has no coordinates a single value is made. Returns
    the texture, of so many texels a side, and what :class:`Painted` says of its copies.
    """
    geometry, parameters = assembly.world.geometry, assembly.scene.parameters
    charts = _charts(copies, side)
    covered = np.zeros((charts[0][0].height, charts[0][0].width), np.int64)
    total, weights, squared = np.zeros((3, *covered.shape, sum(p.channels for p in parameters)), np.float32)
    for chart, prims in charts:
        baked = bake(TexelMeans(chart, prims, geometry, assembly.materials, parameters))
        weight = np.broadcast_to(np.float32(1.0), baked.pixels.shape)
        if len(charts) > 1:
            texels = coarse_texels(chart, prims, geometry)
            stds = std_maps(texels, bars, assembly)
            shown = np.zeros((*texels.shape, 1), np.float32)
            shown.ravel()[texels.lane] = seen_texels([texels], seen_by)[0]
            parts = [
                np.repeat(1.0 / (stds[p.name].mean(-1, keepdims=True) ** 2 + FINEST**2), p.channels, -1)
                if p.name in stds else np.repeat(shown + GUESS, p.channels, -1)
                for p in parameters
            ]  # fmt: skip
            weight = _as_large(np.concatenate(parts, -1), covered.shape)
        weight = np.where(baked.covered[..., None], weight, 0.0)
        pixels = baked.pixels.astype(np.float32)
        total, weights, squared = total + weight * pixels, weights + weight, squared + weight * pixels**2
        covered += baked.covered
    mean = np.asarray(total / np.maximum(weights, 1e-30), np.float32)
    known, shared, apart = covered > 0, covered > 1, 0.0
    if shared.any():
        variance = np.maximum(squared / np.maximum(weights, 1e-30) - mean**2, 0.0)
        apart = float(np.sqrt(variance[shared][:, :3].mean()))
    if copies.uvs is None:
        mean = np.broadcast_to(mean[known].mean(0), (1, 1, mean.shape[-1])).astype(np.float32)
        known = np.ones((1, 1), bool)
    return Baked(push_pull(mean, known).astype(np.float16), known, parameters), len(charts), apart


def glow(copies: Copies, side: int, radiance: FloatArray) -> FloatArray:
    """What texels shine with [side, side, 3], by the radiance of the scene's triangles [f, 3]: the mean of all copies,
    0 beyond them.
    """
    total, covered = np.zeros((side * side, 3), np.float32), np.zeros((side * side, 1), np.float32)
    for chart, prims in _charts(copies, side):
        owner = owners(chart, side, side)
        lane = np.flatnonzero(owner >= 0)
        total[lane] += radiance[prims[owner[lane]]]
        covered[lane] += 1.0
    return np.asarray(total / np.maximum(covered, 1.0), np.float32).reshape(side, side, 3)


def _charts(copies: Copies, side: int) -> list[tuple[Chart, IntArray]]:
    """The copies in layers, in each of which no two share a texel, with the numbers of their triangles."""
    corners, faces = copies.points.reshape(-1, 3), np.arange(3 * len(copies.points)).reshape(-1, 3)
    if copies.uvs is None:
        return [(grid_chart(Mesh("", corners, faces, 0), 1.0, CONSTANT * CONSTANT, CONSTANT**2), copies.prims)]
    # Coordinates that a modifier has moved by whole textures stand for the same texels.
    uvs = copies.uvs - np.floor(copies.uvs.mean(1, keepdims=True))
    mesh = Mesh("", corners, faces, 0, None, uvs.reshape(-1, 2).astype(np.float32))
    texels = in_texels(mesh, side, side)
    a, b = texels[:, 1] - texels[:, 0], texels[:, 2] - texels[:, 0]
    mirrored = a[:, 0] * b[:, 1] < a[:, 1] * b[:, 0]  # halves that a mirror makes hang together with what they lie on
    keys = np.stack((copies.thing, find_charts(mesh), mirrored), 1)
    _, part = np.unique(keys, axis=0, return_inverse=True)
    part = part.ravel()
    by_part = np.argsort(part, kind="stable")
    layer = np.empty(len(part), np.int64)
    raster_kernels.stack(texels[by_part], part[by_part], np.zeros((side, side), np.int64), layer)
    made = []
    for number in range(int(layer.max()) + 1):
        chosen = by_part[layer == number]
        few = Mesh("", corners[faces[chosen]].reshape(-1, 3), faces[: len(chosen)], 0, None,
                   uvs[chosen].reshape(-1, 2).astype(np.float32))  # fmt: skip
        made.append((Chart(few, find_charts(few), side, side, "own"), copies.prims[chosen]))
    return made


def _as_large(picture: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """A coarse picture [h, w, c] with every texel as large as it is in a texture of a shape."""
    row, column = (np.arange(size) * small // size for size, small in zip(shape, picture.shape, strict=False))
    large: FloatArray = picture[row][:, column]
    return large
