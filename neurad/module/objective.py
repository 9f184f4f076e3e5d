"""The objective of one step (paper Eq. 11): which estimate trains which parameters.

===============  ===========================================  ======================
term             compares                                     trains
===============  ===========================================  ======================
photometric      ``E + T_hat(E + sg[L])`` with photographs     materials (phi) only
prior            ``L`` with ``T_hat(E + L)``, first hit        radiance field (theta) only
second           the same at the second hit                   radiance field (theta) only
lhs              ``E + L`` with photographs                    radiance field (theta) only
===============  ===========================================  ======================
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neurad.core.records import Interaction, PixelBatch, Surface
from neurad.core.rng import Stream
from neurad.losses.relative import (
    Loss,
    full_gradient_prior,
    leave_one_out,
    relative_weight,
    semi_gradient_prior,
    two_pass,
)
from neurad.module.config import Objective, Sampling
from neurad.module.estimate import Estimator, some
from neurad.module.primary import PrimaryHits


@dataclass(frozen=True)
class StepTerms:
    """Weighted terms of one step."""

    materials: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches the materials only."""
    field: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches the radiance field only."""


@dataclass(frozen=True)
class ObjectiveStep:
    """Builds the terms of a step.

    Attributes:
        estimator: world, materials and radiance field.
        primary: camera rays of the training views.
        sampling: numbers of samples.
        settings: weights and forms of the terms.
        epsilon: floor of the relative losses in squared radiance units.
        mixed: pixels that an emitter covers, in part or whole; they train nothing [views, pixels], bool.
    """

    estimator: Estimator
    primary: PrimaryHits
    sampling: Sampling
    settings: Objective
    epsilon: float
    mixed: Tensor

    def __call__(self, batch: PixelBatch, stream: Stream) -> StepTerms:
        """Terms for a batch of photographed pixels."""
        world, settings = self.estimator.world, self.settings
        b, n = len(batch.view), self.sampling.positions
        first = self.primary(batch, n, stream)
        it = first.it
        surface = self.estimator.materials(it)
        emitted = world.emitted(it)
        both_sides = settings.prior > 0 and settings.prior_gradient == "full"
        samples, step = self.estimator.reflected(it, surface, self.sampling.secondary, stream)
        transported = samples.mean(1)
        counts = (~self.mixed[batch.view, batch.pixel]).float().unsqueeze(-1)

        # The radiance field with its gradient, at first hits and at some second hits, in one query.
        second = self._second_hits(step.next, stream)
        points = it if second is None else Interaction.cat(it, second)
        albedo = surface.albedo.detach()
        second_surface = None
        if second is not None:
            with torch.no_grad():
                second_surface = self.estimator.materials(second)
            albedo = torch.cat((albedo, second_surface.albedo))
        field = self.estimator.radiance(points, albedo)
        first_field = field[: len(it)]

        image = first.through(emitted + transported).view(b, n, 3)
        lhs_image = first.through(emitted + first_field * it.valid.unsqueeze(-1)).view(b, n, 3)
        normaliser = batch.color if settings.normaliser == "photograph" else lhs_image.detach().mean(1)
        weight = relative_weight(normaliser, self.epsilon) * counts
        materials = {"photometric": (1.0, self._photometric(batch, image, weight, stream))}
        if settings.roughness_pull > 0 and surface.roughness.requires_grad:
            materials["roughness_pull"] = (settings.roughness_pull, self._pull(surface.roughness))

        terms: dict[str, tuple[float, Loss]] = {}
        if settings.prior > 0:
            if both_sides:
                terms["prior"] = (settings.prior, self._full_prior(it, surface, first_field, stream))
            else:
                prior = semi_gradient_prior(first_field, transported, self.epsilon, it.valid)
                terms["prior"] = (settings.prior, prior)
            if second is not None and second_surface is not None:
                with torch.no_grad():
                    beyond, _ = self.estimator.reflected(second, second_surface, 1, stream)
                residual = semi_gradient_prior(field[len(it) :], beyond.squeeze(1), self.epsilon, second.valid)
                terms["second"] = (settings.prior, residual)
        if settings.lhs > 0:
            lhs_weight = relative_weight(lhs_image.mean(1), self.epsilon) * counts
            terms["lhs"] = (settings.lhs, leave_one_out(lhs_image, batch.color, lhs_weight))
        return StepTerms(materials, terms)

    def _pull(self, roughness: Tensor) -> Loss:
        """A quadratic pull of roughness [n, 1] towards its mean over the batch.

        Where nobody sees a highlight the photographs say nothing about roughness, and noise would carry it anywhere.
        The pull adds up to nothing over the batch, so the mean itself is left to the photographs.
        """
        pull = ((roughness - roughness.detach().mean()) ** 2).mean()
        return Loss(pull, pull.detach())

    def _second_hits(self, ends: Interaction, stream: Stream) -> Interaction | None:
        """Some of the points that BSDF samples reached, or None where the prior is not taken there."""
        if self.settings.prior <= 0 or self.sampling.second_hits <= 0:
            return None
        return ends[some(ends, self.sampling.second_hits, stream, self.sampling.secondary)]

    def _photometric(self, batch: PixelBatch, image: Tensor, weight: Tensor, stream: Stream) -> Loss:
        """The RHS image against photographs, by the estimator that the settings choose."""
        if self.settings.estimator == "leave_one_out":
            return leave_one_out(image, batch.color, weight)
        with torch.no_grad():
            first = self.primary(batch, self.sampling.positions, stream)
            surface = self.estimator.materials(first.it)
            again, _ = self.estimator.reflected(first.it, surface, self.sampling.secondary, stream)
            other = first.through(self.estimator.world.emitted(first.it) + again.mean(1)).view_as(image)
        return two_pass(image, other, batch.color, weight)

    def _full_prior(self, it: Interaction, surface: Surface, field: Tensor, stream: Stream) -> Loss:
        """The prior at first hits with theta's gradient through both sides: two independent estimates of T."""
        fixed = surface.detach()
        half = max(1, self.sampling.secondary // 2)
        first, _ = self.estimator.reflected(it, fixed, half, stream, field_gradient=True)
        other, _ = self.estimator.reflected(it, fixed, half, stream, field_gradient=True)
        return full_gradient_prior(field, first.mean(1), other.mean(1), self.epsilon, it.valid)
