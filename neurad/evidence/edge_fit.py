"""Whether a photograph shows the edges of the geometry where its camera sees them.

The size of a photograph's gradients is replaced by its rank among all pixels: exposure, contrast and noise play no part
then. Over the places where the camera sees edges of the geometry the mean rank is high, and it falls if the camera is
turned by a pixel or two. A camera that has another pose, or a photograph that shows something else, has no such peak,
or has it elsewhere.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, interpolate, pad

from neurad.core.camera import camera_rays, pixel_side, project
from neurad.core.records import BoolArray, FloatArray
from neurad.core.robust import NORMAL
from neurad.core.scene_records import Camera
from neurad.evidence.mesh_edges import MeshEdges, mesh_edges, primary_grid
from neurad.evidence.photograph_pairs import LEAST_VIEWS
from neurad.evidence.shared_errors import MEASURES, bound
from neurad.integrators.world import World

WIDTH = 256
"""Pixels that larger photographs are at least reduced to: edges are compared on that scale."""
EDGES = 1500
"""Places along edges that are compared; where there are more, as many at random."""
TURNS = 14
"""Largest turn of the camera to the side, up and down, in pixels, in steps of two ..."""
ROLLS = (-5.0, 0.0, 5.0)
"""... each of them with these degrees about its axis."""
FINE = 4
"""Largest of the small turns, in pixels, in steps of one."""
MAX_OFFSET = 1.5
"""Pixels below which a turn is still the pose."""
EXCESS, EXCESS_OF_FEW, MIN_PLACES = 0.25, 0.5, 1000
"""Standard deviations over turns by which some turned camera may fit better than the pose, and where fewer than so many
places are compared; measured, see docs/check.md."""
KEPT = 0.85
"""Part of the edges that has to stay in the picture of a turned camera: of a small one a few are left otherwise, which
seem to fit where they fall on a texture."""
FAR, MIN_DEVIATION = 6.0, 0.1
"""A mean rank is far below those of the other views if it is so many robust standard deviations and so much below."""
_CHANGES = [
    *(("zoom", 1.0 + 0.01 * i) for i in range(-12, 13)),
    *((kind, 0.004 * i) for kind in ("right", "down") for i in range(-10, 11) if i),
    *(("roll", 0.5 * i) for i in range(-8, 9) if i),
]
_DARK = 0.03  # of the median: differences between darker values count little
_BLUR = 1.0  # pixels


@dataclass(frozen=True)
class EdgeFit:
    """How well one photograph fits the edges of the geometry."""

    places: int
    """Along edges that were compared."""
    here: float
    """Mean rank of the photograph's gradients at the edges as the camera sees them, in [0, 1]; 0.5 says nothing."""
    around: float
    """Mean rank with the camera turned, over all turns."""
    spread: float
    """Standard deviation over turns."""
    best: float
    """The largest of a turned camera, farther than :data:`FINE` pixels."""
    turn: tuple[float, float, float]
    """The turn of the camera that belongs to ``best``: degrees to the left, up, and counterclockwise."""
    gain: float
    """How much larger than ``here`` the mean is at the best of the small turns that are another pose."""
    offset: tuple[float, float]
    """That small turn of the camera in pixels: to the left and up."""
    angles: tuple[float, float, float]
    """The turn that fits best, by little or by much, which :attr:`excess` is of: angles about the camera's axes."""

    @property
    def peak(self) -> float:
        """How far the pose stands out of turned ones, in their standard deviations."""
        return (self.here - self.around) / self.spread

    @property
    def margin(self) -> float:
        """By how much the pose stands out farther than the best of the turned ones."""
        return (self.here - self.best) / self.spread

    @property
    def excess(self) -> float:
        """By how much the best turned camera, by little or by much, stands out farther than the pose."""
        return max(-self.margin, self.gain / self.spread)

    @property
    def fits(self) -> bool:
        """Whether no turned camera fits better than chance allows."""
        return self.excess <= (EXCESS if self.places >= MIN_PLACES else EXCESS_OF_FEW)


def gradient_ranks(photograph: FloatArray) -> Tensor:
    """Rank of each pixel's gradient in a photograph, from 0 to 1 [h, w], of its logarithm.

    Args:
        photograph: linear radiance [h, w, c]; alpha counts as a colour.
    """
    pixels = torch.from_numpy(np.ascontiguousarray(photograph)).float().clamp_min(0.0)
    lit = pixels[..., :3].mean(-1)
    level = float(lit[lit > 0].median()) if bool((lit > 0).any()) else 1.0
    channels = torch.log(pixels.movedim(-1, 0) / level + _DARK)
    x = _blurred(channels)
    across = pad(x[..., 2:] - x[..., :-2], (1, 1))
    down = pad(x[:, 2:] - x[:, :-2], (0, 0, 1, 1))
    size = (across.square() + down.square()).sum(0)
    order = size.flatten().argsort(stable=True)
    ranks = torch.empty(len(order)).scatter_(0, order, torch.linspace(0.0, 1.0, len(order)))
    return ranks.view_as(size)


