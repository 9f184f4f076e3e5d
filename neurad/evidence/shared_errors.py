"""Errors that all photographs share, by what several of them show of the same surface points.

A matt surface has one radiance from wherever it is seen. What a photograph shows of a point, over what others show of
it, is then one, whatever materials and light are; and where it depends on the place in the picture, or on the
photograph, that is the camera's doing: vignetting, a border, a watermark, exposures. Views are the independent units:
every standard error is that over views, by leaving out one at a time or by their scatter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from neurad.core.protocols import PhotoSource
from neurad.core.records import BoolArray, Float64Array
from neurad.core.robust import robust_deviation
from neurad.core.scene_records import Camera
from neurad.evidence.photograph_pairs import GRID, LEAST_VIEWS, Develop, Pairs, pairs_of
from neurad.integrators.world import World

CHANCE = 0.01
"""Probability that anything is said by chance of photographs that have nothing wrong in common."""
MATTERS = 0.1
"""Relative effect that is not worth a word, however sure it is."""
MEASURES = 4
"""Edges, the fall towards corners, exposures, and light."""
MARKS = 3
"""Places of the picture from which on something in all photographs is a mark, such as a watermark."""
EDGE = 0.8
"""Part of an outermost row or column that has to be marked for it to be a border."""
_ROUNDS, _PASSES = 6, 3


def bound(error: Any, units: Any, trials: float = MEASURES, matters: float = MATTERS) -> Any:
    """The size from which on an effect counts: it matters, and by Student's t of an error over independent units any of
    all trials passes by chance with a probability of :data:`CHANCE` (Bonferroni).
    """
    from scipy.special import stdtrit  # imported where it is needed: it loads slowly

    return np.maximum(matters, -stdtrit(np.maximum(units - 1, 1), CHANCE / (2.0 * trials)) * error)


class Estimate(NamedTuple):
    """A number that is estimated."""

    value: float
    error: float
    """Its standard error ..."""
    units: int
    """... over so many independent ones."""

    def off(self, usual: float) -> float:
        """Squared distance from the usual one in standard errors, twice the logarithm of a ratio of likelihoods."""
        return ((self.value - usual) / self.error) ** 2

    def differs(self, usual: float = 0.0) -> bool:
        """Whether it is surely another than the usual one, see :func:`bound`."""
        return abs(self.value - usual) > float(bound(self.error, self.units))


@dataclass(frozen=True)
class SharedErrors:
    """What photographs have in common that surfaces do not."""

    falloff: Estimate
    """Logarithm of the brightness towards the corners over that in the middle; negative with vignetting."""
    spread: Estimate
    """Standard deviation over photographs of the logarithm of their gains; the error is that of one gain."""
    border: dict[str, float]
    """Sides (left, right, top, bottom) with something that is the same in all photographs, and how far it reaches, as a
    fraction of the picture."""
    marked: float
    """Fraction of the rest of the picture where all photographs differ from what lies behind in the same way."""


@torch.no_grad()
def shared_errors(
    world: World, cameras: Sequence[Camera], photographs: PhotoSource, develop: Develop | None = None
) -> SharedErrors | None:
    """Compare photographs, corrected by what a fit has recovered of how they were taken, where they show the same
    surface points; None where too few do.
    """
    size = tuple(min(GRID, *(getattr(camera, side) for camera in cameras)) for side in ("height", "width"))
    with world.tracer.uncounted():
        pairs, alike = pairs_of(world, cameras, photographs, develop, size)
    marked = alike
    views = len(set(pairs.a.tolist()))
    if views < LEAST_VIEWS or len(pairs.a) < 100 * views:
        return None
    for _ in range(_PASSES):  # what is marked decides nothing else
        kept = pairs[~marked[pairs.cell] & ~marked[pairs.other]]
        if len(kept.a) < 100:
            kept = pairs
        gains, slopes = _solved(kept, len(cameras))
        differs = _marked(pairs, pairs.value - _model(pairs, gains, slopes), marked)
        marked = alike | differs
    kept = pairs[~marked[pairs.cell] & ~marked[pairs.other]]
    falloff, spread = _judged(kept, len(cameras))
    picture, known = marked.reshape(size), np.bincount(pairs.cell, minlength=len(marked)).reshape(size) > 0
    border, rest = _border(picture, known)
    inside = known & rest
    marks = int((differs.reshape(size) & inside).sum())
    return SharedErrors(falloff, spread, border, marks / int(inside.sum()) if marks >= MARKS else 0.0)


# ---- gains of photographs, and how brightness falls off: robust least squares


def _shapes(pairs: Pairs) -> Float64Array:
    """Differences of what the falloff is a sum of [n, 2]: squared distance and its square."""
    first, second = pairs.far.T
    return np.stack((first - second, first**2 - second**2), 1)


def _model(pairs: Pairs, gains: Float64Array, slopes: Float64Array) -> Float64Array:
    """What gains [views] and falloff [2] make of the logarithms."""
    return gains[pairs.a] - gains[pairs.b] + _shapes(pairs) @ slopes


def _normal(pairs: Pairs, weight: Float64Array, views: int) -> tuple[Float64Array, Float64Array]:
    """Normal equations of each pair of views [views, views, 3, 3] and their right sides [views, views, 3], for the
    difference of gains and both shapes.
    """
    rows = np.concatenate((np.ones((len(weight), 1)), _shapes(pairs)), 1)
    key, left, right = pairs.a * views + pairs.b, np.empty((views, views, 3, 3)), np.empty((views, views, 3))
    for i in range(3):
        right[..., i] = np.bincount(key, weight * rows[:, i] * pairs.value, views**2).reshape(views, views)
        for j in range(3):
            left[..., i, j] = np.bincount(key, weight * rows[:, i] * rows[:, j], views**2).reshape(views, views)
    return left, right


def _solution(left: Float64Array, right: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Gains [views] of mean 0 and slopes [2] by all pairs of views together."""
    views = len(left)
    matrix, vector, n = np.zeros((views + 2, views + 2)), np.zeros(views + 2), left[..., 0, 0]
    matrix[:views, :views] = np.diag(n.sum(1) + n.sum(0)) - n - n.T
    cross = left[..., 0, 1:].sum(1) - left[..., 0, 1:].sum(0)
    matrix[:views, views:], matrix[views:, :views] = cross, cross.T
    matrix[views:, views:] = left[..., 1:, 1:].sum((0, 1))
    vector[:views], vector[views:] = right[..., 0].sum(1) - right[..., 0].sum(0), right[..., 1:].sum((0, 1))
    matrix += 1e-6 * max(float(n.sum()) / views, 1e-12) * np.eye(views + 2)  # gains have a common factor
    found: Float64Array = np.linalg.solve(matrix, vector).astype(np.float64)
    seen = (n.sum(1) + n.sum(0)) > 0
    gains: Float64Array = np.where(seen, found[:views] - found[:views][seen].mean(), 0.0)
    return gains, found[views:]


