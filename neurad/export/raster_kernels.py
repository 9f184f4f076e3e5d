"""Kernels over the texels of a mesh's texture: which triangle and chart they belong to, and where on it they lie.

Texture space is measured in texels: x to the right and y down the rows from 0 to width and height, texel (row j, column
i) has its centre at (i + 0.5, j + 0.5). All release the interpreter lock and run on the calling thread.
"""

import math
from typing import Any

from neurad.core.records import Array, IntArray
from neurad.runtime.jit import inlined, kernel


@inlined
def _outside(ax: Any, ay: Any, bx: Any, by: Any, cx: Any, cy: Any, x: Any, y: Any, reach: Any) -> Any:
    """Whether the line through a and b separates the triangle a, b, c from the square around (x, y)."""
    nx, ny = by - ay, ax - bx
    at = nx * ax + ny * ay
    side = nx * cx + ny * cy - at
    here = nx * x + ny * y - at
    if side < 0.0:
        here = -here
    return here < -reach * (abs(nx) + abs(ny))


@inlined
def _corners(corners: Any, f: Any) -> Any:
    return corners[f, 0, 0], corners[f, 0, 1], corners[f, 1, 0], corners[f, 1, 1], corners[f, 2, 0], corners[f, 2, 1]


@inlined
def _inside(ax: Any, ay: Any, bx: Any, by: Any, cx: Any, cy: Any, x: Any, y: Any, det: Any) -> Any:
    """How far (x, y) is inside of all edges of the triangle a, b, c, whose area is ``det`` / 2; below 0 outside."""
    sign = 1.0 if det > 0.0 else -1.0
    return min(
        sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)),
        sign * ((cx - bx) * (y - by) - (cy - by) * (x - bx)),
        sign * ((ax - cx) * (y - cy) - (ay - cy) * (x - cx)),
    )


@kernel
def conflicts(
    corners: Array, chart: IntArray, reach: float, needed: Array, owner: Array
) -> Any:  # pragma: no cover - compiled
    """How many texels two charts need, and how many two triangles own.

    A chart needs the texels within ``reach`` of it in both axes: a bilinear lookup reads those within one. The texture
    repeats, so what leaves it on one side is needed on the other. A triangle owns the texels whose centres lie inside.

    Args:
        corners: of the triangles [f, 3, 2].
        chart: of the triangles [f].
        reach: in texels.
        needed: -1 everywhere; filled with the charts [h, w].
        owner: -1 everywhere; filled with the triangles [h, w].
    """
    height, width = needed.shape
    twice, overlap = 0, 0
    for f in range(len(corners)):
        ax, ay, bx, by, cx, cy = _corners(corners, f)
        det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        x0, x1 = math.floor(min(ax, bx, cx) - reach - 0.5), math.ceil(max(ax, bx, cx) + reach - 0.5)
        y0, y1 = math.floor(min(ay, by, cy) - reach - 0.5), math.ceil(max(ay, by, cy) + reach - 0.5)
        for row in range(y0, y1 + 1):
            y = row + 0.5
            if y <= min(ay, by, cy) - reach or y >= max(ay, by, cy) + reach:
                continue
            for column in range(x0, x1 + 1):
                x = column + 0.5
                if x <= min(ax, bx, cx) - reach or x >= max(ax, bx, cx) + reach:
                    continue
                if (
                    _outside(ax, ay, bx, by, cx, cy, x, y, reach)
                    or _outside(bx, by, cx, cy, ax, ay, x, y, reach)
                    or _outside(cx, cy, ax, ay, bx, by, x, y, reach)
                ):
                    continue
                j, i = row % height, column % width
                if needed[j, i] < 0:
                    needed[j, i] = chart[f]
                elif needed[j, i] != chart[f]:
                    twice += 1
                inside = _inside(ax, ay, bx, by, cx, cy, x, y, det)
                if inside > 1e-3 * abs(det):
                    if owner[j, i] < 0:
                        owner[j, i] = f
                    else:
                        overlap += 1
    return twice, overlap


@inlined
def _to_segment(ax: Any, ay: Any, bx: Any, by: Any, x: Any, y: Any) -> Any:
    """Squared distance from (x, y) to the segment from a to b, and how far along it the nearest point is, 0 to 1."""
    dx, dy = bx - ax, by - ay
    length = dx * dx + dy * dy
    t = 0.0
    if length > 0.0:
        t = min(max(((x - ax) * dx + (y - ay) * dy) / length, 0.0), 1.0)
    ex, ey = x - ax - t * dx, y - ay - t * dy
    return ex * ex + ey * ey, t


