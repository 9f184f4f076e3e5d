"""Walls, floors and tables of a scan, which scanners give waves and noise, made as flat as they are.

A scan is off by millimetres. Where its surface is bent, shading is that of another surface, which a fit takes for
stains of the albedo, and photographs are seen beside the place that they show. Most of a room is flat: its planes are
found as Schnabel et al. 2007 find shapes (candidates from small patches, the one with most of the surface first,
connected pieces alone), and what lies on one within three standard deviations of the scan's errors is moved onto it.
These errors are what its clearest planes have. Modelled rooms, whose walls are flat already, stay as they are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from neurad.core.records import BoolArray, Float64Array, IntArray
from neurad.core.scene_records import Mesh
from neurad.scene.connected import joined_places, welded_corners
from neurad.scene.description import Scene

FLAT, MODELLED = 2.0**-21, 0.05
"""Height of a triangle over its neighbour's plane, in extents of the coordinates, up to which numbers of 32 bits cannot
tell them from one polygon, and fraction of area with such neighbours from which on somebody modelled a mesh: rooms have
0.1 to 0.6, scans hardly any."""
REACH = 0.02
"""Radius of a patch that gives a candidate, as a fraction of the root of the whole area; a plane is at least as large
as a square around it."""
SAMPLES, CANDIDATES = 20_000, 400
"""Points that stand for the surface, and patches that are looked at."""
LARGEST = 0.002
"""Errors of a scan at most, as a fraction of the root of the whole area."""
CLEAR = 0.25
"""Fraction of the planes' area to which nothing else lies near: it tells the errors of the scan."""
SIGMAS = 3.0
"""Standard deviations of a scan's errors within which a surface is of a plane."""
TURNED = 0.7
"""Sine of the angle between the normals of a triangle and of its plane at most."""
CURVED = 0.5
"""Fraction of the squared distances to a plane that a paraboloid takes away where the surface is curved."""
BENT = 5.0, 30.0
"""Degrees between planes that touch within which they are one bent surface."""
APART = 0.05
"""Least eigenvalue of planes that meet in a vertex for it to be moved along; planes of nearly one normal share one."""


@dataclass(frozen=True)
class Flattened:
    """Meshes whose planes are flat."""

    meshes: list[Mesh]
    """With the triangles of those that were given, in their order."""
    planes: int = 0
    share: float = 0.0
    """Fraction of the area that is on planes."""
    moved: float = 0.0
    """Root mean square of the way of vertices on planes."""
    farthest: float = 0.0
    """Longest one."""


class Plane(NamedTuple):
    """Points ``p`` with ``normal . p = offset``."""

    normal: Float64Array
    offset: float

    def height(self, p: Float64Array) -> Float64Array:
        """Signed distance of points [..., 3]."""
        return np.asarray(p @ self.normal - self.offset)

    def sine(self, normal: Float64Array) -> Float64Array:
        """Sine of the angle between its normal and others [..., 3]."""
        return np.sqrt(np.maximum(1.0 - np.square(normal @ self.normal), 0.0))


class _Within(NamedTuple):
    """How far a surface may be from a plane."""

    height: float
    sine: float
    """Of the angle between their normals."""


class _Sampled(NamedTuple):
    """Points that stand for the surface."""

    points: Float64Array
    """[n, 3]."""
    triangle: IntArray
    """[n]."""
    normal: Float64Array
    """[n, 3]."""
    candidates: list[Plane]
    """Planes through patches."""


@dataclass(frozen=True)
class _Surface:
    """Triangles of all meshes."""

    points: Float64Array
    """Places [p, 3]."""
    place: IntArray
    """Number of the place of each corner of a triangle [f, 3]."""
    normal: Float64Array
    """[f, 3]."""
    area: Float64Array
    """[f]."""

    @property
    def smallest(self) -> float:
        """Area of a plane."""
        return float((2.0 * REACH) ** 2 * self.area.sum())


def flattened(scene: Scene) -> Scene:
    """The scene; where its mesh is to be refined, with flat planes, which its notes say."""
    found = flatten_planes(scene.meshes) if scene.photography.mesh == "refine" else Flattened(list(scene.meshes))
    if found.planes == 0:
        return scene
    note = (
        f"the mesh is a scan: {found.planes} planes, {100.0 * found.share:.0f} % of its area, are flat now; that moved "
        f"them by {found.moved:.2g} scene units (rms), {found.farthest:.2g} at most"
    )
    return replace(scene, meshes=found.meshes, notes=(*scene.notes, note))


