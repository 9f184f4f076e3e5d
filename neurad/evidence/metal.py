"""Whether groups of surface are metals: two hypotheses, each with the best that it can say, judged on views left out.

A pixel is linear in the base colour b of its surface under either hypothesis, ``b A + B``: a dielectric has a diffuse
lobe times b under a white one, a metal a coloured lobe alone. A and B depend on the roughness, for which a few values
are tried. In each group b is a mean plus what patches differ by, as far as that predicts better. Every view is
predicted from the others, and what is right predicts better: the squared error of the better dielectric over that of
the better metal. A view counts as one observation, however many pixels it has: the errors of a model are the same all
over it. Base colours are found with products of two halves of the samples, which have no noise of these in their mean.

Without a highlight a rough metal is coloured paint to any camera. And a dark dielectric is a metal that reflects 4 %,
which none does, so that base colours of metals have a lower end.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from neurad.core.groups import group_sums
from neurad.core.records import Float64Array, FloatArray, IntArray, PixelBatch, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.evidence.pixel_derivatives import DARK, GROUP, LIMIT, SPP, TrainingPixels, image_of
from neurad.integrators.estimator import Estimator

ROUGHNESS = (0.1, 0.2, 0.3, 0.45, 0.7, 1.0)
"""Values that are tried."""
LOWEST = 0.0, 0.3
"""Least base colour of a dielectric and of a metal: gold's blue, among the darkest of pure metals, is about a third."""
RIDGES = (0.25, 1.0, 4.0, 16.0, np.inf)
"""Pixels that the mean of a group counts for where patches have base colours of their own."""
PRIOR = 1.0, 9.0
"""Of the beta distribution that the fraction of metals among a room's meshes has before any photograph is looked at."""
SPLIT = 0.1
"""Probability that a small mesh is not of one kind all over, and likewise a part of one that is not; it rises to 1 with
the share of what is seen: a scan in one piece is of many materials."""
ALIKE = 1.0
"""Siblings that the fraction of metals of all meshes counts for beside those of one mesh."""
NODES = 32
"""Of the quadrature over that fraction: it is exact for up to 63 siblings."""
ROUNDS = 100
"""Of expectation maximisation."""
MIN_ERROR = 1e-3
"""Least squared error of a prediction: below it differences say nothing."""
COMMON = 8
"""Pixels of a group by which its error is half its own and half that of all groups, and its views count for half: two
or three pixels are predicted by luck.
"""
MIN_VIEWS = 2.0
"""Views that have to show a group, one of which is predicted from the others."""
_STREAM = 43  # last number of the stream's key


@dataclass(frozen=True)
class MetalPixels:
    """Pixels under both hypotheses, those of a metal last, at each roughness [h], in units of their brightness."""

    view: IntArray
    """[n]."""
    p: FloatArray
    """One of the surface points in each pixel [n, 3]."""
    prim: IntArray
    """Triangle that it lies on [n]."""
    a: FloatArray
    """What a base colour of 1 adds, by half of the samples [2, h, n, 3]."""
    e: FloatArray
    """Photograph less what is there without any base colour [2, h, n, 3]."""

    def __len__(self) -> int:
        return len(self.p)


def metal_pixels(source: TrainingPixels, first: int, pixels: int) -> MetalPixels | None:
    """About ``pixels`` training pixels, from the batch of iteration ``first`` on; None if none is left. Each is taken
    for what its first sample shows.
    """
    parts = source.of_batches(partial(_of_batch, source, first), first, pixels)
    if not sum(len(part[0]) for part in parts):
        return None
    columns = zip(zip(*parts, strict=True), (0, 0, 0, 2, 2), strict=True)
    return MetalPixels(*(np.concatenate(column, axis) for column, axis in columns))