def _blurred(channels: Tensor) -> Tensor:
    """Channels [c, h, w] after a Gaussian."""
    reach = math.ceil(3 * _BLUR)
    weight = torch.exp(-0.5 * (torch.arange(-reach, reach + 1) / _BLUR).square())
    weight = weight / weight.sum()
    x = pad(channels[:, None], (reach,) * 4, mode="replicate")
    return conv2d(conv2d(x, weight.view(1, 1, 1, -1)), weight.view(1, 1, -1, 1))[:, 0]


def compared(photograph: FloatArray, camera: Camera) -> tuple[Tensor, Camera]:
    """What edges are compared with: the ranks of a photograph that is reduced where it is large [h, w], and the camera
    of that size.

    Args:
        photograph: [h, w, c].
    """
    by = max(1, camera.width // WIDTH)
    if by > 1:
        w, h = camera.width // by, round(camera.height / by)
        x = torch.from_numpy(np.ascontiguousarray(photograph)).float().movedim(-1, 0)[None]
        photograph = interpolate(x, (h, w), mode="area")[0].movedim(0, -1).numpy()
        camera = replace(camera, width=w, height=h)
    return gradient_ranks(photograph), camera


def directions(edges: MeshEdges, seed: int) -> Tensor:
    """Directions to places along edges in the camera's space [m, 3].

    Args:
        seed: of the choice where there are more than :data:`EDGES`.
    """
    place = edges.place.cpu()
    if len(place) > EDGES:
        place = place[torch.randperm(len(place), generator=torch.Generator().manual_seed(seed))[:EDGES]]
    return camera_rays(replace(edges.camera, to_world=np.eye(4, dtype=np.float32)), place).d.float()


def edge_view(world: World, camera: Camera, photograph: FloatArray, seed: int) -> tuple[Tensor, Camera, Tensor]:
    """What :func:`edge_fit` takes for a photograph [h, w, c] and the edges that its camera sees; a seed as of
    :func:`directions`.
    """
    with world.tracer.uncounted():
        edges = mesh_edges(world, primary_grid(world, camera, min(camera.width, WIDTH)))
    return (*compared(photograph, camera), directions(edges, seed))


def inside(kept: BoolArray, camera: Camera, towards: Tensor) -> Tensor:
    """Which directions [m, 3] in the camera's space end at a pixel that a mask [h, w] keeps [m], bool."""
    x, y = project(camera, towards).nan_to_num(0.0).long().unbind(-1)
    return torch.from_numpy(kept)[y.clamp(0, camera.height - 1), x.clamp(0, camera.width - 1)]


def edge_fit(ranks: Tensor, camera: Camera, towards: Tensor) -> EdgeFit | None:
    """Compare a photograph with edges, as the camera sees them and turned; None where there is nothing to compare.

    Args:
        ranks: of the photograph's gradients [h, w].
        camera: of that size.
        towards: directions to edges in the camera's space [m, 3].
    """
    if len(towards) == 0:
        return None
    pixel = pixel_side(camera)
    steps = torch.arange(-TURNS, TURNS + 1, 2).double()
    turns = torch.cartesian_prod(steps, steps, torch.tensor(ROLLS).double())  # up, left, roll
    way = torch.maximum(turns[:, :2].norm(dim=-1), (turns[:, 2].deg2rad() * 0.25 * camera.width).abs())
    turns = turns[way > FINE]
    steps = torch.arange(-FINE, FINE + 1).double()
    small = torch.cartesian_prod(steps, steps, torch.zeros(1).double())
    unit = torch.tensor([pixel, pixel, math.radians(1.0)]).double()
    far, near = (_means(ranks, camera, towards, _matrices(x * unit), KEPT) for x in (turns, small))
    beside = small[:, :2].norm(dim=-1) < MAX_OFFSET
    here, known = float(near[beside].nan_to_num(-1.0).max()), far[~far.isnan()]
    if here < 0.0 or len(known) < 2:
        return None
    best, closest = (int(x.nan_to_num(-1.0).argmax()) for x in (far, torch.where(beside, -1.0, near)))
    # Edges that move to the left are those of a camera that is turned to the right.
    down, right, clockwise = turns[best].tolist()
    degrees = math.degrees(pixel)
    x, y, z = (-unit * (turns[best] if far[best] > near[closest].nan_to_num(-1.0) else small[closest])).tolist()
    return EdgeFit(
        len(towards), here, float(known.mean()), max(float(known.std()), 1e-6), float(far[best]),
        (-right * degrees, -down * degrees, -clockwise), float(near[closest]) - here,
        (-float(small[closest, 1]), -float(small[closest, 0])), (x, y, z),
    )  # fmt: skip


def mean_rank(ranks: Tensor, camera: Camera, towards: Tensor) -> float:
    """Mean rank of a photograph's gradients at edges as a camera sees them; -1 where more than half are out of sight.

    Args:
        ranks: as in :func:`edge_fit`, and so are the others.
        camera: of that size.
    """
    return float(_means(ranks, camera, towards, torch.eye(3)[None]).nan_to_num(-1.0)[0])


def _matrices(angles: Tensor) -> Tensor:
    """Rotations [t, 3, 3] by vectors of angles about x, y and z [t, 3]."""
    x, y, z = angles.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), -1).view(-1, 3, 3)
    matrices: Tensor = torch.linalg.matrix_exp(cross)
    return matrices.float()