def flatten_planes(meshes: Sequence[Mesh], seed: int = 0) -> Flattened:
    """Scans with flat planes; modelled rooms are given back as they are. What shines plays no part: a room keeps its
    geometry under another light.

    Args:
        meshes: of one scene, in one unit.
        seed: of the patches that are looked at.
    """
    if sum(len(mesh.faces) for mesh in meshes) == 0 or are_modelled(meshes):
        return Flattened(list(meshes))
    surface = _surface(meshes)
    planes, label = _find_planes(surface, _sampled(surface, np.random.default_rng(seed)))
    label[_is_bent(surface, planes, label)[label]] = -1
    if not (label >= 0).any():
        return Flattened(list(meshes))
    normals = np.stack([plane.normal for plane in planes])
    step = _steps(surface, normals, np.array([plane.offset for plane in planes]), label)
    flat = label >= 0
    way = np.linalg.norm(step[np.unique(surface.place[flat])], axis=-1)
    ends = np.cumsum([len(mesh.faces) for mesh in meshes])[:-1]
    parts = zip(meshes, np.split(surface.place, ends), np.split(label, ends), strict=True)
    found = [_moved(mesh, place, step, planes_of, normals) for mesh, place, planes_of in parts]
    share = float(surface.area[flat].sum() / surface.area.sum())
    return Flattened(found, len(np.unique(label[flat])), share, float(np.sqrt(np.square(way).mean())), float(way.max()))


def are_modelled(meshes: Sequence[Mesh]) -> bool:
    """Whether many triangles are one polygon with the next one of their file, or nothing has an area."""
    total = flat = 0.0
    extent = max(float(np.abs(mesh.vertices).max(initial=0.0)) for mesh in meshes)
    for mesh in meshes:
        one, other = mesh.faces[:-1], mesh.faces[1:]
        same = mesh.vertices[other][:, :, None] == mesh.vertices[one][:, None]  # [pairs, of the other, of one, 3]
        equal = same.all(-1)
        near = np.flatnonzero(equal.any(-1).sum(-1) == 2)  # an edge in common, and a vertex each that is not
        equal = equal[near]
        corners = mesh.vertices[one[near]].astype(np.float64)
        rows = np.arange(len(near))
        own = corners[rows, equal.any(1).argmin(-1)]
        last = mesh.vertices[other[near, equal.any(2).argmin(-1)]].astype(np.float64)
        normal, area = _normals(corners)
        height = np.abs(((last - own) * normal).sum(-1))
        # halves of a triangle whose side was cut say nothing of the next one
        sides = np.linalg.norm(np.cross(corners - own[:, None], (last - own)[:, None]), axis=-1)
        sides[rows, equal.any(1).argmin(-1)] = np.inf
        counts = sides.min(-1) > 0.01 * area
        total += float(_normals(mesh.vertices[mesh.faces].astype(np.float64))[1].sum())
        flat += float(area[counts & (height <= FLAT * extent)].sum())
    return flat >= MODELLED * total


def _normals(corners: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Unit normals [f, 3] and areas [f] of triangles [f, 3, 3]; those without area have none."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=-1)
    return across / np.maximum(length, 1e-300)[:, None], 0.5 * length


def _sampled(surface: _Surface, rng: np.random.Generator) -> _Sampled:
    """Points by area, and planes through patches of which most lies on them."""
    from scipy.spatial import cKDTree  # imported where it is needed: it loads slowly

    area = surface.area
    chosen = rng.choice(len(area), SAMPLES, p=area / area.sum())
    u, v = np.sort(rng.random((2, SAMPLES)), 0)
    weights = np.stack((u, v - u, 1.0 - v), -1)
    points = np.einsum("nc,ncd->nd", weights, surface.points[surface.place[chosen]])
    tree, planes = cKDTree(points), []
    for middle in rng.choice(SAMPLES, CANDIDATES, replace=False):
        patch = points[tree.query_ball_point(points[middle], REACH * float(np.sqrt(area.sum())))]
        inside = np.ones(len(patch), bool)
        for _ in range(4):
            if inside.sum() < max(0.6 * len(patch), 8):
                break
            plane = _through(patch[inside])
            distance = np.abs(plane.height(patch))
            inside = distance <= 2.5 * 1.4826 * float(np.median(distance))
        else:
            planes.append(plane)
    return _Sampled(points, chosen, surface.normal[chosen], planes)


def _surface(meshes: Sequence[Mesh]) -> _Surface:
    points = np.concatenate([mesh.vertices for mesh in meshes]).astype(np.float64)
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + k for mesh, k in zip(meshes, first, strict=False)])
    place = welded_corners(points.astype(np.float32), faces)
    places = np.zeros((int(place.max()) + 1, 3))
    places[place] = points[faces]
    return _Surface(places, place, *_normals(points[faces]))


# ---------------------- Which planes there are ----------------------