@torch.no_grad()
def _of_batch(source: TrainingPixels, iteration: int, index: int, batch: PixelBatch) -> list[FloatArray]:
    """The arrays of :class:`MetalPixels`, in the order of its fields."""
    estimator, primary = source.estimator, source.primary
    b, device = len(batch.view), primary.origin.device
    stream = Stream(source.seed, iteration, index, _STREAM, device=device)
    first = primary(batch, SPP, stream)
    si, world = first.si, estimator.world
    emitted = world.emitted(si)
    shown = first.attenuate(emitted + estimator.shown(si, estimator.materials(si), stream))
    unit = (shown.view(b, SPP, 3).mean(1).square() + DARK * source.mean_square_radiance + 1e-30).sqrt()  # [b, 3]
    emitted = first.attenuate(emitted).view(b, 2, -1, 3).mean(2).transpose(0, 1)  # [2, b, 3]
    kept = si.valid.view(b, SPP).all(1)
    found = []
    for metallic in (0.0, 1.0):
        for roughness in ROUGHNESS:  # the same random numbers for all
            stream = Stream(source.seed, iteration, index, _STREAM + 1, device=device)
            by, without = _linear(estimator, first.attenuate, si, metallic, roughness, stream)
            found.append((by / unit, (batch.color - emitted - without) / unit))
    a, e = (torch.stack(x, 1) for x in zip(*found, strict=True))  # [2, h, b, 3]
    kept &= torch.isfinite(torch.cat((a, e), -1)).all(-1).all(0).all(0)
    columns = [batch.view, si.p.view(b, SPP, 3)[:, 0], si.prim.view(b, SPP)[:, 0]]
    return [*(x[kept].cpu().numpy() for x in columns), *(x[:, :, kept].cpu().numpy() for x in (a, e))]


def _linear(
    estimator: Estimator,
    attenuate: Callable[[Tensor], Tensor],
    si: SurfaceInteraction,
    metallic: float,
    roughness: float,
    stream: Stream,
) -> tuple[Tensor, Tensor]:
    """What a base colour of 1 adds to pixels, and what they are without any, by halves of the samples [2, b, 3]."""
    lanes = len(si)
    like = torch.empty(lanes, 1, device=stream.device)
    albedo = torch.full((lanes, 3), 0.5, device=stream.device, requires_grad=True)
    surface = Surface(albedo, torch.full_like(like, roughness), metallic=torch.full_like(like, metallic))
    with torch.enable_grad():
        image = image_of(estimator, attenuate, si, surface, stream, GROUP)  # a half of a pixel is treated as a pixel
        (by,) = torch.autograd.grad(image.sum(), albedo)  # each channel depends on its own alone
    by, image = (x.detach().reshape(-1, 2, GROUP, 3).mean(2).transpose(0, 1) for x in (by, image))
    return by, image - 0.5 * by


def log_odds(pixels: MetalPixels, group: IntArray, patch: IntArray) -> dict[int, float]:
    """Logarithms of the odds of being a metal against being none, of each group that enough views show, without those
    that it has before any photograph is looked at; by the group, and the patch of it, that each pixel shows [n].
    """
    half = len(ROUGHNESS)
    names, of_group = np.unique(group, return_inverse=True)
    errors = np.full((2, len(names)), np.inf)
    layout = _Layout(of_group, np.unique(patch, return_inverse=True)[1], pixels.view)
    for index in range(2 * half):
        is_metal = index // half
        for error in layout.errors(pixels.a[:, index], pixels.e[:, index], LOWEST[is_metal]):
            errors[is_metal] = np.minimum(errors[is_metal], error)
    seen = np.stack([pixels.view == v for v in np.unique(pixels.view)]) if len(names) else np.empty((0, 0))
    counts = np.stack([np.bincount(of_group, part, len(names)) for part in seen])  # [views, groups]
    views = counts.sum(0) ** 2 / np.maximum((counts**2).sum(0), 1.0)  # effective number
    size = counts.sum(0)
    common = float((size * errors.min(0)).sum() / max(size.sum(), 1))
    errors = np.maximum((size * errors + COMMON * common) / (size + COMMON), MIN_ERROR)
    found = 0.5 * views * size / (size + COMMON) * np.log(errors[0] / errors[1])
    return {int(name): float(x) for name, x, n in zip(names, found, views, strict=True) if n >= MIN_VIEWS}


