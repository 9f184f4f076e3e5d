"""How far textures lie apart that several photographs show: what is wrong with poses, lenses and the mesh, in pixels.

A patch of a matt surface looks alike in two photographs, but for its brightness, once both are drawn over the geometry.
By how much the one lies aside of the other says the gradient of both: the difference of two pictures that are a little
apart is that gradient times the offset (Lucas and Kanade 1981). Patches are flat and away from edges of the geometry,
so what covers what plays no part.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from neurad.core.camera import Cameras, project, to_camera
from neurad.core.protocols import PhotographedPixels
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.evidence.offset_table import OffsetTable
from neurad.evidence.photograph_pairs import VIEWS, Develop, brightness_between, brightness_of, matt, some_views
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy

SIDE = 20
"""Pixels along a side of a patch ..."""
REACH = 4
"""... of which so many at its border are what it is compared with where it is moved by less than that."""
STEPS = 6
"""Of Gauss and Newton."""
WEAK = 0.05
"""Part of a patch's strongest gradients by which a step along weak ones is damped."""
PLACES, TRIED = 512, 128
"""Random places that are looked at in each photograph, and patches that are traced: those with the clearest texture."""
PARTNERS = 4
"""Other photographs that a patch is compared with: those from the nearest directions, where highlights differ least."""
FLAT = math.cos(math.radians(20.0))
"""Cosine between a patch's normals and that of its middle below which it is not flat."""
OFF = 1.0
"""Widths of a pixel that a patch may leave the plane through its middle by."""
ALIKE = 2.0
"""Ratio of the sizes of a pixel in two photographs beyond which they show a patch too unlike to be compared."""
PRECISE = 0.2
"""Standard error in pixels of an offset that counts: other patches have too little texture, or too much noise."""
COPIED = 1e-3
"""Standard error below which two photographs are copies of one, which agree whatever its pose is."""
_BINOMIAL = torch.tensor([1.0, 2.0, 1.0]) / 4.0
_CORRELATION = (16.0 / 6.0) ** 2
"""Variance of means of neighbouring pixels over that of independent ones, after the binomial filter in both ways."""
_DARK = 0.1  # of the median brightness, added before the logarithm: dark pixels are noise
_STREAM = 41  # last number of the stream's key


@torch.no_grad()
def texture_offsets(
    world: World, cameras: Sequence[Camera], photographs: PhotographedPixels, seed: int, develop: Develop | None = None,
    precise: float = PRECISE, views: int = VIEWS,
) -> OffsetTable:  # fmt: skip
    """Compare photographs where they show the same flat patches of surfaces.

    Args:
        develop: corrects photographs by what a fit has recovered of how they were taken.
        precise: largest standard error of an offset that counts, in pixels.
        views: photographs that are compared; where there are more, as many of them, evenly.
    """
    chosen, left_out = some_views(len(cameras), views), photographs.ignored()
    with world.tracer.uncounted():
        found = [_patches(world, cameras, index, photographs, develop, left_out, seed) for index in chosen]
        kept = [patches for patches in found if patches is not None]
        if len(kept) < 2:
            return OffsetTable.cat([])
        patches = _Patches(
            SurfaceInteraction.cat(*(part.si for part in kept)), *(
                torch.cat([getattr(part, name) for part in kept]) for name in ("view", "shown", "size")
            )
        )  # fmt: skip
        return _compared(world, cameras, chosen, patches, photographs, develop, left_out, precise)


@dataclass(frozen=True)
class _Patches:
    """Flat patches of surfaces, as one photograph shows each."""

    si: SurfaceInteraction
    """At the middles of the pixels, row by row [m * SIDE^2]."""
    view: Tensor
    """The photograph [m]."""
    shown: Tensor
    """Its brightness [m, SIDE, SIDE], float64."""
    size: Tensor
    """Size of a pixel on the surface, in scene units [m]."""


