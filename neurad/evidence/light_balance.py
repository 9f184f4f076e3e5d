"""What the albedo of surfaces says of light whose radiance is not known.

A brighter light over a darker surface explains photographs as well. But what a light reaches is a matter of place, and
a surface has much the same albedo all over: where the albedo follows a light, that light is wrong (as in the Retinex of
Land and McCann 1971). Of each part of the surfaces

    log (color(x) - sum over k of exp(d_k) g_k(x)) = log (sum over k of exp(d_k) l_k(x)) + constant + texture(x),

where light ``k`` would let a white sheet at ``x`` shine by ``l_k(x)``, surfaces reflect ``g_k(x)`` of it besides, and
``exp(d_k)`` is the factor that it lacks. What ``g_k`` is depends on the roughness, of which a part has one of a few:
how likely each is, is found with the factors (expectation conditional maximisation, Meng and Rubin 1993). The prior's
variance is that of the largest marginal likelihood (MacKay 1992), textures are Student's t, of each part another
standard deviation. What two halves of the surface do not agree on is texture: the change is multiplied by the
correlation of what they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from neurad.core.groups import centred
from neurad.core.records import Float64Array, IntArray, SurfaceInteraction
from neurad.evidence.shading import parts_of_scan
from neurad.scene.geometry import Geometry
from neurad.scene.parts import SurfaceParts, segments

BLOCKS = 8
"""Cells along the longest side of the scene whose points are in one half of the surface."""
DARK = 0.02
"""Albedo, and fraction of the mean light, at which a point counts a quarter: logarithms of less are noise."""
MAX_GLOSS = 0.9
"""How much of a colour may be something else than diffuse reflection."""
ROUNDS = 20
"""Of weights, variance and linearisation, none of which changes a logarithm by more than 1."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t."""
CONVERGED = 1e-3
"""Change of a logarithm below which no further round is made."""
START = 0.5
"""Standard deviation of the logarithms at first."""
CHANCE = 0.05
"""Chance that a light is found to be needed where none is."""


@dataclass(frozen=True)
class LitPoints:
    """Where the albedo is looked at."""

    color: Float64Array
    """Radiance of each [n, 3]."""
    part: IntArray
    """Part of the surfaces that each is of [n]."""
    block: IntArray
    """Cell of each, along three axes [n, 3]; chessboards of cells are the two halves of the surface."""
    lights: Float64Array
    """Radiance of a white sheet there by each light, and last by all else [n, k + 1, 3]."""
    gloss: Float64Array
    """What the surface reflects besides of each, as rough as it may be [m, n, k + 1, 3]."""

    @property
    def half(self) -> IntArray:
        """0 or 1 [n]."""
        return np.asarray(self.block.sum(1) % 2)

    @property
    def count(self) -> int:
        """Lights in question."""
        return int(self.lights.shape[1]) - 1

    def of_lights(self, chosen: Sequence[int]) -> LitPoints:
        """The same with some of the lights in question; the others are as bright as they are taken for."""

        def joined(light: Float64Array) -> Float64Array:
            own = light[..., list(chosen), :]
            return np.concatenate((own, (light.sum(-2) - own.sum(-2))[..., None, :]), -2)

        return replace(self, lights=joined(self.lights), gloss=joined(self.gloss))

    @cached_property
    def light(self) -> Float64Array:
        """Of all lights [n, 3]."""
        return np.asarray(self.lights.sum(-2))

    @cached_property
    def weight(self) -> Float64Array:
        """How much points count by how dark they are [n, 3]."""
        albedo = self.color / np.maximum(self.light, 1e-30)
        lit = self.light / (self.light + DARK * self.light.mean(0) + 1e-30)
        return np.asarray((lit * albedo / (albedo + DARK)) ** 2)

    def albedo(self, channel: int, logs: Float64Array) -> tuple[Float64Array, Float64Array, Float64Array, Float64Array]:
        """Under lights brighter by factors with these logarithms [k], of each roughness: the logarithm of the albedo in
        a channel [m, n], that of its derivative by the logarithm of the colour [m, n], and what the first falls by
        [m, n, k], and the second rises by, with each of the logarithms [m, n, k].
        """
        factors = np.append(np.exp(logs), 1.0)
        lights, gloss = self.lights[..., channel] * factors, self.gloss[..., channel] * factors
        color, light = self.color[:, channel] + 1e-30, lights.sum(-1) + 1e-30
        left, least = color - gloss.sum(-1), (1.0 - MAX_GLOSS) * color
        diffuse, most = np.maximum(left, least), left <= least
        rise = np.where(most[..., None], 0.0, gloss[..., :-1] / diffuse[..., None])
        fall = (lights / light[:, None])[:, :-1] + rise
        return np.log(diffuse / light), np.where(most, 0.0, np.log(color / diffuse)), fall, rise


def smooth_pieces(geometry: Geometry, si: SurfaceInteraction) -> IntArray:
    """Which smooth piece of the surfaces each point is of [n]: paint ends where these do. What has no point on average
    is one with what it is connected to.
    """
    return surfaces(si, SurfaceParts(geometry, segments(geometry, float(geometry.face_area.sum()) / len(si))))