@dataclass(frozen=True)
class MetalTree:
    """Meshes, their parts and the regions of these, any of which may be metal all over or not.

    A mesh is of one kind, but for :data:`SPLIT`; else each of its parts is, and else each region of the part has a kind
    of its own. That is a mixture over all ways to prune the tree (Willems, Shtarkov and Tjalkens 1995), by which no
    evidence counts twice. Those that have kinds of their own in one mesh, or in one part, share a fraction of metals,
    which is unknown, too (beta-binomial): what is too small to tell is like its neighbours. The fraction of a room is
    found from all its meshes, by expectation maximisation (a two-groups model, Efron 2008): with a fixed one some of a
    hundred groups are called metal by luck where none is.
    """

    odds: tuple[Float64Array, Float64Array, Float64Array]
    """What :func:`log_odds` says of each mesh, part and region; 0 where it says nothing."""
    mesh_of: IntArray
    """Mesh of each part."""
    part_of: IntArray
    """Part of each region."""
    pixels: IntArray
    """Of each region."""

    def probabilities(self) -> tuple[Float64Array, Float64Array]:
        """Probability that each part is metal, the mean over its regions by their pixels where there are any, and that
        each region is.
        """
        mesh = self.mesh_of[self.part_of]
        size = np.bincount(mesh, self.pixels, len(self.odds[0]))
        seen = size > 0
        fraction = PRIOR[0] / sum(PRIOR)
        for _ in range(ROUNDS):
            parts, regions = self._given(fraction)
            by_mesh = np.bincount(mesh, regions * self.pixels, len(size))[seen] / size[seen]
            fraction = (PRIOR[0] + by_mesh.sum()) / (sum(PRIOR) + len(by_mesh))
        size = np.bincount(self.part_of, self.pixels, len(parts))
        mean = np.bincount(self.part_of, regions * self.pixels, len(parts)) / np.maximum(size, 1)
        return np.where(size > 0, mean, parts), regions

    def _given(self, fraction: float) -> tuple[Float64Array, Float64Array]:
        """Probability that what no pixel shows of each part is metal, and that each region is, if so many are metal."""
        from scipy.special import logsumexp, roots_jacobi  # imported where they are needed: they load slowly

        # Gauss and Jacobi: fractions of metals among siblings [k], and how likely each is before these are looked at.
        with np.errstate(invalid="ignore"):  # 0 / 0 in what it replaces itself
            x, weight = roots_jacobi(NODES, ALIKE * (1.0 - fraction) - 1.0, ALIKE * fraction - 1.0)
        among, weight = 0.5 * (x[:, None] + 1.0), np.log(weight / weight.sum())[:, None]

        def one_kind(odds: Float64Array, fraction: Float64Array | float) -> tuple[Float64Array, Float64Array]:
            """Logarithm of what they say over what they say if they are no metal, and probability of metal."""
            says = np.logaddexp(np.log1p(-fraction), np.log(fraction) + odds)
            return says, fraction * np.exp(odds - says)

        def together(each: Float64Array, parent: IntArray, count: int) -> tuple[Float64Array, Float64Array]:
            """Logarithm of what siblings say together, of each parent [m], and probability of each fraction of metals
            among them [k, m]: from what each says at these [k, n].
            """
            says = weight + group_sums(each.T, parent, count).T
            total = logsumexp(says, 0)
            return total, np.exp(says - total)

        def split(whole: Float64Array, apart: Float64Array, size: Float64Array) -> tuple[Float64Array, Float64Array]:
            """Logarithm of what both say, and probability that they are not of one kind."""
            alike = (1.0 - SPLIT) * (1.0 - size / size.sum())
            apart = np.log1p(-alike) + apart
            with np.errstate(divide="ignore"):  # 0 for all that is seen
                both = np.logaddexp(np.log(alike) + whole, apart)
            return both, np.exp(apart - both)

        parts, mesh_of = len(self.odds[1]), self.mesh_of
        size = np.bincount(self.part_of, self.pixels, parts).astype(np.float64)
        regions_say, regions = one_kind(self.odds[2], among)
        apart, likely = together(regions_say, self.part_of, parts)
        regions = (likely[:, self.part_of] * regions).sum(0)  # of parts that are not of one kind
        whole, kinds = one_kind(self.odds[1], among)
        parts_say, split_part = split(whole, apart, size)
        apart, likely = together(parts_say, mesh_of, len(self.odds[0]))
        whole, meshes = one_kind(self.odds[0], fraction)
        size = np.bincount(mesh_of, size, len(meshes)).astype(np.float64)
        _, split_mesh = split(whole, apart, size)

        def mixed(part: IntArray, own: Float64Array | float) -> Float64Array:
            """Of what lies in these parts, by what it would be on its own."""
            mesh, kind, apart = mesh_of[part], kinds[:, part], split_part[:, part]
            by_part = (likely[:, mesh] * (kind + apart * (own - kind))).sum(0)
            return np.asarray(meshes[mesh] + split_mesh[mesh] * (by_part - meshes[mesh]))

        return mixed(np.arange(parts), fraction), mixed(self.part_of, regions)