def _patches(
    world: World, cameras: Sequence[Camera], index: int, photographs: PhotographedPixels, develop: Develop | None,
    left_out: Tensor | None, seed: int,
) -> _Patches | None:  # fmt: skip
    """Some patches that a photograph shows; None where it shows none."""
    camera, device = cameras[index], world.geometry.vertices.device
    if min(camera.width, camera.height) <= SIDE:
        return None
    room = torch.tensor([camera.width - SIDE, camera.height - SIDE])
    corner = (Stream(seed, index, _STREAM).uniform(PLACES, 2) * (room + 1)).long().minimum(room)
    step = torch.arange(SIDE)
    column = (corner[:, 0, None, None] + step).expand(-1, SIDE, -1)
    row = (corner[:, 1, None, None] + step[:, None]).expand(-1, -1, SIDE)
    pixel = (row * camera.width + column).flatten()
    shown = brightness_of(photographs, develop, torch.full_like(pixel, index), pixel, left_out).mean(-1)
    shown = shown.view(PLACES, SIDE, SIDE)
    known = (~shown.isnan().flatten(1).any(1)).nonzero().squeeze(-1)
    if len(known) == 0:  # clipped everywhere, or masked
        return None
    clearest = known[_clearness(shown[known]).topk(min(TRIED, len(known))).indices]
    count, shown = len(clearest), shown[clearest]
    views = Cameras.of([camera], device)
    xy = torch.stack((column[clearest].flatten(), row[clearest].flatten()), -1).to(device) + 0.5
    zero = torch.zeros(len(xy), dtype=torch.int64, device=device)
    rays = views.rays(zero, xy)
    hit = world.tracer.closest(rays)
    si = world.geometry.interact(rays, hit)
    # Flat, and of one piece
    middle = SIDE * (SIDE // 2) + SIDE // 2
    p, n = si.p.view(count, -1, 3), si.n.view(count, -1, 3)
    width = hit.t.view(count, -1)[:, middle] * views.footprint(zero, xy).view(count, -1)[:, middle]
    away = ((p - p[:, middle, None]) * n[:, middle, None]).sum(-1).abs()
    turned = (n * n[:, middle, None]).sum(-1)
    good = matt(world, si).view(count, -1).all(1) & (away <= OFF * width[:, None]).all(1) & (turned >= FLAT).all(1)
    lanes, good = good[:, None].expand(-1, SIDE * SIDE).reshape(-1), good.cpu()
    if not bool(good.any()):
        return None
    return _Patches(si[lanes], torch.full((int(good.sum()),), index), shown[good], width.cpu()[good].double())


def _clearness(shown: Tensor) -> Tensor:
    """The gradients of patches [m, SIDE, SIDE] over what in them is as fine as noise [m]."""
    log = (shown + _DARK * shown.median().clamp_min(1e-30)).log() if len(shown) else shown
    smooth = smoothed(log)
    inner = smooth[:, 1:-1, 1:-1]
    across, down = (smooth[:, 1:-1, 2:] - smooth[:, 1:-1, :-2]), (smooth[:, 2:, 1:-1] - smooth[:, :-2, 1:-1])
    fine = (log[:, 2:-2, 2:-2] - inner).square().mean((1, 2))
    return (across.square() + down.square()).mean((1, 2)) / fine.clamp_min(1e-12)


def _compared(
    world: World, cameras: Sequence[Camera], chosen: Sequence[int], patches: _Patches, photographs: PhotographedPixels,
    develop: Develop | None, left_out: Tensor | None, precise: float,
) -> OffsetTable:  # fmt: skip
    """Offsets of all patches in the photographs that show them, too."""
    count, device = len(patches.view), patches.si.p.device
    grid = torch.arange(count * SIDE * SIDE, device=device).view(count, -1)
    middle = patches.si[grid[:, SIDE * (SIDE // 2) + SIDE // 2]]
    eyes = torch.stack([torch.as_tensor(cameras[i].to_world, dtype=torch.float32)[:3, 3] for i in chosen]).to(device)
    towards = torch.nn.functional.normalize(eyes[:, None] - middle.p, dim=-1)  # [views, m, 3]
    near = (towards * middle.wo).sum(-1).cpu()
    front = (middle.wo * middle.n).sum(-1) > 0
    near[(((towards * middle.n).sum(-1) > 0) != front).cpu()] = -2.0  # another side of a sheet has another light
    seen = SeenBy(world.geometry, world.tracer, [cameras[i] for i in chosen])
    visible = torch.zeros(len(chosen), count, dtype=torch.bool)
    for place in range(len(chosen)):
        lanes, _ = seen.by(place, middle)
        visible[place, lanes.cpu()] = True
    own = torch.tensor(chosen)[:, None] == patches.view
    near[~visible | own] = -2.0
    best = near.topk(min(PARTNERS, len(chosen) - 1), 0)
    level = _DARK * float(patches.shown.median())
    parts: list[OffsetTable] = []
    for place, other in enumerate(chosen):
        mine = ((best.indices == place) & (best.values > -1.5)).any(0).nonzero().squeeze(-1)
        if len(mine) == 0:
            continue
        points, camera = patches.si[grid[mine.to(device)].view(-1)], cameras[other]
        clear = torch.zeros(len(points), dtype=torch.bool, device=device)
        clear[seen.by(place, points)[0]] = True
        xy = project(camera, to_camera(camera, points.p)).double().cpu().view(len(mine), SIDE, SIDE, 2)
        last = SIDE - 1
        change = torch.stack((xy[:, 0, last] - xy[:, 0, 0], xy[:, last, 0] - xy[:, 0, 0]), -1) / last
        sides = change.norm(dim=1)
        alike = ((sides >= 1.0 / ALIKE) & (sides <= ALIKE)).all(1)
        whole = clear.cpu().view(len(mine), -1).all(1) & alike
        mine, change = mine[whole], change[whole]
        theirs = torch.from_numpy(
            brightness_between(camera, other, xy[whole].view(-1, 2), photographs, develop, left_out)
        ).view(len(mine), SIDE, SIDE)
        known = ~theirs.isnan().flatten(1).any(1)
        offset, error, along = offsets(*((shown[known] + level).log() for shown in (patches.shown[mine], theirs)))
        good = (error <= precise) & (error > COPIED)
        mine, change = mine[known][good], change[known][good]
        parts.append(
            OffsetTable(
                patches.view[mine], torch.full_like(mine, other), middle.p[mine.to(device)].cpu().double(), along[good],
                change, offset[good], error[good], patches.size[mine],
            )
        )  # fmt: skip
    return OffsetTable.cat(parts)


def offsets(mine: Tensor, theirs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """By how much second pictures of patches lie aside of first ones, along the strongest gradient of each.

    Args:
        mine: logarithms of brightness [m, SIDE, SIDE], float64.
        theirs: the same surface points in another photograph.

    Returns:
        Offsets in pixels [m], their standard errors [m], infinite where a patch has no texture at all, and the unit
        directions of these gradients [m, 2].
    """
    first, second = smoothed(mine), smoothed(theirs)
    side = first.shape[1] - 2 * REACH
    axis = torch.arange(side, dtype=mine.dtype) + REACH
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    # Light that differs a little from one end of the patch to the other is no offset.
    plane = torch.linalg.qr(torch.stack((torch.ones_like(x), x, y), -1).view(-1, 3)).Q
    base, slopes = picture_at(first, x, y), _slopes(first, x, y)
    moved = torch.zeros(len(mine), 2, dtype=mine.dtype)
    for step in range(STEPS + 1):
        u, v = x + moved[:, 0, None, None], y + moved[:, 1, None, None]
        both = 0.5 * (slopes + _slopes(second, u, v))  # of second order (Malis 2004)
        rows = torch.cat((both, (base - picture_at(second, u, v))[None])).flatten(2)
        rows = rows - (rows @ plane) @ plane.T
        gradient, difference = rows[:2].permute(1, 2, 0), rows[2]  # [m, pixels, 2], [m, pixels]
        values, vectors = torch.linalg.eigh(gradient.transpose(1, 2) @ gradient)
        strength = values[:, 1].clamp_min(torch.finfo(mine.dtype).tiny)
        towards = (vectors.transpose(1, 2) @ gradient.transpose(1, 2) @ difference[..., None]).squeeze(-1)
        if step < STEPS:
            way = towards / (values.clamp_min(0.0) + WEAK * strength[:, None])
            moved = (moved + (vectors @ way[..., None]).squeeze(-1)).clamp(-REACH + 1.0, REACH - 1.0)
    left = difference - (towards[:, 1] / strength)[:, None] * (gradient @ vectors[:, :, 1:]).squeeze(-1)
    variance = left.square().sum(-1) / (left.shape[1] - 5)
    error = (_CORRELATION * variance / strength).sqrt()
    along = vectors[:, :, 1]
    return (moved * along).sum(-1), torch.where(values[:, 1] > 0, error, math.inf), along


def picture_at(pictures: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Bilinear values of pictures [m, h, w] at columns and rows, of all or of each [(m,) a, b]: [m, a, b]."""
    x, y = (torch.broadcast_to(place, (len(pictures), *place.shape[-2:])) for place in (x, y))
    low_x, low_y = x.floor().long().clamp(0, pictures.shape[2] - 2), y.floor().long().clamp(0, pictures.shape[1] - 2)
    lane = torch.arange(len(pictures))[:, None, None]
    fx, fy = x - low_x, y - low_y
    above = torch.lerp(pictures[lane, low_y, low_x], pictures[lane, low_y, low_x + 1], fx)
    below = torch.lerp(pictures[lane, low_y + 1, low_x], pictures[lane, low_y + 1, low_x + 1], fx)
    return torch.lerp(above, below, fy)


def _slopes(pictures: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Central differences of pictures there, to the right and down [2, m, a, b]."""
    across = picture_at(pictures, x + 1.0, y) - picture_at(pictures, x - 1.0, y)
    down = picture_at(pictures, x, y + 1.0) - picture_at(pictures, x, y - 1.0)
    return 0.5 * torch.stack((across, down))


def smoothed(x: Tensor) -> Tensor:
    """Pictures [m, h, w] after the binomial filter, without their borders."""
    weight = _BINOMIAL.to(x)
    x = conv2d(x[:, None], weight.view(1, 1, 1, -1))
    return conv2d(x, weight.view(1, 1, -1, 1))[:, 0]
