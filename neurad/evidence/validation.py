"""What training pixels that were never drawn say of the fields' levels: a cross-validated Wiener filter.

With the light held fixed a pixel is linear in the albedo it shows, and nearly so in the roughness:
``I(s) = I(1) + D (a(s) - a(1)) + R (r(s) - r(1))`` for factors ``s`` of the levels, with ``D`` and ``R`` from one pass
over these pixels. The factors minimise the squared residual over that of the light that falls in, which is the squared
error of an albedo: a product of two independent halves of the samples, so that Monte Carlo noise cancels in its mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neurad.core.parameters import ALBEDO
from neurad.core.records import FloatArray, IntArray
from neurad.evidence.pixel_derivatives import PixelDerivatives
from neurad.fields.material import MaterialField
from neurad.losses.relative import relative_weight
from neurad.optim.polyak_average import LevelFactors

MAX_FACTOR = 2.0
"""Largest factor: decay shrinks levels that photographs would have larger."""
SPREAD = 0.2
"""Spread of the factors around 1 before the pixels are asked; it decides where they say nothing."""
ROUNDS, QUICK, STEP = (1, 2, 2), (2,), 0.02
"""Gauss-Newton steps with each set of derivatives by the factors, those where one set has to do, and the difference of
factors that derivatives are of."""
SIGMAS = 2.0
"""Factors are clear if they lower the loss of pixels that they were not fitted to by so many standard errors."""
SHOWN = {ALBEDO.name: -SIGMAS}
"""Standard errors from which results show factors, where that is not :data:`SIGMAS`. Those of the albedo gained up to
1.3 dB in four rooms, and lost 0.1 at most, whatever sign this had: what two halves of the pixels find has twice the
noise of what all of them do. Roughness has less noise to take out, and wrong factors cost up to half a dB of it."""


Fields = dict[str, MaterialField]
"""Those that are trained, by the name of their parameter, the albedo first."""


@dataclass(frozen=True)
class LevelFit:
    """What the pixels said of one field."""

    factors: Tensor
    """Factors of its levels [levels]; ones where others would not be better."""
    gain: float
    """By how much they lower the squared residual in units of the albedo, each half of the pixels judging factors that
    were fitted to the other half."""
    error: float
    """Standard error of that."""
    holds: bool
    """Whether results show the factors, see :data:`SHOWN`; if not, they are 1."""

    @property
    def is_clear(self) -> bool:
        """Whether they lower it by more than noise explains: what training goes on from, for good."""
        return self.gain > SIGMAS * self.error


def fit_levels(
    pixels: PixelDerivatives, trained: Fields, levels: LevelFactors, epsilon: float, quick: bool = False
) -> list[LevelFit]:
    """The factors of the levels with which the fields explain pixels that they were not fitted to: those of the albedo,
    and with them those of the others.

    Args:
        pixels: training pixels that no batch drew, derivatives at the present fields.
        trained: the fields, with all factors 1.
        levels: whose factors are looked for; they do not change.
        epsilon: floor of the relative loss in squared radiance units.
        quick: only those of the albedo, with one set of derivatives: a third of the time, and enough where more is
            found soon after.
    """
    rounds = QUICK if quick else ROUNDS
    with torch.no_grad():
        response = _Response(pixels, trained, levels, epsilon)
        factors = [torch.ones(size, device=response.device) for size in response.sizes]
        odd = torch.from_numpy(pixels.odd).to(response.device)
        found: list[LevelFit] = []
        for _ in range(2):
            for index, name in enumerate(list(response.fields)[: 1 if quick else None]):
                sigmas = SHOWN.get(name, SIGMAS)
                found[index : index + 1] = [_cross_validated(response, factors, index, odd, sigmas, rounds)]
                factors[index] = found[index].factors
            if not any(fit.holds for fit in found[1:]):
                break  # otherwise again: what one field has explained by now, the other need not
    return found


def _cross_validated(
    response: _Response,
    factors: list[Tensor],
    index: int,
    odd: Tensor,
    sigmas: float,
    rounds: tuple[int, ...] = ROUNDS,
) -> LevelFit:
    """The factors of one field, those of the others as they are, if pixels confirm what others have said."""
    ones = torch.ones_like(factors[index])
    start = response.losses(_with(factors, index, ones))  # [b]
    first, second, whole = _fitted(response, factors, index, (odd, ~odd, torch.ones_like(odd)), rounds)
    off = torch.zeros_like(start)
    for half, fitted in ((odd, first), (~odd, second)):
        off += torch.where(half, 0.0, start - response.losses(_with(factors, index, fitted)))
    off = off.double()
    gain, error = float(off.mean()), float(off.std()) / max(len(off), 1) ** 0.5
    holds = gain > sigmas * error
    return LevelFit(whole if holds else ones, gain, error, holds)


def _with(factors: list[Tensor], index: int, of_field: Tensor) -> list[Tensor]:
    return [*factors[:index], of_field, *factors[index + 1 :]]


def _fitted(
    response: _Response, factors: list[Tensor], index: int, parts: tuple[Tensor, ...], rounds: tuple[int, ...]
) -> list[Tensor]:
    """The factors of one field that explain each part of the pixels [b] best, the last of which is all of them.

    Gauss-Newton steps; derivatives are taken where the last part is, for all of them: they hardly differ.
    """
    ones = torch.ones_like(factors[index])
    found = [ones] * len(parts)
    for steps in rounds:
        derivative = response.by_factors(_with(factors, index, found[-1]), index)  # [levels, 2, b, 3]
        for number, part in enumerate(parts):
            j, weight = derivative[:, :, part], response.weight[part]
            square = torch.einsum("kbc,lbc,bc->kl", j[:, 0], j[:, 1], weight)
            for _ in range(steps):
                e = response.residual(_with(factors, index, found[number]))[:, part]
                noise = (e.square() * weight).sum((0, 2)).mean().clamp_min(1e-12) / 2.0
                slope = 0.5 * torch.einsum("khbc,hbc,bc->k", j, e.flip(0), weight)
                prior = noise / SPREAD**2
                normal = 0.5 * (square + square.T) + prior * torch.eye(len(ones), device=ones.device)
                change = torch.linalg.solve(normal, slope + prior * (found[number] - 1.0))
                found[number] = (found[number] - change).clamp(0.0, MAX_FACTOR)
    return found


class _Response:
    """Losses of the pixels as a function of the factors."""

    def __init__(self, pixels: PixelDerivatives, trained: Fields, levels: LevelFactors, epsilon: float) -> None:
        self.fields = trained
        device = next(iter(self.fields[ALBEDO.name].grid.parameters())).device

        def on_device(values: FloatArray | IntArray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(values)).to(device)

        self.at_start = on_device(pixels.residual)  # [2, b, 3]
        self.by = [on_device(pixels.by[name]) for name in self.fields]  # [2, b, 3] each
        self.weight = (
            relative_weight(on_device(pixels.predicted), epsilon) * on_device(pixels.albedo).square()
        )  # [b, 3]
        points = on_device(pixels.points)[:, ::2]  # half of them say what a pixel shows
        self.samples, points = points.shape[1], points.reshape(-1, 3)
        prims = on_device(pixels.prims)[:, ::2].reshape(-1)
        fields = self.fields.values()
        self.sizes = [len(factors) for field in fields if (factors := levels.of(field.grid)) is not None]
        self.segments = [field.segment_at(points, prims) for field in fields]
        self.features = [field.features(points, at) for field, at in zip(fields, self.segments, strict=True)]
        self.at_ones = self._values([torch.ones(size, device=device) for size in self.sizes])
        self.device = device

    def _values(self, factors: list[Tensor]) -> list[Tensor]:
        """Means of the parameters over the pixels [b, channels], in the order of the fields."""
        scaled = [x * f.repeat_interleave(x.shape[1] // len(f)) for x, f in zip(self.features, factors, strict=True)]
        first, *others = self.fields.values()
        albedo = first.of_features(scaled[0], None, self.segments[0])
        rest = zip(others, scaled[1:], self.segments[1:], strict=True)
        values = [albedo, *(field.of_features(x, albedo, segment) for field, x, segment in rest)]
        return [x.view(-1, self.samples, x.shape[1]).mean(1) for x in values]

    def losses(self, factors: list[Tensor]) -> Tensor:
        """Squared residuals of the pixels [b], means over channels, without Monte Carlo noise on average."""
        residual = self.residual(factors)
        return (residual[0] * residual[1] * self.weight).mean(-1)

    def by_factors(self, factors: list[Tensor], index: int) -> Tensor:
        """Derivatives of the residuals by the factors of one field [levels, 2, b, 3], by differences."""
        start = self.residual(factors)
        changed = [factors[index] + STEP * row for row in torch.eye(len(factors[index]), device=self.device)]
        return torch.stack([(self.residual(_with(factors, index, to)) - start) / STEP for to in changed])

    def residual(self, factors: list[Tensor]) -> Tensor:
        """Residuals of the pixels by half [2, b, 3]."""
        residual = self.at_start  # [2, b, 3]
        for by, value, before in zip(self.by, self._values(factors), self.at_ones, strict=True):
            residual = residual - by * (value - before)
        return residual