@kernel
def nearest(
    corners: Array, chosen: IntArray, slot: Array, top: int, per: int, reach: float, distance: Array, owner: IntArray
) -> None:  # pragma: no cover - compiled
    """The nearest triangle of every sample in some texels of a texture, ``per`` x ``per`` of them in each.

    Args:
        corners: of all triangles [f, 3, 2].
        chosen: those to look at [k].
        slot: where the samples of a texel stand in ``distance`` and ``owner``, -1 for texels to pass over [rows, w].
        top: row of the texture that is the first of ``slot``.
        per: samples along the side of a texel, row by row.
        reach: largest distance in texels.
        distance: squared distances found so far, ``reach`` squared or less [n, per * per].
        owner: the triangle of each, -1 for none; both are written to [n, per * per].
    """
    rows, columns = slot.shape
    for k in range(len(chosen)):
        f = chosen[k]
        ax, ay, bx, by, cx, cy = _corners(corners, f)
        det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
        x0 = max(math.floor(min(ax, bx, cx) - reach), 0)
        x1 = min(math.floor(max(ax, bx, cx) + reach), columns - 1)
        y0 = max(math.floor(min(ay, by, cy) - reach) - top, 0)
        y1 = min(math.floor(max(ay, by, cy) + reach) - top, rows - 1)
        for row in range(y0, y1 + 1):
            for column in range(x0, x1 + 1):
                n = slot[row, column]
                if n < 0:
                    continue
                for s in range(per * per):
                    if distance[n, s] <= 0.0 and owner[n, s] >= 0:
                        continue
                    x, y = column + (s % per + 0.5) / per, row + top + (s // per + 0.5) / per
                    inside = _inside(ax, ay, bx, by, cx, cy, x, y, det)
                    if det != 0.0 and inside >= 0.0:
                        found = 0.0
                    else:
                        found = min(
                            _to_segment(ax, ay, bx, by, x, y)[0],
                            _to_segment(bx, by, cx, cy, x, y)[0],
                            _to_segment(cx, cy, ax, ay, x, y)[0],
                        )
                    if found < distance[n, s] or (found == 0.0 and owner[n, s] < 0):
                        distance[n, s] = found
                        owner[n, s] = f


@kernel
def locate(
    corners: Array, points: Array, owner: IntArray, x: Array, y: Array, limit: float, u: Array, v: Array
) -> None:  # pragma: no cover - compiled
    """Barycentrics of samples in the triangles that own them, beyond the edges too: in the plane of the triangle.

    What lies outside is taken back to the nearest point of the triangle where extrapolation would move it further than
    ``limit`` for each texel: slivers, whose plane is known along one direction only.

    Args:
        corners: in texture space [f, 3, 2].
        points: in space [f, 3, 3].
        owner: triangles [n].
        x: of the samples in texture space [n], as ``y``.
        limit: scene units a texel.
        u: filled with the first barycentric [n].
        v: filled with the second [n].
    """
    for n in range(len(owner)):
        f = owner[n]
        ax, ay = corners[f, 0, 0], corners[f, 0, 1]
        bx, by, cx, cy = corners[f, 1, 0] - ax, corners[f, 1, 1] - ay, corners[f, 2, 0] - ax, corners[f, 2, 1] - ay
        px, py = x[n] - ax, y[n] - ay
        det = bx * cy - cx * by
        b, c = -1.0, -1.0
        if det != 0.0:
            b, c = (px * cy - cx * py) / det, (bx * py - px * by) / det
            if b >= 0.0 and c >= 0.0 and b + c <= 1.0:
                u[n], v[n] = b, c
                continue
        # The nearest point of the edges
        best, t = _to_segment(0.0, 0.0, bx, by, px, py)
        nb, nc = t, 0.0
        far, t = _to_segment(bx, by, cx, cy, px, py)
        if far < best:
            best, nb, nc = far, 1.0 - t, t
        far, t = _to_segment(cx, cy, 0.0, 0.0, px, py)
        if far < best:
            best, nb, nc = far, 0.0, 1.0 - t
        u[n], v[n] = nb, nc
        if det != 0.0:
            moved = 0.0
            for k in range(3):
                step = (b - nb) * (points[f, 1, k] - points[f, 0, k]) + (c - nc) * (points[f, 2, k] - points[f, 0, k])
                moved += step * step
            if moved <= limit * limit * best:
                u[n], v[n] = b, c


@kernel
def stack(corners: Array, part: IntArray, depth: IntArray, layer: IntArray) -> None:  # pragma: no cover - compiled
    """Parts of a texture one on top of the other, so that no two of a layer share a texel.

    Args:
        corners: of the triangles [f, 3, 2].
        part: that each belongs to, ascending [f].
        depth: 0 everywhere; filled with how many parts lie on each texel [h, w].
        layer: filled with the layer of each triangle [f].
    """
    height, width = depth.shape
    begin = 0
    while begin < len(corners):
        end = begin
        while end < len(corners) and part[end] == part[begin]:
            end += 1
        top = 0
        for writes in range(2):
            for f in range(begin, end):
                ax, ay, bx, by, cx, cy = _corners(corners, f)
                det = (bx - ax) * (cy - ay) - (cx - ax) * (by - ay)
                for row in range(max(math.floor(min(ay, by, cy)), 0), min(math.ceil(max(ay, by, cy)), height)):
                    for column in range(max(math.floor(min(ax, bx, cx)), 0), min(math.ceil(max(ax, bx, cx)), width)):
                        x, y = column + 0.5, row + 0.5
                        inside = _inside(ax, ay, bx, by, cx, cy, x, y, det)
                        if inside > 1e-3 * abs(det):
                            if writes == 0:
                                top = max(top, depth[row, column])
                            else:
                                depth[row, column] = top + 1
        for f in range(begin, end):
            layer[f] = top
        begin = end