def _find_planes(surface: _Surface, sampled: _Sampled) -> tuple[list[Plane], IntArray]:
    """The planes, the largest first, and which of them each triangle is on [f], -1 for none."""
    points, chosen, size = sampled.points, sampled.triangle, float(np.sqrt(surface.area.sum()))
    largest = _Within(LARGEST * size, TURNED)
    planes, label = _within(surface, sampled, largest)
    if not planes:
        return planes, label
    # ---- once more, within the errors that these have
    rows = [np.flatnonzero(label[chosen] == index) for index in range(len(planes))]
    area = [len(row) for row in rows]
    heights = [_deviation(plane.height(points[row])) for plane, row in zip(planes, rows, strict=True)]
    sines = [_deviation(plane.sine(sampled.normal[row])) for plane, row in zip(planes, rows, strict=True)]
    height, sine = (SIGMAS * float(np.quantile(np.repeat(sigmas, area), CLEAR)) for sigmas in (heights, sines))
    if height > largest.height or sine > largest.sine:  # as far as was looked: these are no planes
        return [], np.full(len(label), -1)
    return _within(surface, sampled, _Within(height, sine))


def _within(surface: _Surface, sampled: _Sampled, within: _Within) -> tuple[list[Plane], IntArray]:
    """As :func:`_find_planes`, of what lies at most so far from them."""
    points, chosen, normals, candidates = sampled
    planes: list[Plane] = []
    label = np.full(len(surface.area), -1)
    near = np.stack([_on(plane, points, normals, within) for plane in candidates])
    free = np.ones(len(points), bool)
    while True:
        count = np.count_nonzero(near, axis=1)
        best = int(count.argmax())
        if count[best] * surface.area.sum() < surface.smallest * len(points):
            return planes, label
        plane, inside = candidates[best], near[best] & free
        near[best] = False
        for _ in range(3):
            plane = _through(points[inside])
            kept = _on(plane, points, normals, within) & free
            inside = kept if np.count_nonzero(kept) > 2 else inside
        for piece in _pieces(surface, plane, within, label < 0):
            # each has a plane of its own: a panel on a wall stays before the wall
            corners = surface.points[surface.place[piece]].reshape(-1, 3)
            area = np.repeat(surface.area[piece], 3)
            own = _through(corners, area)
            if not _is_curved(own, corners, area):
                label[piece] = len(planes)
                planes.append(own)
        free = label[chosen] < 0
        near &= free


def _deviation(height: Float64Array) -> float:
    """Standard deviation about 0 without what stands out."""
    deviation = 0.0
    for _ in range(10 if len(height) else 0):
        deviation = float(np.sqrt(np.square(height).mean()))
        height = height[np.abs(height) <= SIGMAS * deviation]
    return deviation


def _through(points: Float64Array, weight: Float64Array | None = None) -> Plane:
    """The plane of least squares."""
    middle = np.average(points, 0, weight)
    normal = np.linalg.eigh(np.cov((points - middle).T, aweights=weight))[1][:, 0]
    return Plane(normal, float(middle @ normal))


def _on(plane: Plane, points: Float64Array, normals: Float64Array, within: _Within) -> BoolArray:
    """Which points lie on it."""
    on: BoolArray = (np.abs(plane.height(points)) < within.height) & (plane.sine(normals) < within.sine)
    return on


def _pieces(surface: _Surface, plane: Plane, within: _Within, free: BoolArray) -> Iterator[IntArray]:
    """Triangles of each connected piece on a plane that is large enough; the two faces of a board are two pieces."""
    near = np.abs(plane.height(surface.points)) < within.height
    a, b, c = surface.place.T
    on = near[a] & near[b] & near[c] & free
    on[on] = plane.sine(surface.normal[on]) < within.sine
    front = surface.normal @ plane.normal > 0.0
    for chosen in (np.flatnonzero(on & front), np.flatnonzero(on & ~front)):
        place = surface.place[chosen]
        used = np.zeros(len(surface.points), np.int64)
        used[place] = 1
        place = (np.cumsum(used) - 1)[place]  # counted anew
        piece = joined_places(place)[place[:, 0]]
        for number in np.flatnonzero(np.bincount(piece, surface.area[chosen]) >= surface.smallest):
            yield chosen[piece == number]


def _is_bent(surface: _Surface, planes: Sequence[Plane], label: IntArray) -> BoolArray:
    """Which planes go on in another one, a little turned, as strips of a pipe do [planes + 1]; the last one is none."""
    bent = np.zeros(len(planes) + 1, bool)
    flat = np.flatnonzero(label >= 0)
    pairs = np.unique(surface.place[flat] * len(bent) + label[flat, None])
    place, plane = pairs // len(bent), pairs % len(bent)
    for apart in (1, 2):  # of the few planes that share a place
        one, other = plane[:-apart], plane[apart:]
        met = np.unique(np.stack((one, other), -1)[place[:-apart] == place[apart:]], axis=0)
        for a, b in met:
            angle = np.degrees(np.arccos(min(abs(float(planes[a].normal @ planes[b].normal)), 1.0)))
            if BENT[0] < angle < BENT[1]:
                bent[[a, b]] = True
    return bent


