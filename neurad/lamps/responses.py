"""Pictures lit by one lamp at a time: which lamps they tell apart, and how bright those are that nothing else tells of.

Light is linear in the radiance of every lamp. At random photographed pixels each lamp alone, of radiance 1, gives a
column of a matrix; photographs are a non-negative sum of these columns, as far as the materials are what they are taken
for. That is only how the lamps begin.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.core.errors import InputError
from neurad.core.protocols import Emitter
from neurad.core.records import BoolArray, Float64Array, PixelBatch
from neurad.core.rng import Stream
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.emitters.lights import AnyLights, Lights, join, parts
from neurad.integrators.estimator import Estimator
from neurad.integrators.path import PathTracing
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import World

_PIXELS, _SPP, _DEPTH = 1024, 4, 6  # of each picture: pixels, samples in each of two halves, longest path
ALIKE = 0.99
"""Correlation of two lamps' pictures from which on nothing distinguishes them."""
MEET = 0.1
"""Fraction of the dimmer lamp's light that has to fall where another's does for the one to fix the other's scale."""
_DARK = 1e-6  # of the brightest picture's mean: nothing arrives
_KNOWN = 0.1  # of a picture's mean square, what its two halves have in common at least for it to count
_FLOOR = 0.1  # of the mean: below it pixels count by their absolute error
_MIN_RADIANCE = 0.01  # of the photographs' mean: what a lamp gives at least to begin with
_MIN_CHANNEL = 0.05  # of a lamp's brightest channel: what the others have at least to begin with


@dataclass(frozen=True)
class Responses:
    """Pictures by one light at a time, and what is to be explained; all of the same pixels."""

    halves: Float64Array
    """By each lamp alone at radiance 1, in two independent halves [2, m, n, 3]."""
    known: Float64Array | None
    """By all light that is known and no lamp [n, 3]; None where there is none."""
    sky: Float64Array | None
    """By an environment that is recovered, as bright as it begins [n, 3]; None where there is none."""
    photographs: Float64Array
    """[n, 3]."""

    @property
    def lamps(self) -> Float64Array:
        """By each lamp alone [m, n, 3]."""
        return np.asarray(self.halves.mean(0))

    @property
    def reaches(self) -> BoolArray:
        """Lamps whose light arrives at some of the pixels [m]."""
        light = self.lamps.mean((1, 2))
        return np.asarray(light > _DARK * max(float(light.max(initial=0.0)), 1e-300))

    @property
    def weight(self) -> Float64Array:
        """Weight of the residual in each pixel and channel [n, 3]: what is bright counts relatively."""
        return np.asarray(1.0 / (self.photographs + _FLOOR * self.photographs.mean() + 1e-300))


@torch.no_grad()
def lamp_responses(assembly: Assembly, primary: PrimaryHits, sample: PixelBatch, seed: int) -> Responses:
    """Path-trace random photographed pixels, which show no emitter, in the light of one recovered lamp at a time, with
    the materials as they are.
    """
    world, device, lamps = assembly.world, primary.origin.device, assembly.lamps
    assert lamps is not None
    with world.tracer.uncounted():
        si, color = primary.some(sample, _PIXELS, Stream(seed, 31, device=device))
        si, color = si[si.valid], color[si.valid]
        surface, method = assembly.materials(si), PathTracing(_DEPTH, _DEPTH)

        def lit(emitter: Emitter, key: int) -> Tensor:
            estimator = Estimator(world.under(emitter), assembly.materials, None, method)
            value = estimator.image(si, surface, 2 * _SPP, Stream(seed, 32, key, device=device)).value
            return value.view(len(si), 2, _SPP, 3).mean(2).double().cpu()

        parts = []
        for row in range(len(lamps.mesh)):
            try:
                alone = AreaLights(world.geometry, (lamps.lamp == row).float().unsqueeze(-1).expand(-1, 3).contiguous())
            except InputError:  # it has no area
                parts.append(torch.zeros(len(si), 2, 3, dtype=torch.float64))
                continue
            parts.append(lit(alone, row))
        others = [other_lights(world, assembly.environment), assembly.environment]
        known, sky = (
            None if other is None else lit(other, len(parts) + key).mean(1).numpy() for key, other in enumerate(others)
        )
    halves: Float64Array = torch.stack(parts).permute(2, 0, 1, 3).numpy()
    return Responses(halves, known, sky, color.double().cpu().numpy())


