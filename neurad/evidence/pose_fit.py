"""Poses of photographs, refined by what photographs show of the same surfaces and of the edges of the mesh.

Nothing has to be recovered for it. Two photographs of a textured patch lie beside each other by an offset that is
linear in small motions of both cameras, see :mod:`neurad.evidence.texture_offsets`. That alone lets all cameras drift
together: textures slide over walls. Edges of the mesh hold them: where a camera sees one, its photograph has an edge,
too. Both together are a robust least squares problem in six numbers a camera, with a normal prior whose deviations are
estimated from what is found (empirical Bayes): what no photograph tells stays as it was.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy import sparse
from scipy.spatial.transform import Rotation
from torch import Tensor

from neurad.core.camera import camera_rays, project, to_camera
from neurad.core.protocols import PhotographedPixels
from neurad.core.records import BoolArray, Float64Array, FloatArray
from neurad.core.robust import robust_deviation
from neurad.core.scene_records import Camera
from neurad.evidence.edge_fit import EDGES, WIDTH, compared, directions, edge_fit, inside
from neurad.evidence.mesh_edges import mesh_edges, primary_grid
from neurad.evidence.offset_table import NAMED, TextureOffsets
from neurad.evidence.photograph_pairs import brightness_of
from neurad.evidence.smaller_photographs import SmallerPhotographs, smaller
from neurad.evidence.texture_offsets import REACH, SIDE, picture_at, smoothed, texture_offsets
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
FINER = 2
"""Rays along a side of a pixel that tell where edges of the mesh are."""
PROFILE, STEP = 4.0, 0.25
"""Pixels to both sides of an edge of the mesh that are looked at in the photograph, and in which steps. Where another
edge of the mesh lies as near, nobody knows which of the two a photograph shows: neither counts."""
NEAR = 2.0
"""Pixels within which an edge of the photograph is taken for that of the mesh."""
STANDS_OUT = 10.0
"""Times the median squared gradient along that line by which an edge stands out."""
_REWEIGHTED = 30
_SMALL = 1e-4  # of a radian, and of the distances in the room: steps of the derivatives


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
        if self.unknown:
            said.append(f"{len(self.unknown)} poses are kept: their photographs show too few textures and edges")
        if self.too_far:
            which, bound = listed([names[i] for i in self.too_far], NAMED), f"{self.bound:g} pixels"
            said.append(f"warning: kept as they are, would move by more than {bound}: {which}; check them")
        return said


@torch.no_grad()
def fit_poses(world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int) -> PoseFit:
    """Refine the poses of photographs; those that disagree by less than :data:`SURE` pixels are kept."""
    given, count, none = list(cameras), len(cameras), np.zeros(len(cameras), np.float32)
    before = texture_offsets(world, given, photographs, seed, views=count).summary(count)
    if before.pixels < SURE and not before.beside:
        return PoseFit(given, before, before, none)
    present, total, known = given, np.zeros((count, 6)), np.ones(count, bool)
    coarser = _halvings(given)
    for number, by in enumerate((*(2**i for i in range(coarser, 0, -1)), *[1] * ROUNDS)):
        pictures = SmallerPhotographs(photographs, given, by) if by > 1 else photographs
        width = max(camera.width for camera in given) // by
        if width < 2 * WIDTH and (by == 1 or width >= WIDTH):  # a camera that other edges have caught would stay there
            turn = _turns(world, [smaller(camera, by) for camera in present], pictures, seed)
            present = [moved(camera, motion) for camera, motion in zip(present, turn, strict=True)]
            total += turn
        cameras = [smaller(camera, by) for camera in present]
        rows, offsets, variance, shown = _equations(world, cameras, pictures, seed + 1 + number)
        enough = shown >= FEWEST
        known &= enough | (by > 1)  # smaller pictures have fewer edges
        step = _solved(rows, offsets, variance, total, known & enough)
        present = [moved(camera, motion) for camera, motion in zip(present, step, strict=True)]
        total += step
    bound = REACH * 2.0**coarser
    away = np.array([apart(a, b, world) for a, b in zip(given, present, strict=True)], np.float32)
    too_far = tuple(int(i) for i in np.flatnonzero(away > bound))
    unknown = tuple(int(i) for i in np.flatnonzero(~known))
    kept = {*too_far, *unknown}
    present = [a if i in kept else b for i, (a, b) in enumerate(zip(given, present, strict=True))]
    away[list(kept)] = 0.0
    far, near = (_median_offset(world, cameras, photographs, seed) for cameras in (given, present))
    if not near < far:
        return PoseFit(given, before, before, none, too_far, unknown, bound)
    after = texture_offsets(world, present, photographs, seed, views=count).summary(count)
    return PoseFit(present, before, after, away, too_far, unknown, bound)


def _halvings(cameras: Sequence[Camera]) -> int:
    """How often sides of all pictures can be halved."""
    side = min(min(camera.width, camera.height) for camera in cameras)
    return max(int(math.log2(max(side / COARSEST, 1.0))), 0)


def moved(camera: Camera, motion: Float64Array) -> Camera:
    """A camera after a motion in its own axes [6]: turned by a vector of angles, and moved by a vector."""
    pose: Any = np.asarray(camera.to_world, np.float64).copy()
    pose[:3, 3] += pose[:3, :3] @ motion[3:]
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(motion[:3]).as_matrix()
    return replace(camera, to_world=pose)


def derivatives(camera: Camera, points: Tensor) -> Float64Array:
    """How film positions of world points [n, 3] move with the six numbers of :func:`moved` [n, 2, 6], of any lens, by
    central differences.
    """
    points = points.double().cpu()
    scale = float(to_camera(camera, points).norm(dim=-1).median()) if len(points) else 1.0
    steps = _SMALL * np.array([1.0, 1.0, 1.0, scale, scale, scale])
    columns = []
    for index, step in enumerate(steps):
        ends = [moved(camera, sign * step * np.eye(6)[index]) for sign in (1.0, -1.0)]
        above, below = (project(end, to_camera(end, points)) for end in ends)
        columns.append((above - below).numpy() / (2.0 * step))
    return np.asarray(np.stack(columns, -1))


def _turns(world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int) -> Float64Array:
    """Motions [views, 6] that turn cameras whose photographs do not fit the edges of the mesh, where most others do, to
    where they fit them best.
    """
    motions, fitting, left_out = np.zeros((len(cameras), 6)), 0, photographs.ignored()
    for view, camera in enumerate(cameras):
        pixel = torch.arange(camera.width * camera.height)
        shown = photographs.colors(torch.full_like(pixel, view), pixel).view(camera.height, camera.width, 3)
        ranks, resized = compared(shown.cpu().numpy(), camera)
        with world.tracer.uncounted():
            edges = mesh_edges(world, primary_grid(world, camera, min(camera.width, WIDTH)))
        towards = directions(edges, seed)
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
    world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int
) -> tuple[sparse.csr_matrix, Float64Array, Float64Array, Float64Array]:
    """Rows of the least squares problem [n, 6 views], their right sides and variances [n], and how many of them each
    view has [views].
    """
    count = len(cameras)
    table = texture_offsets(world, cameras, photographs, seed, precise=LOOSE, views=count)
    along, change = table.along.numpy(), table.change.numpy()
    blocks: list[tuple[Any, Float64Array, int]] = []  # numbers of rows, their six columns, the view
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
        slope, offset = _edge_rows(world, camera, view, photographs, left_out, seed)
        blocks.append((first + np.arange(len(offset)), slope, view))
        edges.append(offset)
        first += len(offset)
    every = np.concatenate(edges)
    spread = robust_deviation(every, float(np.median(every))) if len(every) else 1.0
    offsets.append(every)
    variance.append(np.full(len(every), ALIKE * spread**2))
    at = np.concatenate([np.repeat(rows, 6) for rows, _, _ in blocks])
    columns = np.concatenate([np.tile(6 * view + np.arange(6), len(rows)) for rows, _, view in blocks])
    values = np.concatenate([slope.ravel() for _, slope, _ in blocks])
    rows = sparse.csr_matrix((values, (at, columns)), (first, 6 * count))
    shown = np.array([int(table.of(view).sum()) + len(edges[view]) for view in range(count)], np.float64)
    return rows, np.concatenate(offsets), np.concatenate(variance), shown


def _median_offset(world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int) -> float:
    """Median size of the offsets of textures and edges in pixels; infinite where there is none."""
    _, offsets, _, _ = _equations(world, cameras, photographs, seed)
    return float(np.median(np.abs(offsets))) if len(offsets) else math.inf


def _solved(
    rows: sparse.csr_matrix, offsets: Float64Array, variance: Float64Array, total: Float64Array,
    known: BoolArray,
) -> Float64Array:  # fmt: skip
    """Motions of all cameras [views, 6] by Geman and McClure's estimate (1985) and a normal prior around the poses as
    they were given. Its weights fall to nothing: else borders of textures and shadows beside edges of the mesh would
    pull at all cameras alike.

    Args:
        rows: of the problem [n, 6 views].
        offsets: right sides [n].
        variance: of these [n].
        total: what cameras have moved already [views, 6].
        known: cameras that may move [views].
    """
    views, weight, free = len(total), 1.0 / variance, np.repeat(known, 6)
    if not known.any():
        return np.zeros((views, 6))
    inner = rows[:, np.flatnonzero(free)]
    before = total.reshape(-1)[free]
    # The prior begins wide: a degree, and the way that moves pictures as much.
    turning, moving = (np.abs(inner[:, np.arange(len(before)) // 3 % 2 == kind].data) for kind in (0, 1))
    degree = math.radians(1.0)
    deviation = np.array([degree, degree * float(turning.mean()) / max(float(moving.mean()), 1e-12)])
    step = np.zeros(len(before))
    for _ in range(_REWEIGHTED):
        precision = np.tile(np.repeat(deviation**-2.0, 3), len(before) // 6)
        normal = (inner.T @ inner.multiply(weight[:, None]).tocsr()).toarray()
        covariance = np.linalg.inv(normal + np.diag(precision))
        step = covariance @ (inner.T @ (weight * offsets) - precision * before)
        weight = 1.0 / (variance * (1.0 + (offsets - inner @ step) ** 2 / variance) ** 2)
        square = ((before + step) ** 2 + np.diag(covariance)).reshape(-1, 2, 3).mean((0, 2))
        deviation = np.sqrt(np.maximum(square, 1e-30))
    made = np.zeros(6 * views)
    made[free] = step
    return made.reshape(views, 6)


def apart(first: Camera, second: Camera, world: World) -> float:
    """Pixels between the pictures of two cameras of the same photograph, the median over surface points."""
    axes = [(torch.arange(16, dtype=torch.float64) + 0.5) / 16 * side for side in (first.width, first.height)]
    xy = torch.cartesian_prod(*axes)
    with world.tracer.uncounted():
        rays = camera_rays(first, xy.float().to(world.geometry.vertices.device))
        si = world.intersect(rays)
    p, valid = si.p.double().cpu(), si.valid.cpu()
    apart = (project(second, to_camera(second, p)) - project(first, to_camera(first, p))).norm(dim=-1)[valid]
    return float(apart.median()) if len(apart) else 0.0


def _edge_rows(
    world: World, camera: Camera, view: int, photographs: PhotographedPixels, left_out: Tensor | None, seed: int
) -> tuple[Float64Array, Float64Array]:
    """Derivatives [n, 6] and offsets [n] in pixels of edges of the photograph beside those of the mesh, across them.
    ``left_out`` are the pixels that masks leave out [views, pixels].
    """
    with world.tracer.uncounted():
        grid = primary_grid(world, camera, FINER * camera.width)
        edges = mesh_edges(world, grid)
    fine, point = edges.place.cpu(), edges.point.cpu().double()
    column, row = fine.long().unbind(-1)
    shape = grid.camera.height, grid.camera.width
    bright = torch.nn.functional.max_pool2d(grid.emits.view(1, 1, *shape).float(), 4 * FINER + 1, 1, 2 * FINER)[0, 0]
    dark = bright.cpu()[row.clamp_max(shape[0] - 1), column.clamp_max(shape[1] - 1)] == 0  # lamps outshine borders
    place = fine.double() / FINER
    margin = PROFILE + 2.0
    size = torch.tensor([camera.width, camera.height])
    inside = ((place > margin) & (place < size - margin)).all(-1) & dark
    place, point = place[inside], point[inside]
    if len(place) > EDGES:
        chosen = torch.randperm(len(place), generator=torch.Generator().manual_seed(seed))[:EDGES]
        place, point = place[chosen], point[chosen]
    if len(place) == 0:
        return np.zeros((0, 6)), np.zeros(0)
    pixel = torch.arange(camera.width * camera.height)
    whole = brightness_of(photographs, None, torch.full_like(pixel, view), pixel, left_out).mean(-1)
    level = 0.1 * float(whole[~whole.isnan()].median()) if bool((~whole.isnan()).any()) else 1.0

    log = (whole + level).log().view(1, 1, camera.height, camera.width)
    picture = smoothed(torch.nn.functional.pad(log, (1, 1, 1, 1), mode="replicate")[0])

    def log_at(xy: Tensor) -> Tensor:
        return picture_at(picture, *(xy - 0.5).unbind(-1))[0]

    # The direction across: that of the photograph's gradients around the place.
    around = torch.cartesian_prod(*[torch.arange(-2.0, 3.0).double()] * 2)
    shown = log_at(place[:, None] + around).view(-1, 5, 5)  # columns, then rows
    slope = 0.5 * torch.stack(
        (shown[:, 2:, 1:-1] - shown[:, :-2, 1:-1], shown[:, 1:-1, 2:] - shown[:, 1:-1, :-2])
    ).flatten(2)
    structure = torch.einsum("imk,jmk->mij", slope, slope)
    good = ~structure.flatten(1).isnan().any(1)
    values, vectors = torch.linalg.eigh(structure.nan_to_num(0.0))
    across = vectors[:, :, 1]
    good &= values[:, 1] > 9.0 * values[:, 0].clamp_min(0.0)  # of one direction
    # The strongest gradient along it
    at = torch.arange(-PROFILE, PROFILE + 0.5 * STEP, STEP, dtype=torch.float64)
    line = log_at(place[:, None] + at[:, None] * across[:, None])
    energy = (line[:, 4:] - line[:, :-4]).square()  # over a pixel
    middle = at[2:-2]
    near = middle.abs() <= NEAR
    peak = energy[:, near].nan_to_num(0.0).max(1)
    weight = energy * torch.exp(-0.5 * ((middle - middle[near][peak.indices][:, None]) / 0.7).square())
    offset = (weight * middle).sum(1) / weight.sum(1).clamp_min(1e-30)
    good &= ~offset.isnan() & (peak.values > STANDS_OUT * energy.median(1).values) & (peak.values > 0.05**2)
    good &= _alone(edges.mask.cpu(), FINER * place, across)
    slopes = derivatives(camera, point[good])
    return (across[good].numpy()[:, None] @ slopes)[:, 0], offset[good].numpy()


def _alone(mask: Tensor, place: Tensor, across: Tensor) -> Tensor:
    """Which places on edges [m, 2] have no other edge within some :data:`PROFILE` pixels to both sides: [m], bool.

    Args:
        mask: pixels beside edges, in a grid of :data:`FINER` rays along a side of a pixel [h, w]; so are the places.
        across: unit directions [m, 2].
    """
    way = torch.arange(2.5, FINER * PROFILE, 0.5, dtype=torch.float64)  # an edge itself is up to two pixels wide there
    at = (place[:, None] + torch.cat((-way, way))[:, None] * across[:, None]).long()  # [m, steps, 2]
    column, row = at.unbind(-1)
    return ~mask[row.clamp(0, mask.shape[0] - 1), column.clamp(0, mask.shape[1] - 1)].any(1)
