"""What the albedo of surfaces says of light whose radiance is not known.

A brighter light over a darker surface explains photographs as well. But what a light reaches is a matter of place, and
a surface has much the same albedo all over: where the albedo follows a light, that light is wrong (as in the Retinex of
Land and McCann 1971). Of each connected part of the surfaces

    log albedo(x) = constant + sum over k of d_k s_k(x) + texture(x),

where ``s_k(x)`` is the fraction of the irradiance at ``x`` that comes from light ``k``, and ``exp(d_k)`` the factor
that it lacks. The prior's variance is that of the largest marginal likelihood (MacKay 1992), errors are Student's t.
What two halves of the surface do not agree on is texture: the change is multiplied by the correlation of what they say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtri

from neurad.core.records import Float64Array, IntArray, SurfaceInteraction

BLOCKS = 8
"""Cells along the longest side of the scene whose points are in one half of the surface."""
DARK = 0.02
"""Added to the albedo, and part of the mean irradiance that is added to it: logarithms of less are noise."""
ROUNDS = 10
"""Of weights, variance and linearisation."""
FREEDOM = 4.0
"""Degrees of freedom of Student's t."""
START = 0.5
"""Standard deviation of the logarithms at first."""
CHANCE = 0.05
"""Chance that a light is found to be needed where none is."""


@dataclass(frozen=True)
class LitPoints:
    """Where the albedo is looked at."""

    albedo: Float64Array
    """[n, 3]."""
    part: IntArray
    """Connected part of each [n]."""
    block: IntArray
    """Cell of each, along three axes [n, 3]; chessboards of cells are the two halves of the surface."""
    lights: Float64Array
    """Irradiance from each light [n, k, 3]."""
    rest: Float64Array
    """Irradiance from all else [n, 3]."""

    @property
    def half(self) -> IntArray:
        """0 or 1 [n]."""
        found: IntArray = self.block.sum(1) % 2
        return found

    def of_lights(self, chosen: Sequence[int]) -> LitPoints:
        """The same with some of the lights in question; the others are as bright as they are taken for."""
        others = np.delete(self.lights, list(chosen), axis=1).sum(1)
        return replace(self, lights=self.lights[:, list(chosen)], rest=self.rest + others)

    def light(self, channel: int) -> tuple[Float64Array, Float64Array]:
        """Irradiance in a channel from each light [n, k], and from all else [n], a floor included."""
        lights, rest = self.lights[..., channel], self.rest[..., channel]
        return lights, rest + DARK * (rest + lights.sum(1)).mean()


def blocks(si: SurfaceInteraction) -> IntArray:
    """Which cell each point lies in [n, 3]."""
    p = si.p.double().cpu().numpy()
    low, high = p.min(0), p.max(0)
    found: IntArray = np.floor((p - low) / (float((high - low).max()) + 1e-30) * BLOCKS).astype(np.int64)
    return found


def needed(points: LitPoints) -> list[int]:
    """The lights that have to be brighter than they are taken for, by stepwise selection.

    What one half of the surface says has to make the albedo of the other flatter. Lights enter, the best first, while
    one does by more than a standard error, robust over cells; those that never do at all are looked at no more. Then
    those leave, the worst first, that do not by more than chance (Bonferroni's bound): of two that light much the same
    one enters by little, but is missed by much.
    """
    _, cell = np.unique(points.block, axis=0, return_inverse=True)

    def score(without: Float64Array, held: tuple[Float64Array, bool]) -> tuple[float, float]:
        """Gain by a light, and over its standard error; none where it is not brighter."""
        gains = np.bincount(cell.reshape(-1), without - held[0])
        total = float(gains.sum())
        return (total, total / float(np.sqrt(gains @ gains) + 1e-30)) if held[1] else (-np.inf, -np.inf)

    found, left = list[int](), set(range(points.lights.shape[1]))
    least = float(ndtri(1.0 - CHANCE / max(len(left), 1)))
    now = _held_out(points, [])
    while left:
        tried = {light: _held_out(points, [*found, light]) for light in left}
        scores = {light: score(now[0], held) for light, held in tried.items()}
        best = max((light for light in left if scores[light][1] > 1.0), key=lambda light: scores[light][0], default=-1)
        if best < 0:
            break
        found.append(best)
        left = {light for light in left if scores[light][0] > 0.0 and light != best}
        now = tried[best]
    while found:
        others = [[k for k in found if k != light] for light in found]
        errors = [
            score(_held_out(points, rest)[0], _held_out(points, [*rest, light]))[1]
            for light, rest in zip(found, others, strict=True)
        ]
        worst = int(np.argmin(errors))
        if errors[worst] > least:
            break
        del found[worst]
    return found