def _is_curved(plane: Plane, points: Float64Array, weight: Float64Array) -> bool:
    """Whether points of a plane lie better on a paraboloid."""
    along = np.linalg.svd(plane.normal[None])[2][1:]
    centred = points - points.mean(0)
    x, y = (centred @ along.T / np.abs(centred).max()).T
    root = np.sqrt(weight)
    terms = root[:, None] * np.stack((np.ones_like(x), x, y, x * x, x * y, y * y), -1)
    height = root * plane.height(points)
    rest = height - terms @ np.linalg.lstsq(terms, height, rcond=None)[0]
    return bool(np.square(rest).sum() <= (1.0 - CURVED) * np.square(height).sum())


# ---------------------- Onto them ----------------------


def _steps(surface: _Surface, normals: Float64Array, offsets: Float64Array, label: IntArray) -> Float64Array:
    """How far each place is moved [places, 3]: onto all planes of its triangles, the shortest way. What lies near goes
    along, less with the distance, so that small triangles at the border do not fold.
    """
    from scipy.spatial import cKDTree  # imported where it is needed: it loads slowly

    points, count = surface.points, len(surface.points)
    flat = label >= 0
    pairs = np.unique(surface.place[flat] * len(normals) + label[flat, None])
    place, plane = pairs // len(normals), pairs % len(normals)
    normal = normals[plane]
    height = (points[place] * normal).sum(-1) - offsets[plane]
    square, right = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(square, place, normal[:, :, None] * normal[:, None])
    np.add.at(right, place, -height[:, None] * normal)
    on = np.unique(place)
    size, axis = np.linalg.eigh(square[on])
    inverse = np.where(size > APART, 1.0 / np.maximum(size, APART), 0.0)
    step = np.zeros((count, 3))
    step[on] = np.einsum("nij,nj,nkj,nk->ni", axis, inverse, axis, right[on])
    # ---- what lies near goes along
    free = np.ones(count, bool)
    free[on] = False
    way = np.linalg.norm(step[on], axis=-1)
    reach = 4.0 * float(way.max())
    distance, nearest = cKDTree(points[on]).query(points[free], distance_upper_bound=max(reach, 1e-30))
    found = np.isfinite(distance)
    rows = np.flatnonzero(free)[found]
    step[rows] = step[on[nearest[found]]] * (1.0 - distance[found] / max(reach, 1e-30))[:, None]
    return step


def _moved(mesh: Mesh, place: IntArray, step: Float64Array, label: IntArray, normals: Float64Array) -> Mesh:
    """A mesh with its vertices moved, and the normals of planes; vertices at their borders are there twice then.

    Args:
        mesh: with triangles [f, 3].
        place: of their corners [f, 3], by which ``step`` [places, 3] is numbered.
        label: the plane of each triangle [f], -1 for none.
        normals: of planes [p, 3].
    """
    of_vertex = np.zeros(len(mesh.vertices), np.int64)
    used = np.zeros(len(mesh.vertices), bool)
    of_vertex[mesh.faces], used[mesh.faces] = place, True
    shift = np.where(used[:, None], step[of_vertex], 0.0)
    if not shift.any() and not (label >= 0).any():
        return mesh
    mesh = replace(mesh, vertices=(mesh.vertices + shift).astype(mesh.vertices.dtype), as_read=mesh.vertices)
    if mesh.normals is None or not (label >= 0).any():
        return mesh
    # ---- a vertex for each side of a plane that it is on, whose normal faces as those of the triangle did
    facing = (mesh.normals[mesh.faces].sum(1) * normals[label]).sum(-1) < 0.0
    sides = 2 * len(normals) + 1
    side = np.where(label >= 0, 2 * label + facing + 1, 0)
    key, corner = np.unique(mesh.faces.astype(np.int64) * sides + side[:, None], return_inverse=True)
    vertex, side = key // sides, key % sides
    first = np.concatenate(([True], vertex[1:] != vertex[:-1]))
    number = np.where(first, vertex, len(mesh.vertices) - 1 + np.cumsum(~first))
    chosen = np.concatenate((np.arange(len(mesh.vertices)), vertex[~first]))
    made = mesh.of_vertices(chosen, number[corner.reshape(-1)].reshape(-1, 3).astype(mesh.faces.dtype))
    assert made.normals is not None
    of_side = np.stack((normals, -normals), 1).reshape(-1, 3).astype(made.normals.dtype)
    turned = made.normals.copy()
    turned[number[side > 0]] = of_side[side[side > 0] - 1]
    return replace(made, normals=turned)
