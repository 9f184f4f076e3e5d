"""One view of a check: its photograph, what its camera meets, and whether the edges of both agree."""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from neurad.core.errors import InputError
from neurad.core.records import BoolArray, FloatArray
from neurad.core.scene_records import Camera, View
from neurad.evidence.edge_fit import EdgeFit, compared, directions, edge_fit, inside
from neurad.evidence.mesh_edges import PrimaryGrid, mesh_edges, primary_grid
from neurad.images.photographs import kept_pixels, read_view
from neurad.integrators.world import World
from neurad.metrics.seen import SeenBy
from neurad.metrics.unseen import NEITHER, seen_map

SHOWN = 512
"""Pixels that pictures on the page are wide at most; edges are traced at that size."""

DARK = 0.02
"""Part of a photograph's mean up to which a pixel shows nothing."""
LEVELS = 256
"""Different values of a channel of 8 bits."""
_MIN_PIXELS = 4096  # pixels in which a photograph of more bits has more values than that


@dataclass(frozen=True)
class PhotographFacts:
    """Brightness and codes of one photograph."""

    mean: float
    """Mean of the pixels that show a surface and no emitter, all channels; 0 where there are none."""
    highest: float
    """Largest value of all pixels."""
    clipped: float
    """Fraction of the pixels that show a surface and no emitter that have the largest value of a channel, for the
    channel with most of them; 0 where it is a single one."""
    black: float
    """Fraction of these that are 0 in all channels."""
    constant: bool
    """All pixels are equal."""
    levels: int | None
    """Different values of the channel with most of them; None where there are few pixels."""


@dataclass(frozen=True)
class Looked:
    """What one view shows."""

    view: View
    part: str
    """'train' or 'held out'."""
    grid: Camera
    """Camera of the pictures on the page."""
    mask: BoolArray
    """Pixels of these beside an edge of the geometry [h, w]."""
    surface: float
    """Fraction of the pixels that meet a surface."""
    distance: float
    """Median distance of what they meet, in scene units; NaN where that is nothing."""
    towards: Tensor
    """Directions to edges in the camera's space [m, 3]."""
    picture: FloatArray | None = None
    """The photograph at the size of the page, linear [h, w, 3]; None where it cannot be read."""
    refused: str = ""
    """Why it cannot be."""
    ranks: Tensor | None = None
    """Ranks of the photograph's gradients."""
    camera: Camera | None = None
    """Camera of the size of the ranks."""
    facts: PhotographFacts | None = None
    fit: EdgeFit | None = None
    holes: float = 0.0
    """Fraction of the photograph that shows something where its camera meets no surface."""
    seen: FloatArray | None = None
    """The map ``seen`` [h, w, 1] of a held-out view."""


@torch.no_grad()
def look(world: World, view: View, part: str, seen_by: SeenBy | None, seed: int) -> Looked:
    """Look at a view of a part, 'train' or 'held out'; with training cameras ``seen_by`` also for the map ``seen``."""
    grid = primary_grid(world, view.camera, page_width(view.camera.width))
    edges = mesh_edges(world, grid)
    size = (edges.camera.height, edges.camera.width)
    valid, solid = grid.si.valid, (grid.si.valid & ~grid.emits).view(size)
    found = Looked(
        view, part, edges.camera, edges.mask.numpy(), float(valid.float().mean()),
        float(grid.t[valid].median()) if bool(valid.any()) else math.nan, directions(edges, seed),
        seen=None if seen_by is None else _seen(grid, solid, seen_by),
    )  # fmt: skip
    if view.image is None:
        return found
    try:
        pixels, kept = read_view(view), kept_pixels(view)
    except InputError as error:
        return replace(found, refused=str(error))
    nothing = (resampled((~valid).view(size).numpy()[..., None].astype(np.float32), pixels.shape[:2]) == 1.0)[..., 0]
    counted = (resampled(solid.numpy()[..., None].astype(np.float32), pixels.shape[:2]) == 1.0)[..., 0]
    towards = found.towards
    if kept is not None:
        counted &= kept
        nothing &= kept
        if found.seen is not None:
            whole = resampled(kept[..., None].astype(np.float32), size) == 1.0
            found = replace(found, seen=np.where(whole, found.seen, np.float32(NEITHER)))
        towards = towards[inside(kept, view.camera, towards)]
    ranks, camera = compared(pixels, view.camera)
    return replace(
        found,
        picture=resampled(pixels[..., :3], size),
        ranks=ranks,
        camera=camera,
        towards=towards,
        facts=photograph_facts(pixels, counted),
        fit=edge_fit(ranks, camera, towards),
        holes=float((nothing & (pixels[..., :3].mean(-1) > DARK * pixels[..., :3].mean())).mean()),
    )


def page_width(width: int) -> int:
    """Width in pixels of a view's pictures: small ones are enlarged by two, large ones reduced by a whole number."""
    return 2 * width if 2 * width <= SHOWN else width // -(-width // SHOWN)


def resampled(pixels: FloatArray, size: tuple[int, ...]) -> FloatArray:
    """A picture [h, w, c] with another height and width: means where it shrinks, equal pixels where it grows."""
    x = torch.from_numpy(np.ascontiguousarray(pixels, np.float32)).movedim(-1, 0)[None]
    made: FloatArray = interpolate(x, size, mode="area")[0].movedim(0, -1).contiguous().numpy()
    return made


def _seen(grid: PrimaryGrid, solid: Tensor, seen_by: SeenBy) -> FloatArray:
    """The map ``seen`` of a view, from a ray in every second row and column."""
    h, w = solid.shape
    lanes = torch.arange(h * w).view(h, w)[::2, ::2]
    few = seen_by.any(grid.si[lanes.flatten()]).view(lanes.shape)
    seen = few.repeat_interleave(2, 0).repeat_interleave(2, 1)[:h, :w]
    return seen_map(solid.numpy(), seen.numpy())


def photograph_facts(pixels: FloatArray, counted: BoolArray) -> PhotographFacts:
    """Look at a photograph [h, w, 3 or 4], finite, where ``counted`` [h, w] shows a surface and no emitter."""
    colour = pixels[..., :3]
    inside = colour[counted]  # [n, 3]
    constant = bool((colour == colour[0, 0]).all())
    many = len(colour.reshape(-1, 3)) >= _MIN_PIXELS
    levels = max(len(np.unique(colour[..., c])) for c in range(3)) if many else None
    if len(inside) == 0:
        return PhotographFacts(0.0, float(colour.max()), 0.0, 0.0, constant, levels)
    top = inside.max(0)
    at_top = int(((inside == top) & (top > 0)).sum(0).max())
    clipped = at_top / len(inside) if at_top > 1 else 0.0  # some pixel is always the brightest
    black = float((inside == 0).all(-1).mean())
    return PhotographFacts(float(inside.mean(dtype=np.float64)), float(colour.max()), clipped, black, constant, levels)
