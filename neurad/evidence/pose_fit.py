"""Poses of photographs, refined by what photographs show of the same surfaces and of the edges of the mesh.

Nothing has to be recovered for it. Two photographs of a textured patch lie beside each other by an offset that is
linear in small motions of both cameras, see :mod:`neurad.evidence.texture_offsets`. That alone lets all cameras drift
together: textures slide over walls. Edges of the mesh hold them: where a camera sees one, its photograph has an edge,
too. Both together are a robust least squares problem in six numbers a camera, and in two that all photographs of a lens
share, its focal length and k1. A normal prior, whose deviations are estimated from what is found (empirical Bayes),
keeps what no photograph tells as it was.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from scipy import sparse

from neurad.core.camera import pixel_side
from neurad.core.lens import fold
from neurad.core.protocols import PhotographedPixels
from neurad.core.records import BoolArray, Float64Array, FloatArray, IntArray
from neurad.core.robust import robust_deviation
from neurad.core.scene_records import Camera
from neurad.evidence.camera_motion import OWN, SHARED, apart, derivatives, moved
from neurad.evidence.edge_fit import WIDTH, edge_fit, edge_view, inside
from neurad.evidence.edge_offsets import edge_offsets
from neurad.evidence.offset_table import NAMED, TextureOffsets
from neurad.evidence.smaller_photographs import SmallerPhotographs, smaller
from neurad.evidence.texture_offsets import REACH, SIDE, texture_offsets
from neurad.integrators.world import World
from neurad.runtime.reading import listed

SURE = 0.2
"""Pixels of disagreement below which poses are kept: exact ones have at most 0.11, see docs/your-room.md."""
ROUNDS = 3
"""Times that offsets are measured and cameras moved, on photographs as they are ..."""
COARSEST = 3 * SIDE
"""... after one round on each smaller size of an image pyramid whose sides have so many pixels at least: there poses
that are far off are within the reach of a patch."""
LOOSE = 0.4
"""Standard error in pixels of an offset that counts here: many offsets that are a little known place cameras best."""
FLOOR = 0.03
"""Pixels that an offset is off by at least, however sure it is: what bilinear values are wrong by."""
FEWEST = 50
"""Offsets of textures and edges that a photograph must have to be moved."""
ALIKE = 8.0
"""Neighbouring places on an edge that are off by the same: so many count as one."""
_REWEIGHTED = 30


@dataclass(frozen=True)
class PoseFit:
    """What became of the poses."""

    cameras: list[Camera]
    before: TextureOffsets
    """How far photographs lay beside each other ..."""
    after: TextureOffsets
    """... and lie now, on patches that were not fitted to."""
    moved: FloatArray
    """Pixels that the picture of each camera moved by, the median [views]; 0 where it was kept."""
    too_far: tuple[int, ...] = ()
    """Cameras that were kept because they would have moved by more than the ``bound``."""
    unknown: tuple[int, ...] = ()
    """Cameras that were kept because their photographs show too few textures and edges."""
    bound: float = REACH
    """Pixels that pictures may move by: those that patches reach on the smallest pictures."""
    lenses: list[tuple[int, float, float]] = field(default_factory=list)
    """Photographs of each lens, by what its focal length became longer, and by how much its k1 became larger."""

    def sentences(self, names: Sequence[str]) -> list[str]:
        """What was done, in words."""
        if not self.moved.any() and math.isnan(self.before.pixels):
            return ["poses are kept: too few textures are shown by several photographs to refine them"]
        if not self.moved.any():
            said = [f"poses are kept: photographs disagree by {self.before.pixels:.2f} pixels"]
        else:
            was, now = (
                "share too few textures" if math.isnan(found.pixels) else f"disagree by {found.pixels:.2f} pixels"
                for found in (self.before, self.after)
            )
            said = [
                f"poses refined: pictures moved by {float(np.median(self.moved[self.moved > 0])):.2f} pixels (median), "
                f"up to {float(self.moved.max()):.2f}; as given photographs {was}, refined they {now}"
            ]
            said += [
                f"lens of {photographs} photographs: focal length x {longer:.4f}, k1 {bent:+.4f}"
                for photographs, longer, bent in self.lenses
                if (longer, bent) != (1.0, 0.0)
            ]
        if self.unknown:
            said.append(f"{len(self.unknown)} poses are kept: their photographs show too few textures and edges")
        if self.too_far:
            which, bound = listed([names[i] for i in self.too_far], NAMED), f"{self.bound:g} pixels"
            said.append(f"warning: kept as they are, would move by more than {bound}: {which}; check them")
        return said


@torch.no_grad()
def fit_poses(world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int) -> PoseFit:
    """Refine the poses and lenses of photographs; those that disagree by less than :data:`SURE` pixels are kept."""
    given, count, none = list(cameras), len(cameras), np.zeros(len(cameras), np.float32)
    before = texture_offsets(world, given, photographs, seed, views=count).summary(count)
    if before.pixels < SURE and not before.beside:
        return PoseFit(given, before, before, none)
    unknowns = _Unknowns.of(given)
    present, total, known = given, np.zeros(len(unknowns.kind)), np.ones(count, bool)
    coarser = _halvings(given)
    for number, by in enumerate((*(2**i for i in range(coarser, 0, -1)), *[1] * ROUNDS)):
        pictures = SmallerPhotographs(photographs, given, by) if by > 1 else photographs
        width = max(camera.width for camera in given) // by
        if width < 2 * WIDTH and (by == 1 or width >= WIDTH):  # a camera that other edges have caught would stay there
            turn = np.zeros(len(total))
            turn[: OWN * count] = _turns(world, [smaller(camera, by) for camera in present], pictures, seed).ravel()
            present = unknowns.moved(present, turn)
            total += turn
        cameras = [smaller(camera, by) for camera in present]
        rows, offsets, variance, shown = _equations(world, cameras, pictures, unknowns, seed + 1 + number)
        enough = shown >= FEWEST
        known &= enough | (by > 1)  # smaller pictures have fewer edges
        step = _solved(rows, offsets, variance, total, unknowns.kind, unknowns.free(known & enough))
        if any(_folds(camera) for camera in unknowns.moved(given, total + step)):
            step[OWN * count :] = 0.0
        present = unknowns.moved(present, step)
        total += step
    bound = REACH * 2.0**coarser
    total = unknowns.of_lenses(total, given)
    kept = unknowns.moved(given, total)  # but for their lenses, which other photographs tell
    present = [replace(a, fov_x=b.fov_x, lens=b.lens) for a, b in zip(present, kept, strict=True)]
    away = np.array([apart(a, b, world) for a, b in zip(given, present, strict=True)], np.float32)
    too_far = tuple(int(i) for i in np.flatnonzero(away > bound))
    unknown = tuple(int(i) for i in np.flatnonzero(~known))
    for view in {*too_far, *unknown}:
        present[view], away[view] = kept[view], 0.0
    far, near = (_median_offset(world, cameras, photographs, unknowns, seed) for cameras in (given, present))
    if not near < far:
        return PoseFit(given, before, before, none, too_far, unknown, bound)
    after = texture_offsets(world, present, photographs, seed, views=count).summary(count)
    return PoseFit(present, before, after, away, too_far, unknown, bound, unknowns.lenses(total))


@dataclass(frozen=True)
class _Unknowns:
    """What is solved for: the pose of each camera, and what lenses do that take photographs of one size."""

    number: IntArray
    """Which of the unknowns each number of :func:`moved` is, for each camera [views, 8]."""
    kind: IntArray
    """What each unknown is: a turn, a way, a focal length, or k1."""

    @classmethod
    def of(cls, cameras: Sequence[Camera]) -> "_Unknowns":
        """Six for each camera, and two for each size of photographs and kind of lens."""
        own = OWN * len(cameras)
        found: dict[tuple[int, int, bool], int] = {}
        lens = [found.setdefault((c.width, c.height, c.lens.fisheye), len(found)) for c in cameras]
        shared = own + SHARED * np.array(lens)[:, None] + np.arange(SHARED)
        kind = np.concatenate((np.tile([0, 0, 0, 1, 1, 1], len(cameras)), np.tile([2, 3], len(found))))
        return cls(np.concatenate((np.arange(own).reshape(-1, OWN), shared), 1), kind)

    def moved(self, cameras: Sequence[Camera], step: Float64Array) -> list[Camera]:
        """Cameras after a change of the unknowns."""
        return [moved(camera, change) for camera, change in zip(cameras, step[self.number], strict=True)]

    def free(self, known: BoolArray) -> BoolArray:
        """Unknowns that change where these cameras may move [views]: theirs, and those of their lenses."""
        found = np.zeros(len(self.kind), bool)
        found[self.number[known]] = True
        return found

    def of_lenses(self, total: Float64Array, cameras: Sequence[Camera]) -> Float64Array:
        """What a change of the unknowns does to lenses alone, as far as it moves corners of some camera's film by
        :data:`FLOOR` pixels or more: to take a distortion back costs time.
        """
        found = np.zeros_like(total)
        for numbers, camera in zip(self.number[:, OWN:], cameras, strict=True):
            corner = 0.5 * math.hypot(camera.width, camera.height)
            moves = np.abs(total[numbers]) * (corner, corner * (corner / camera.fl_x) ** 2)
            found[numbers] = np.where(moves >= FLOOR, total[numbers], found[numbers])
        return found

    def lenses(self, total: Float64Array) -> list[tuple[int, float, float]]:
        """Photographs of each lens, by what its focal length became longer, and by how much its k1 became larger."""
        first, photographs = np.unique(self.number[:, OWN], return_counts=True)
        return [(int(n), math.exp(total[i]), float(total[i + 1])) for i, n in zip(first, photographs, strict=True)]


def _folds(camera: Camera) -> bool:
    return fold(camera.lens, pixel_side(camera), camera.width, camera.height) is not None


def _halvings(cameras: Sequence[Camera]) -> int:
    """How often sides of all pictures can be halved."""
    side = min(min(camera.width, camera.height) for camera in cameras)
    return max(int(math.log2(max(side / COARSEST, 1.0))), 0)


def _turns(world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int) -> Float64Array:
    """Motions [views, 6] that turn cameras whose photographs do not fit the edges of the mesh, where most others do, to
    where they fit them best.
    """
    motions, fitting, left_out = np.zeros((len(cameras), 6)), 0, photographs.ignored()
    for view, camera in enumerate(cameras):
        pixel = torch.arange(camera.width * camera.height)
        shown = photographs.colors(torch.full_like(pixel, view), pixel).view(camera.height, camera.width, 3)
        ranks, resized, towards = edge_view(world, camera, shown.cpu().numpy(), seed)
        if left_out is not None:
            kept = ~left_out[view, : len(pixel)].view(camera.height, camera.width).cpu().numpy()
            towards = towards[inside(kept, camera, towards)]
        fit = edge_fit(ranks, resized, towards)
        if fit is not None and fit.fits:
            fitting += 1
        elif fit is not None:
            motions[view, :3] = fit.angles
    return motions if 2 * fitting > len(cameras) else np.zeros_like(motions)


def _equations(
    world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, unknowns: _Unknowns, seed: int
) -> tuple[sparse.csr_matrix, Float64Array, Float64Array, Float64Array]:
    """Rows of the least squares problem [n, unknowns], their right sides and variances [n], and how many of them each
    view has [views].
    """
    count = len(cameras)
    table = texture_offsets(world, cameras, photographs, seed, precise=LOOSE, views=count)
    along, change = table.along.numpy(), table.change.numpy()
    blocks: list[tuple[Any, Float64Array, int]] = []  # numbers of rows, their eight columns, the view
    for view, camera in enumerate(cameras):
        for which, sign in ((table.first, -1.0), (table.second, 1.0)):
            mine = np.flatnonzero((which == view).numpy())
            slope = sign * derivatives(camera, table.place[mine])
            if sign > 0:
                slope = np.linalg.solve(change[mine], slope)
            blocks.append((mine, (along[mine, None] @ slope)[:, 0], view))
    offsets, variance = [table.offset.numpy()], [table.error.numpy() ** 2 + FLOOR**2]
    first, edges, left_out = len(table.offset), list[Float64Array](), photographs.ignored()
    for view, camera in enumerate(cameras):
        slope, offset = edge_offsets(world, camera, view, photographs, left_out, seed)
        blocks.append((first + np.arange(len(offset)), slope, view))
        edges.append(offset)
        first += len(offset)
    every = np.concatenate(edges)
    spread = robust_deviation(every, float(np.median(every))) if len(every) else 1.0
    offsets.append(every)
    variance.append(np.full(len(every), ALIKE * spread**2))
    at = np.concatenate([np.repeat(rows, OWN + SHARED) for rows, _, _ in blocks])
    columns = np.concatenate([np.tile(unknowns.number[view], len(rows)) for rows, _, view in blocks])
    values = np.concatenate([slope.ravel() for _, slope, _ in blocks])
    rows = sparse.csr_matrix((values, (at, columns)), (first, len(unknowns.kind)))  # adds up what two photographs share
    shown = np.array([int(table.of(view).sum()) + len(edges[view]) for view in range(count)], np.float64)
    return rows, np.concatenate(offsets), np.concatenate(variance), shown


def _median_offset(
    world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, unknowns: _Unknowns, seed: int
) -> float:
    """Median size of the offsets of textures and edges in pixels; infinite where there is none."""
    _, offsets, _, _ = _equations(world, cameras, photographs, unknowns, seed)
    return float(np.median(np.abs(offsets))) if len(offsets) else math.inf


def _solved(
    rows: sparse.csr_matrix, offsets: Float64Array, variance: Float64Array, total: Float64Array, kind: IntArray,
    free: BoolArray,
) -> Float64Array:  # fmt: skip
    """Changes of all unknowns [m] by Geman and McClure's estimate (1985) and a normal prior around the cameras as they
    were given. Its weights fall to nothing: else borders of textures and shadows beside edges of the mesh would
    pull at all cameras alike.

    Args:
        rows: of the problem [n, m].
        offsets: right sides [n].
        variance: of these [n].
        total: what has been changed already [m].
        kind: the first of which is a turn; each has a prior of its own [m].
        free: what may change [m].
    """
    made = np.zeros(len(total))
    if not free.any():
        return made
    inner, weight, before = rows[:, np.flatnonzero(free)], 1.0 / variance, total[free]
    kinds, kind = np.unique(kind[free], return_inverse=True)
    # The prior begins wide: a degree, and what moves pictures as much.
    moves = np.array([float(np.abs(inner[:, kind == i].data).mean()) for i in range(len(kinds))])
    deviation = math.radians(1.0) * moves[0] / np.maximum(moves, 1e-12)
    step = np.zeros(len(before))
    for _ in range(_REWEIGHTED):
        precision = deviation[kind] ** -2.0
        normal = (inner.T @ inner.multiply(weight[:, None]).tocsr()).toarray()
        covariance = np.linalg.inv(normal + np.diag(precision))
        step = covariance @ (inner.T @ (weight * offsets) - precision * before)
        weight = 1.0 / (variance * (1.0 + (offsets - inner @ step) ** 2 / variance) ** 2)
        square = (before + step) ** 2 + np.diag(covariance)
        deviation = np.sqrt(np.maximum(np.bincount(kind, square) / np.bincount(kind), 1e-30))
    made[free] = step
    return made