def surfaces(si: SurfaceInteraction, parts: SurfaceParts) -> IntArray:
    """Which of some parts each point is of [n]; in a scan of a room what faces the same way is one."""
    return parts_of_scan(parts.of(si.prim), si, len(si)).cpu().numpy()


def blocks(si: SurfaceInteraction) -> IntArray:
    """Which cell each point lies in [n, 3]."""
    p = si.p.double().cpu().numpy()
    low, high = p.min(0), p.max(0)
    return np.asarray(np.floor((p - low) / (float((high - low).max()) + 1e-30) * BLOCKS), np.int64)


def needed(points: LitPoints, margin: float, sure: int = 0) -> list[int]:
    """The lights that have to be brighter than they are taken for, by a factor of a margin, by stepwise selection; the
    first ``sure`` of them are.

    What one half of the surface says has to make the colours of the other likelier; colours of more than arrives are as
    unlikely as a texture of that size. Lights enter, the best first, while one does by more than a standard error,
    robust over cells. Then those leave, the worst first, that do not by more than chance (Bonferroni's bound, weighted
    by what they would add if they were no brighter than they are taken for, Genovese et al. 2006): of two that light
    much the same one enters by little, but is missed by much. How rough surfaces are is found with those that have
    entered.
    """
    from scipy.special import ndtri  # imported where it is needed: it loads slowly

    _, cell = np.unique(points.block, axis=0, return_inverse=True)

    def score(without: Float64Array, held: tuple[Float64Array, bool]) -> tuple[float, float]:
        """Gain by a light, and over its standard error; none where it is not brighter."""
        gains = np.bincount(cell.reshape(-1), without - held[0])
        total = float(gains.sum())
        return (total, total / float(np.sqrt(gains @ gains) + 1e-30)) if held[1] else (-np.inf, -np.inf)

    found, left = list(range(sure)), set(range(sure, points.count))
    share = points.lights[:, :-1].mean((0, 2))
    least = ndtri(1.0 - CHANCE * share / max(float(share[sure:].sum()), 1e-30))
    while left:
        rough = _as_rough(points, found)
        now = _held_out(rough, found, margin)[0]
        scores = {light: score(now, _held_out(rough, [*found, light], margin)) for light in left}
        best = max((light for light in left if scores[light][1] > 1.0), key=lambda light: scores[light][0], default=-1)
        if best < 0:
            break
        found.append(best)
        left.remove(best)
    while len(found) > sure:
        rough = _as_rough(points, found)
        others = [[k for k in found if k != light] for light in found[sure:]]
        errors = [
            score(_held_out(rough, rest, margin)[0], _held_out(rough, [*rest, light], margin))[1]
            for light, rest in zip(found[sure:], others, strict=True)
        ]
        beyond = np.array(errors) - least[found[sure:]]
        if beyond.min() > 0.0:
            break
        del found[sure + int(np.argmin(beyond))]
    return found


def _as_rough(points: LitPoints, chosen: Sequence[int]) -> LitPoints:
    """The same with the mean of what surfaces may reflect besides, as likely as the chosen lights make it."""
    chance = _solved(points.of_lights(chosen), points.weight).chance
    return replace(points, gloss=np.einsum("mn,mnkc->nkc", chance, points.gloss)[None])


def _held_out(points: LitPoints, chosen: Sequence[int], margin: float) -> tuple[Float64Array, bool]:
    """How unlikely each point's colour is [n] by what the other half of the surface says of the chosen lights, in nats,
    and whether both halves say in some channel that the last one is brighter by a margin. Of one roughness.
    """
    some, surprise, brighter = points.of_lights(chosen), np.zeros(len(points.part)), np.ones(3, bool)
    for half in (0, 1):
        use, other = (points.weight * (points.half == which)[:, None] for which in (half, 1 - half))
        found = _solved(some, use)
        if len(chosen):
            brighter &= found.logs[-1] > np.log(margin)
        for channel in range(3):
            y, derivative, *_ = some.albedo(channel, found.logs[:, channel])
            residual = centred(y[0], points.part, other[:, channel])
            level = found.level[channel][0]
            above = _likelihood(np.maximum(y[0], 0.0) / level, np.ones_like(level))
            surprise -= other[:, channel] * (derivative[0] + _likelihood(residual, level) + above)
    return surprise, bool(brighter.any())


def factors(points: LitPoints) -> tuple[Float64Array, float]:
    """Logarithms of the lights' factors [k, 3], and the root mean square of what they change."""
    found = _solved(points, points.weight).logs
    halves = [_solved(points, points.weight * (points.half == half)[:, None]).logs for half in (0, 1)]
    one, other = (_change(points, logs) for logs in halves)
    scale = np.sqrt((one**2).sum(0) * (other**2).sum(0))
    found *= np.maximum((one * other).sum(0), 0.0) / np.maximum(scale, 1e-30)
    return found, float(np.sqrt(np.mean(_change(points, found) ** 2)))