class _Layout:
    """Which pixels belong together: those that show the same of some groups, patches and views [n], numbered from 0."""

    def __init__(self, group: IntArray, patch: IntArray, view: IntArray) -> None:
        self.of_group, self.of_patch = group, patch
        views = int(view.max(initial=0)) + 1
        # Number of the pair of group and view that each pixel has, likewise of patch and view
        self.by_group = np.unique(group * views + view, return_inverse=True)[1]
        _, self.first, self.by_patch = np.unique(patch * views + view, return_index=True, return_inverse=True)
        self.own_group = np.zeros(int(self.by_group.max(initial=-1)) + 1, np.int64)
        """Group of each pair of group and view; ``first`` is a pixel of each of patch and view."""
        self.own_group[self.by_group] = group

    def errors(self, a: FloatArray, e: FloatArray, lowest: float) -> Iterator[Float64Array]:
        """Mean squared error of each group's pixels as the other views predict them, for each of :data:`RIDGES`, with
        ``a`` and ``e`` [2, n, 3] and base colours that are not below ``lowest``.
        """
        power = (a[0] * a[1]).astype(np.float64)
        share = 0.5 * (a[0] * e[1] + a[1] * e[0]).astype(np.float64)
        both = np.concatenate((power, share), 1)
        of_views, of_groups = _by(both, self.by_group), _by(both, self.of_group)
        d, n = np.split(of_groups[self.own_group] - of_views, 2, 1)
        mean = np.clip(n / np.maximum(d, 1e-9), lowest, 1.0)  # of a group, without a view
        pixels = np.bincount(self.of_group)
        d_pixel = (of_groups[:, :3] / pixels[:, None]).clip(1e-9)[self.of_group[self.first]]
        own = _by(both, self.of_patch)[self.of_patch[self.first]] - _by(both, self.by_patch)
        d, n = np.split(own, 2, 1)
        d, mean = d.clip(0.0), mean[self.by_group[self.first]]
        for ridge in RIDGES:
            color = mean if np.isinf(ridge) else mean + (n - mean * d) / (d + ridge * d_pixel)
            residual = (e - a * np.clip(color, lowest, 1.0)[self.by_patch]).clip(-LIMIT, LIMIT)
            yield np.bincount(self.of_group, np.square(residual.mean(0)).sum(-1)) / pixels


def _by(values: Float64Array, key: IntArray) -> Float64Array:
    """Sums of ``values`` [n, c] over the pixels of each key [keys, c]."""
    return group_sums(values, key, int(key.max(initial=-1)) + 1)
