"""Planes of scanned surfaces, as Schnabel et al. 2007 find shapes.

Candidates come from small patches; the one with most of the surface is taken first, and of it connected pieces that are
large enough. A surface is of a plane within three standard deviations of the scan's errors, which are those of its
clearest planes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from neurad.core.records import BoolArray, Float64Array, IntArray
from neurad.core.robust import NORMAL
from neurad.core.scene_records import Mesh
from neurad.scene.connected import joined_places, welded_corners
from neurad.scene.triangles import merged, normals_and_areas

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
class Surface:
    """Triangles of all meshes."""

    points: Float64Array
    """Places [p, 3]."""
    place: IntArray
    """Number of the place of each corner of a triangle [f, 3]."""
    normal: Float64Array
    """[f, 3]."""
    area: Float64Array
    """[f]."""

    def on_planes(self, label: IntArray) -> tuple[IntArray, IntArray]:
        """Places and the planes of their triangles, each pair once, ascending [n]; ``label`` as of
        :func:`find_planes`.
        """
        flat, count = label >= 0, int(label.max(initial=0)) + 1
        pairs = np.unique(self.place[flat] * count + label[flat, None])
        return pairs // count, pairs % count

    @property
    def smallest(self) -> float:
        """Area of a plane."""
        return float((2.0 * REACH) ** 2 * self.area.sum())


def surface_of(meshes: Sequence[Mesh]) -> Surface:
    """The triangles of meshes, vertices at one place joined."""
    points, faces, _ = merged(meshes)
    place = welded_corners(points.astype(np.float32), faces)
    places = np.zeros((int(place.max()) + 1, 3))
    places[place] = points[faces]
    return Surface(places, place, *normals_and_areas(points[faces]))


def _sampled(surface: Surface, rng: np.random.Generator) -> _Sampled:
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
            inside = distance <= 2.5 * NORMAL * float(np.median(distance))
        else:
            planes.append(plane)
    return _Sampled(points, chosen, surface.normal[chosen], planes)


def find_planes(surface: Surface, seed: int = 0) -> tuple[list[Plane], IntArray]:
    """The planes, the largest first, and which of them each triangle is on [f], -1 for none; of bent surfaces none.

    Args:
        seed: of the patches that are looked at.
    """
    planes, label = _all_planes(surface, _sampled(surface, np.random.default_rng(seed)))
    label[_is_bent(surface, planes, label)[label]] = -1
    return planes, label


def _all_planes(surface: Surface, sampled: _Sampled) -> tuple[list[Plane], IntArray]:
    """As :func:`find_planes`, with bent surfaces."""
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


def _within(surface: Surface, sampled: _Sampled, within: _Within) -> tuple[list[Plane], IntArray]:
    """As :func:`_all_planes`, of what lies at most so far from them."""
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
        for piece in _pieces(surface, plane, within, (label < 0) & (surface.area > 0.0)):
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


def _pieces(surface: Surface, plane: Plane, within: _Within, free: BoolArray) -> Iterator[IntArray]:
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


def _is_bent(surface: Surface, planes: Sequence[Plane], label: IntArray) -> BoolArray:
    """Which planes go on in another one, a little turned, as strips of a pipe do [planes + 1]; the last one is none."""
    bent = np.zeros(len(planes) + 1, bool)
    place, plane = surface.on_planes(label)
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
