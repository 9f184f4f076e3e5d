"""Polygons as triangles, and how many triangles a scene may have."""

import numpy as np
import numpy.typing as npt

from neurad.core.errors import InputError
from neurad.core.groups import group_sums
from neurad.core.records import Float64Array, IntArray

MAX_TRIANGLES = 1 << 25
"""Triangles that copies, subdivision and polygons may make of a file: about 20 GB while a scene is built."""

_FLAT = 1e-6
"""Part of a polygon's area below which a triangle has none, by the rounding of 32-bit coordinates."""
_CROSSES = 1e-3
"""Part of the area of a polygon's fan by which its triangles differ from it only if its edges cross."""


def check_triangle_count(count: int, where: str) -> None:
    """Refuse more triangles than a scene may have, before they are made."""
    if count > MAX_TRIANGLES:
        raise InputError(
            f"{where}: it would have {count} triangles with all copies and subdivision, of at most {MAX_TRIANGLES}; "
            "leave out copies, or reduce the mesh in the program that it comes from"
        )


def triangulate_polygons(corners: npt.ArrayLike, counts: npt.ArrayLike) -> tuple[IntArray, IntArray]:
    """Polygons as triangles of the same winding, in the order of the polygons.

    A polygon that a fan around its first corner covers once, as every convex one, becomes that fan. Others are cut by
    earcut in the plane of their Newell normal, and may then have fewer triangles: corners on a straight line and
    repeated ones take none. A hole is part of its polygon by a bridge of two equal edges.

    Args:
        corners: positions of the corners, polygon after polygon [c, 3].
        counts: corners of each polygon [p]; those with fewer than three have no triangle.

    Returns:
        Places among all corners [f, 3], and the polygons whose edges cross, of which no triangles have the area [k].
    """
    points = np.asarray(corners, np.float64).reshape(-1, 3)
    sizes = np.asarray(counts, np.int64)
    first, made = np.cumsum(sizes) - sizes, np.maximum(sizes - 2, 0)
    polygon = np.repeat(np.arange(len(sizes)), made)
    step = np.arange(len(polygon)) - np.repeat(np.cumsum(made) - made, made)
    fans = first[polygon][:, None] + np.stack((np.zeros_like(step), step + 1, step + 2), -1)
    several = np.flatnonzero(sizes[polygon] > 3)
    a, b, c = points[fans[several].T]
    cross, at = np.cross(b - a, c - a), polygon[several]
    normal = group_sums(cross, at, len(sizes))  # Newell's, twice the area long
    length = np.linalg.norm(normal, axis=-1)
    extent = np.bincount(at, np.linalg.norm(cross, axis=-1), len(sizes))
    turned = np.einsum("ij,ij->i", cross, normal[at]) < -_FLAT * length[at] * extent[at]
    bent = np.unique(at[turned | ((length <= _FLAT * extent) & (extent > 0))[at]])
    if len(bent) == 0:
        return fans, bent
    parts, wrong = zip(*(_cut(points[first[i] : first[i] + sizes[i]], normal[i], extent[i]) for i in bent), strict=True)
    keep = ~np.isin(polygon, bent)
    owner = np.concatenate((polygon[keep], np.repeat(bent, [len(part) for part in parts])))
    placed = [part + first[i] for i, part in zip(bent, parts, strict=True)]
    triangles: IntArray = np.concatenate((fans[keep], *placed))[np.argsort(owner, kind="stable")]
    return triangles, bent[np.array(wrong)]


def _cut(points: Float64Array, normal: Float64Array, extent: float) -> tuple[IntArray, bool]:
    """A polygon [n, 3] as triangles that turn as its Newell normal does [f, 3], and whether its edges cross.

    ``extent`` is twice the area of its fan.
    """
    import mapbox_earcut  # at first use: few files have such polygons

    middle = points - points.mean(0)
    length = float(np.linalg.norm(normal))
    up = normal / length if length > 0 else np.linalg.svd(middle, full_matrices=False)[2][2]
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    flat = np.ascontiguousarray(middle @ np.stack((side, np.cross(up, side)), -1))
    found = mapbox_earcut.triangulate_float64(flat, np.array([len(flat)], np.uint32)).astype(np.int64).reshape(-1, 3)
    (ux, uy), (vx, vy) = (flat[found[:, 1]] - flat[found[:, 0]]).T, (flat[found[:, 2]] - flat[found[:, 0]]).T
    doubled = ux * vy - uy * vx
    wrong = abs(float(np.abs(doubled).sum()) - length) > _CROSSES * extent
    return np.where((doubled < 0)[:, None], found[:, ::-1], found), wrong