def brightness(points: LitPoints) -> tuple[Float64Array, Float64Array]:
    """Logarithms of the factors of lights that are known to be brighter [k, 3], and their standard errors, by how much
    parts of the surfaces differ (clusters of errors, Liang and Zeger 1986).
    """
    found = _solved(points, points.weight)
    return found.logs, found.errors


def _change(points: LitPoints, logs: Float64Array) -> Float64Array:
    """What factors of the lights change of the logarithm of light [n, 3], less its mean over each part."""
    light = points.lights[:, -1] + (points.lights[:, :-1] * np.exp(logs)).sum(1)
    return centred(np.log((light + 1e-30) / (points.light + 1e-30)), points.part)


@dataclass(frozen=True)
class _Solution:
    """What points say."""

    logs: Float64Array
    """Logarithms of the lights' factors [k, 3]."""
    errors: Float64Array
    """Standard errors of them [k, 3]."""
    chance: Float64Array
    """That points are as rough [m, n]."""
    level: list[Float64Array]
    """Of each channel, standard deviation of the texture at points that are as rough [m, n]."""


def _likelihood(residual: Float64Array, level: Float64Array) -> Float64Array:
    """Logarithm of Student's t's density, less a constant."""
    return -(FREEDOM + 1.0) / 2.0 * np.log1p((residual / level) ** 2 / FREEDOM) - np.log(level)


def _solved(points: LitPoints, use: Float64Array) -> _Solution:
    """The logarithms of the factors by how much points count [n, 3]."""
    from scipy.special import logsumexp  # imported where it is needed: it loads slowly

    (m, n), k = points.gloss.shape[:2], points.count
    _, part = np.unique(points.part, return_inverse=True)
    size = np.bincount(part)
    rows = (len(size) * np.arange(m)[:, None] + part).reshape(-1)  # each part has a mean of its own if it is as rough
    logs, errors, std = np.zeros((k, 3)), np.zeros((k, 3)), np.full(3, START)
    level, chance = [np.full((m, n), START)] * 3, np.full((m, n), 1.0 / m)
    weight = [np.tile(use[:, channel], (m, 1)) for channel in range(3)]
    for step in range(ROUNDS):
        given = [points.albedo(channel, logs[:, channel]) for channel in range(3)]
        # ---------------------- Outliers and roughness ----------------------
        says = np.zeros((m, len(size)))
        for channel, (y, derivative, *_) in enumerate(given):
            residual = centred(y.reshape(-1), rows, weight[channel].reshape(-1)).reshape(m, n)
            likely = use[:, channel] * (_likelihood(residual, level[channel]) + derivative)
            says += np.bincount(rows, likely.reshape(-1)).reshape(m, -1) / 3.0  # textures of channels are much the same
            weight[channel] = use[:, channel] * (FREEDOM + 1.0) / (FREEDOM + (residual / level[channel]) ** 2)
        if step >= 2:
            chance = np.exp(says - logsumexp(says, 0))[:, part]
        # ---------------------- Texture and factors ----------------------
        change = np.zeros((k, 3))
        for channel, (y, _, fall, rise) in enumerate(given):
            counts, number = np.bincount(part, use[:, channel]), np.bincount(part, use[:, channel] > 0)
            free = 1.0 - (number > 0).sum() / max(number.sum(), 1)
            flat = weight[channel].reshape(-1)
            residual, x = centred(y.reshape(-1), rows, flat), centred(fall.reshape(m * n, k), rows, flat)
            squares = np.bincount(rows, flat * residual**2).reshape(m, -1)
            pooled = float((chance * (squares / size)[:, part]).sum()) / max(free * counts.sum(), 1.0)
            level[channel] = np.sqrt((FREEDOM * pooled + squares) / (FREEDOM + free * counts))[:, part] + 1e-6
            scale = (chance * weight[channel] / level[channel] ** 2).reshape(-1)
            left = (x * scale[:, None]).T @ x
            inverse = np.linalg.inv(left + std[channel] ** -2 * np.eye(k))
            scores = x * (scale * residual)[:, None] + ((use[:, channel] * chance)[..., None] * rise).reshape(m * n, k)
            pull = scores.sum(0) - std[channel] ** -2 * logs[:, channel]
            change[:, channel] = (inverse @ pull).clip(-1.0, 1.0)
            of_parts = np.zeros((len(size), k))
            np.add.at(of_parts, np.tile(part, m), scores)
            errors[:, channel] = np.sqrt(np.diag(inverse @ of_parts.T @ of_parts @ inverse))
            determined = k - float(np.trace(inverse)) / std[channel] ** 2
            total = float(((logs + change)[:, channel] ** 2).sum())
            std[channel] = float(np.sqrt((total + START**2) / (determined + 1.0)))
        logs = logs + change
        if step >= 3 and np.abs(change).max(initial=0.0) < CONVERGED:
            break
    return _Solution(logs, errors, chance, level)
