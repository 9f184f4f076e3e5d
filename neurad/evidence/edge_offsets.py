"""How far edges of a photograph lie beside those of the mesh, across them."""

import numpy as np
import torch
from torch import Tensor

from neurad.core.protocols import PhotographedPixels
from neurad.core.records import Float64Array
from neurad.core.scene_records import Camera
from neurad.evidence.camera_motion import OWN, SHARED, derivatives
from neurad.evidence.edge_fit import EDGES
from neurad.evidence.mesh_edges import mesh_edges, primary_grid
from neurad.evidence.photograph_pairs import brightness_of
from neurad.evidence.texture_offsets import picture_at, smoothed
from neurad.integrators.world import World

FINER = 2
"""Rays along a side of a pixel that tell where edges of the mesh are."""
PROFILE, STEP = 4.0, 0.25
"""Pixels to both sides of an edge of the mesh that are looked at in the photograph, and in which steps. Where another
edge of the mesh lies as near, nobody knows which of the two a photograph shows: neither counts."""
NEAR = 2.0
"""Pixels within which an edge of the photograph is taken for that of the mesh."""
STANDS_OUT = 10.0
"""Times the median squared gradient along that line by which an edge stands out."""


def edge_offsets(
    world: World, camera: Camera, view: int, photographs: PhotographedPixels, left_out: Tensor | None, seed: int
) -> tuple[Float64Array, Float64Array]:
    """Derivatives [n, 8] and offsets [n] in pixels of edges of the photograph beside those of the mesh, across them.
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
        return np.zeros((0, OWN + SHARED)), np.zeros(0)
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