def _means(ranks: Tensor, camera: Camera, towards: Tensor, matrices: Tensor, kept: float = 0.5) -> Tensor:
    """Mean rank at directions [m, 3] in the camera's space after each of some turns [t, 3, 3]: [t]; NaN where a
    smaller part of the edges than ``kept`` stays in the picture.
    """
    h, w = ranks.shape
    flat = ranks.flatten()
    found = []
    for part in torch.split(matrices, 64):
        p = towards @ part.transpose(-1, -2)  # [t, m, 3]
        xy = project(camera, p).nan_to_num(-1.0)
        inside = (xy[..., 0] >= 0) & (xy[..., 0] < w) & (xy[..., 1] >= 0) & (xy[..., 1] < h)
        if not camera.lens.fisheye:
            inside &= p[..., 2] < 0
        x, y = torch.where(inside.unsqueeze(-1), xy, 0.0).long().unbind(-1)
        values = torch.where(inside, flat[y * w + x], 0.0)
        count = inside.sum(-1)
        mean = values.sum(-1) / count
        found.append(torch.where(count >= kept * len(towards), mean, math.nan))
    return torch.cat(found)


@dataclass(frozen=True)
class SharedTurn:
    """One change of all pictures that fits the edges of the geometry better than none."""

    kind: str
    """'zoom', 'right', 'down' or 'roll'."""
    amount: float
    """The factor; the shift as a fraction of the width; degrees clockwise."""


def shared_turn(views: Sequence[tuple[Tensor, Camera, Tensor]]) -> SharedTurn | None:
    """What all photographs are zoomed, shifted or rolled by against the edges of the geometry; None where nothing is.

    It moves a picture's border by more than :data:`MAX_OFFSET` pixels, and over the views the mean rank surely rises,
    see :func:`bound`. Of several kinds that do, the one that fits best.

    Args:
        views: ranks [h, w], the camera of that size and directions to edges, as in :func:`edge_fit`.
    """
    views = [view for view in views if len(view[2]) > 0]
    if len(views) < LEAST_VIEWS:
        return None
    ranks = np.array([_changed_ranks(*view) for view in views])
    width = float(np.mean([camera.width for _, camera, _ in views]))
    best, found, kinds = 0.0, None, {kind for kind, _ in _CHANGES}
    for number, (kind, amount) in enumerate(_CHANGES):
        gain = ranks[:, number] - ranks[:, _CHANGES.index(("zoom", 1.0))]
        gain = gain[~np.isnan(gain)]
        if len(gain) < LEAST_VIEWS or gain.mean() <= best:
            continue
        moved = {"zoom": 0.5 * abs(amount - 1.0), "roll": 0.5 * math.radians(abs(amount))}.get(kind, abs(amount))
        best = float(gain.mean())
        error = float(gain.std(ddof=1)) / math.sqrt(len(gain))
        sure = best > bound(error, len(gain), MEASURES * len(kinds), 0.0)
        found = SharedTurn(kind, amount) if sure and moved * width > MAX_OFFSET else None
    return found


def _changed_ranks(ranks: Tensor, camera: Camera, towards: Tensor) -> list[float]:
    """Mean rank at edges in a picture after each of :data:`_CHANGES`; NaN where more than half of them leave it."""
    middle = torch.tensor([camera.cx, camera.cy])
    from_middle = project(camera, towards).nan_to_num(-1.0) - middle
    h, w = ranks.shape
    found = []
    for kind, amount in _CHANGES:
        if kind == "zoom":
            xy = from_middle * amount
        elif kind == "roll":
            c, s = math.cos(math.radians(amount)), math.sin(math.radians(amount))
            xy = from_middle @ torch.tensor([[c, s], [-s, c]])
        else:
            xy = from_middle + camera.width * torch.tensor([amount, 0.0] if kind == "right" else [0.0, amount])
        x, y = (xy + middle).unbind(-1)
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        mean = float(ranks[y[inside].long(), x[inside].long()].mean())
        found.append(mean if 2 * int(inside.sum()) >= len(towards) else math.nan)
    return found


def misfits(fits: Sequence[EdgeFit | None]) -> list[int]:
    """Views whose photographs do not show the edges of the geometry where their cameras see them.

    Args:
        fits: of each view; None is no misfit.
    """
    known = np.array([fit.here for fit in fits if fit is not None])
    low = 0.0
    if len(known) >= 4:
        median = float(np.median(known))
        low = median - max(FAR * NORMAL * float(np.median(np.abs(known - median))), MIN_DEVIATION)
    return [i for i, fit in enumerate(fits) if fit is not None and (not fit.fits or fit.here < low)]