def other_lights(world: World, unknown: Environment | None) -> AnyLights | None:
    """All light of a world but its area lights and an environment that is ``unknown``; None where there is none."""
    _, environment, punctual = parts(world.lights)
    radius = world.lights.radius if isinstance(world.lights, Lights) else 0.0
    return join(None, environment if unknown is None else None, punctual, radius)


def indistinguishable(responses: Responses, observed: BoolArray) -> list[list[int]]:
    """Lamps in groups that what they light does not distinguish; each of those that are ``observed`` [m] alone.

    The correlation of two pictures is taken of independent halves of the samples, so noise makes nothing unlike.
    """
    first, second = (half * responses.weight for half in responses.halves)
    flat = [half.reshape(len(half), -1) for half in (first, second)]
    product = flat[0] @ flat[1].T
    product = (product + product.T) / 2
    own = np.sqrt(np.maximum(np.diag(product), 1e-300))
    close = product / np.outer(own, own) > ALIKE
    squares = np.mean([np.square(half).sum(1) for half in flat], 0)
    known = np.diag(product) > _KNOWN * squares  # else rare paths decide, and correlations are those of noise
    usable = responses.reaches & ~observed & known
    close &= np.outer(usable, usable)
    return _groups(close)


def nonnegative_least_squares(
    responses: Responses, radiance: Float64Array, observed: BoolArray, groups: list[list[int]]
) -> Float64Array:
    """Radiance of every lamp [m, 3] that explains the photographs best, each channel by itself.

    What is known of the light (``radiance`` [m, 3] of lamps that are ``observed`` [m], lights of other kinds) is one
    column; the factor that it gets is how much brighter the surfaces are than they are taken for, and all others are
    divided by it.
    """
    from scipy.optimize import nnls  # imported where it is needed: it loads slowly

    pictures, weight, target = responses.lamps, responses.weight, responses.photographs
    known = np.einsum("mc,mnc->nc", radiance * observed[:, None], pictures)
    if responses.known is not None:
        known = known + responses.known
    free = [group for group in groups if not observed[group].any() and responses.reaches[group].any()]
    found = np.zeros((len(pictures), 3))
    for channel in range(3):
        columns = [known[:, channel], *(pictures[group, :, channel].sum(0) for group in free)]
        columns += [] if responses.sky is None else [responses.sky[:, channel]]
        w = weight[:, channel]
        x, _ = nnls(np.stack(columns, 1) * w[:, None], target[:, channel] * w)
        factor = float(np.clip(x[0], 0.2, 5.0)) if known[:, channel].any() else 1.0
        for group, value in zip(free, x[1:], strict=False):
            found[group, channel] = value / factor
    mean = float(target.mean())
    for group in free:
        light = max(float(pictures[group].sum(0).mean()), 1e-300)
        least = _MIN_RADIANCE * mean / light
        found[group] = np.maximum(found[group], max(_MIN_CHANNEL * float(found[group].max()), least))
    return found


def connected(responses: Responses, radiance: Float64Array, observed: BoolArray) -> BoolArray:
    """Lamps [m] whose scale is fixed: those ``observed``, and those that shine where light of fixed scale does."""
    light = radiance[:, None] * responses.lamps * responses.weight  # [m, n, 3]
    fixed = observed.copy()
    parts = [*light]
    for other, is_known in ((responses.known, True), (responses.sky, False)):
        if other is not None:
            parts.append(other * responses.weight)
            fixed = np.append(fixed, is_known)
    sums = np.array([part.sum() for part in parts])
    meet = np.array([[np.minimum(a, b).sum() for b in parts] for a in parts])
    near = meet > MEET * np.maximum(np.minimum.outer(sums, sums), 1e-300)
    for group in _groups(near):
        fixed[group] = fixed[group].any()
    return fixed[: len(radiance)]


def _groups(near: BoolArray) -> list[list[int]]:
    """Sets of indices that pairs ``near`` [m, m] connect."""
    from scipy.sparse.csgraph import connected_components  # imported where it is needed: it loads slowly

    count, group = connected_components(near, directed=False)
    return [np.flatnonzero(group == i).tolist() for i in range(count)]