def _weights(residual: Float64Array) -> Float64Array:
    """Huber's weights: one below a robust standard deviation, falling above."""
    scale = robust_deviation(residual, 0.0) + 1e-6
    return 1.0 / np.maximum(np.abs(residual) / scale, 1.0)


def _solved(pairs: Pairs, views: int) -> tuple[Float64Array, Float64Array]:
    """Gains and slopes, iteratively reweighted."""
    weight = np.ones(len(pairs.a))
    for _ in range(_ROUNDS):
        gains, slopes = _solution(*_normal(pairs, weight, views))
        weight = _weights(pairs.value - _model(pairs, gains, slopes))
    return gains, slopes


def _judged(pairs: Pairs, views: int) -> tuple[Estimate, Estimate]:
    """The falloff and the spread of gains."""
    gains, slopes = _solved(pairs, views)
    residual = pairs.value - _model(pairs, gains, slopes)
    left, right = _normal(pairs, _weights(residual), views)
    border = float(np.quantile(pairs.far[:, 0], 0.99)) if len(pairs.far) else 0.0
    reach = np.array([border, border**2])
    used = sorted(set(pairs.a.tolist()))
    found = []
    for view in used:  # the weights stay: only sums of pairs change
        kept = np.ones(views, np.bool_)
        kept[view] = False
        mask = np.outer(kept, kept)
        found.append(float(reach @ _solution(left * mask[..., None, None], right * mask[..., None])[1]))
    error = float(np.sqrt((len(used) - 1) * np.var(found)))  # jackknife
    # A gain's error is that of the means over pairs of views: what they disagree in.
    n = left[..., 0, 0]
    mean = (right[..., 0] - left[..., 0, 1:] @ slopes) / np.maximum(n, 1e-12) - (gains[:, None] - gains[None])
    squares, total = (n**2 * mean**2).sum(1) + (n**2 * mean**2).sum(0), n.sum(1) + n.sum(0)
    errors = np.sqrt(squares[used]) / np.maximum(total[used], 1e-12)
    spread = Estimate(float(gains[used].std()), float(np.sqrt(np.mean(errors**2))), len(used))
    return Estimate(float(reach @ slopes), error, len(used)), spread


# ---- places of the picture where all photographs have the same


def _marked(pairs: Pairs, residual: Float64Array, before: BoolArray) -> BoolArray:
    """Places of the picture [cells] where the photographs together differ from what others show of the same points."""
    cells, views = len(before), int(pairs.a.max()) + 1
    good = ~before[pairs.other]
    key, value = pairs.a[good] * cells + pairs.cell[good], residual[good]
    order = np.lexsort((value, key))
    key, value = key[order], value[order]
    names, first, count = np.unique(key, return_index=True, return_counts=True)
    median = value[first + count // 2]  # of each view at each place
    place = names % cells
    number = np.bincount(place, minlength=cells)
    mean = np.bincount(place, median, cells) / np.maximum(number, 1)
    variance = np.bincount(place, (median - mean[place]) ** 2, cells) / np.maximum(number - 1, 1)
    noise = robust_deviation(median, float(np.median(median)))
    # A spread that is small by chance is none: a tenth of the usual one at least.
    error = np.sqrt((variance + (0.1 * noise) ** 2) / np.maximum(number, 1))
    known = number >= min(LEAST_VIEWS, views)
    return np.asarray(known & (np.abs(mean) > bound(error, number, max(int(known.sum()), 1))))


def _border(picture: BoolArray, known: BoolArray) -> tuple[dict[str, float], BoolArray]:
    """How far each side of a picture [rows, columns] is marked, and what is left."""
    rest, found = np.ones_like(picture), {}
    for name, turns in (("left", 0), ("top", 1), ("right", 2), ("bottom", 3)):
        marks, seen, kept = (np.rot90(x, turns) for x in (picture, known, rest))
        columns = (marks & seen).sum(0) >= EDGE * np.maximum(seen.sum(0), 1)
        columns &= seen.any(0)
        depth = int(np.argmin(columns)) if not columns.all() else len(columns)
        if depth:
            found[name] = depth / len(columns)
            kept[:, :depth] = False  # a view of ``rest``
    return found, rest
