"""What training pixels that were never drawn say of the fields' levels: a cross-validated Wiener filter.

With the light held fixed a pixel is linear in the albedo it shows, and nearly so in the roughness:
``I(s) = I(1) + D (a(s) - a(1)) + R (r(s) - r(1))`` for factors ``s`` of the levels, with ``D`` and ``R`` from one pass
over these pixels. The factors minimise the squared residual relative to the prediction, a product of two independent
halves of the samples, so that Monte Carlo noise cancels in its mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from neurad.fields.material import AlbedoField, RoughnessField
from neurad.losses.relative import relative_weight
from neurad.metrics.pixel_derivatives import PixelDerivatives
from neurad.optim.level_factors import LevelFactors

LARGEST = 2.0
"""Largest factor: decay shrinks levels that photographs would have larger."""
SPREAD = 0.5
"""Spread of the factors around 1 before the pixels are asked; it decides where they say nothing."""
ITERATIONS = 30
SIGMAS = 2.0
"""Factors are kept if the pixels' loss falls by more than this many standard errors."""


class FittedFields(Protocol):
    """Materials whose fields can be asked by their features."""

    albedo: AlbedoField
    roughness: RoughnessField | None


@dataclass(frozen=True)
class LevelFit:
    """What the pixels said."""

    factors: list[Tensor]
    """Of albedo's levels and, if there is a roughness, of its levels [levels]."""
    before: float
    """The pixels' squared residual relative to the prediction, its noise included, with all factors 1."""
    after: float
    """The same with the new factors."""
    error: float
    """Standard error of the difference."""

    @property
    def holds(self) -> bool:
        """Whether the factors lower the loss by more than noise explains."""
        return self.before - self.after > SIGMAS * self.error


def fit_levels(pixels: PixelDerivatives, materials: FittedFields, levels: LevelFactors, epsilon: float) -> LevelFit:
    """The factors of the levels with which the fields explain pixels that they were not fitted to.

    Args:
        pixels: training pixels that no batch drew, derivatives at the present fields.
        materials: the fields, with all factors 1.
        levels: whose factors are looked for; they do not change.
        epsilon: floor of the relative loss in squared radiance units.
    """
    response = _Response(pixels, materials, levels, epsilon)
    count = len(response.sizes)
    scale = torch.ones(sum(response.sizes), device=response.device, requires_grad=True)
    ones = [torch.ones(size, device=response.device) for size in response.sizes]
    with torch.no_grad():
        start = response.losses(ones)  # [b]
    # A loss that noise has driven to zero or below says nothing of a scale: that of its spread does.
    unit = max(float(start.mean()), float(start.std()) / max(len(start), 1) ** 0.5, 1e-12)
    optimizer = torch.optim.LBFGS([scale], max_iter=ITERATIONS, history_size=count * 10, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        optimizer.zero_grad()
        with torch.enable_grad():
            loss = response.losses(list(torch.split(scale, response.sizes))).mean() / unit
            loss = loss + (scale - 1.0).square().sum() / (len(pixels) * SPREAD**2)
            loss.backward()
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    factors = [part.clamp(0.0, LARGEST) for part in torch.split(scale.detach(), response.sizes)]
    with torch.no_grad():
        end = response.losses(factors)
    off = (start - end).double()
    error = float(off.std()) / max(len(off), 1) ** 0.5
    return LevelFit(factors, float(start.mean()), float(end.mean()), error)


class _Response:
    """Losses of the pixels as a function of the factors."""

    def __init__(self, pixels: PixelDerivatives, materials: FittedFields, levels: LevelFactors, epsilon: float) -> None:
        self.materials = materials
        device = next(iter(materials.albedo.grid.parameters())).device
        tensors = {
            name: torch.from_numpy(np.ascontiguousarray(getattr(pixels, name))).to(device)
            for name in ("residual", "by_albedo", "by_roughness", "predicted", "points")
        }
        self.residual, self.by_albedo = tensors["residual"], tensors["by_albedo"]  # [2, b, 3]
        self.by_roughness = tensors["by_roughness"]
        self.weight = relative_weight(tensors["predicted"], epsilon)  # [b, 3]
        self.samples = tensors["points"].shape[1]
        points = tensors["points"].reshape(-1, 3)
        fields = [materials.albedo] + ([] if materials.roughness is None else [materials.roughness])
        self.sizes = [len(factors) for field in fields if (factors := levels.of(field.grid)) is not None]
        with torch.no_grad():
            self.features = [field.features(points) for field in fields]
            self.at_ones = self._values([torch.ones(size, device=device) for size in self.sizes])
        self.device = device

    def _values(self, factors: list[Tensor]) -> tuple[Tensor, Tensor | None]:
        """Means over the pixels of albedo [b, 3] and roughness [b, 1]."""
        scaled = [x * f.repeat_interleave(x.shape[1] // len(f)) for x, f in zip(self.features, factors, strict=True)]
        albedo = self.materials.albedo.of_features(scaled[0])
        roughness = None
        if self.materials.roughness is not None:
            roughness = self._mean(self.materials.roughness.of_features(scaled[1], albedo))
        return self._mean(albedo), roughness

    def _mean(self, values: Tensor) -> Tensor:
        return values.view(-1, self.samples, values.shape[1]).mean(1)

    def losses(self, factors: list[Tensor]) -> Tensor:
        """Squared relative residuals of the pixels [b], means over the channels."""
        albedo, roughness = self._values(factors)
        residual = self.residual - self.by_albedo * (albedo - self.at_ones[0])  # [2, b, 3]
        if roughness is not None and self.at_ones[1] is not None:
            residual = residual - self.by_roughness * (roughness - self.at_ones[1])
        losses: Tensor = (residual[0] * residual[1] * self.weight).mean(-1)
        return losses