def _held_out(points: LitPoints, chosen: Sequence[int]) -> tuple[Float64Array, bool]:
    """How far the logarithm of each point's albedo [n] is from that of its part by what the other half of the surface
    says of the chosen lights, and whether both say in some channel that the last one is brighter.
    """
    some, residual, brighter = points.of_lights(chosen), np.zeros(len(points.part)), np.ones(3, bool)
    for channel in range(3):
        y = np.log(points.albedo[:, channel] + DARK)
        for half in (0, 1):
            use, other = (1.0 * (points.half == which) for which in (half, 1 - half))
            logs = _solved(some, channel, use) if len(chosen) else np.zeros(0)
            brighter[channel] &= len(logs) == 0 or bool(logs[-1] > 0)
            change = change_of_light(some, channel, logs)
            residual += other * np.abs(_centred(y - change, points.part, other))
    return residual, bool(brighter.any())


def factors(points: LitPoints, channel: int) -> tuple[Float64Array, float]:
    """Logarithms of the lights' factors [k] in one channel, and the root mean square of what they change."""
    everything, (first, second) = np.ones(len(points.part)), (1.0 * (points.half == half) for half in (0, 1))
    found = _solved(points, channel, everything)
    one, other = (
        _centred(change_of_light(points, channel, _solved(points, channel, half)), points.part)
        for half in (first, second)
    )
    scale = float(np.sqrt((one @ one) * (other @ other)))
    agreement = max(float(one @ other) / scale, 0.0) if scale > 0.0 else 0.0
    change = _centred(change_of_light(points, channel, agreement * found), points.part)
    return agreement * found, float(np.sqrt(np.mean(change**2)))


def change_of_light(points: LitPoints, channel: int, logs: Float64Array) -> Float64Array:
    """Change of the logarithm of the irradiance [n] by factors of the lights."""
    lights, rest = points.light(channel)
    found: Float64Array = np.log(rest + lights @ np.exp(logs)) - np.log(rest + lights.sum(1))
    return found


def _solved(points: LitPoints, channel: int, use: Float64Array) -> Float64Array:
    """The logarithms of the factors [k] by points that are used [n], 0 or 1."""
    lights, rest = points.light(channel)
    y = np.log(points.albedo[:, channel] + DARK)
    logs, std, weight = np.zeros(lights.shape[1]), START, use
    free = max(int(use.sum()) - len(np.unique(points.part[use > 0])), 1)
    for _ in range(ROUNDS):
        lit = lights * np.exp(logs)
        residual = _centred(y - change_of_light(points, channel, logs), points.part, weight)
        x = _centred(lit / (rest + lit.sum(1))[:, None], points.part, weight)
        level = float(np.sqrt((weight @ residual**2) / free)) + 1e-6
        weight = use * (FREEDOM + 1.0) / (FREEDOM + (residual / level) ** 2)
        # ---------------------- Normal equations ----------------------
        left = (x * weight[:, None]).T @ x / level**2
        inverse = np.linalg.inv(left + std**-2 * np.eye(len(logs)))
        logs = inverse @ (x.T @ (weight * residual) / level**2 + left @ logs)
        determined = len(logs) - float(np.trace(inverse)) / std**2
        std = float(np.sqrt((logs @ logs + START**2) / (determined + 1.0)))
    return logs


def _centred(values: Float64Array, part: IntArray, weight: Float64Array | None = None) -> Float64Array:
    """Values [n] or [n, c] less their weighted mean over each part."""
    weight = np.ones(len(part)) if weight is None else weight
    columns = values.reshape(len(part), -1)
    total = np.maximum(np.bincount(part, weight), 1e-30)
    means = np.stack([np.bincount(part, weight * column) / total for column in columns.T], -1)
    found: Float64Array = (columns - means[part]).reshape(values.shape)
    return found
