"""The objective of one step (paper Eq. 11): which estimate trains which parameters.

===============  ===========================================  ======================
term             compares                                     trains
===============  ===========================================  ======================
photometric      the method's estimate with photographs        materials and light (phi) only
prior            ``L`` with ``T_hat(E + L)``, first hit        radiance field (theta) only
second           the same at the second hit                   radiance field (theta) only
lhs              ``E + L`` with photographs                    radiance field (theta) only
===============  ===========================================  ======================

A method without a field has the first row alone. ``prior_trains: both`` lets the prior move phi too. Of the light only
an environment that is being recovered is trained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.settings import Objective, Sampling
from neurad.assembly.training_views import TrainingViews
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction, first_of
from neurad.core.rng import Stream
from neurad.integrators.estimator import Estimator, subsample
from neurad.integrators.method import RadianceEstimate
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import NonDeltaHit
from neurad.losses.firefly import clamp_fireflies
from neurad.losses.leave_one_out import ControlVariate, leave_one_out
from neurad.losses.relative import (
    Loss,
    full_gradient_prior,
    moving_prior,
    relative_weight,
    semi_gradient_prior,
    two_pass,
)


@dataclass(frozen=True)
class IncidentSamples:
    """Light that first BSDF samples found."""

    si: SurfaceInteraction
    """Vertices that it arrived at [n]."""
    wi: Tensor
    """Directions that it came from, in their shading frames [n, 3]."""
    light: Tensor
    """RadianceEstimate radiance [n, 3]."""


@dataclass(frozen=True)
class StepTerms:
    """Weighted terms of one step."""

    materials: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches materials and light only."""
    field: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches the radiance field; phi too only with ``prior_trains: both``."""
    arrived: IncidentSamples | None = None
    """What a guide learns from; None from a method that does not tell."""

    @property
    def all(self) -> dict[str, tuple[float, Loss]]:
        """Every term."""
        return self.materials | self.field


@dataclass(frozen=True)
class _Points:
    """The radiance field at first hits and at some second hits, in one query."""

    first: Tensor
    """Values at the first hits [n, 3]."""
    second: SurfaceInteraction | None
    """Second hits at which the prior is taken as well."""
    second_surface: Surface | None
    second_field: Tensor


@dataclass(frozen=True)
class ObjectiveStep:
    """Builds the terms of a step (paper Eq. 11 and, in its term ``lhs``, Eq. 14).

    Attributes:
        estimator: world, materials, method and radiance field.
        primary: camera rays of the training views.
        sampling: numbers of samples.
        settings: weights and forms of the terms.
        epsilon: floor of the relative losses in squared radiance units.
        emitter_mask: pixels that an emitter covers, in part or whole; they train nothing [views, pixels], bool.
    """

    estimator: Estimator
    primary: PrimaryHits
    sampling: Sampling
    settings: Objective
    epsilon: float
    emitter_mask: Tensor

    def __call__(self, batch: PixelBatch, stream: Stream) -> StepTerms:
        """Terms for a batch of photographed pixels."""
        if batch.pixel_multiplier > 1:
            return replace(self, sampling=self.sampling.split_over(batch.pixel_multiplier))(
                replace(batch, pixel_multiplier=1), stream
            )
        b, n = len(batch.view), self.sampling.spp
        first = self.primary(batch, n, stream)
        si = first.si
        surface = self.estimator.materials(si)
        emitted = self.estimator.world.emitted(si)
        sample = self._image(si, surface, stream)
        image = first.attenuate(emitted + self._mean(sample.value)).view(b, n, 3)
        # Nothing is photographed where alpha is 0, even if a sample of the pixel meets the edge of a surface.
        counts = (~self.emitter_mask[batch.view, batch.pixel] & (batch.alpha > 0)).float().unsqueeze(-1)

        points, lhs_image, seen = None, None, None
        if self.estimator.radiance is not None:
            count = self._learning()
            at, at_surface = first.first(count, n), surface.first(count, n)
            points = self._query(at.si, at_surface, sample, stream)
            shown = first_of(emitted.detach(), count, n) + at.si.where_hit(points.first)
            lhs_image = at.attenuate(shown).view(b, count, 3)
            seen = lhs_image.detach().mean(1)
            batch = replace(batch, color=clamp_fireflies(batch.color, seen, self.epsilon, self.settings.firefly_clamp))
        weight = relative_weight(self._normaliser(batch, seen), self.epsilon) * counts
        control = self._control(sample)
        seen_control = None if control is None else replace(control, deviation=_through(first, control.deviation))
        materials = {"photometric": (1.0, self._photometric(batch, image, weight, seen_control, stream))}
        if self.settings.roughness_regulariser > 0 and surface.roughness.requires_grad:
            materials["roughness_regulariser"] = (self.settings.roughness_regulariser, self._pull(surface.roughness))

        terms: dict[str, tuple[float, Loss]] = {}
        if points is not None and self.settings.prior > 0:
            terms |= self._prior(at.si, at_surface, points, sample, control, stream)
        if lhs_image is not None and seen is not None and self.settings.lhs > 0:
            lhs_weight = relative_weight(seen, self.epsilon) * counts
            terms["lhs"] = (self.settings.lhs, leave_one_out(lhs_image, batch.color, lhs_weight))
        arrived = None
        if sample.Li_bsdf is not None and sample.sample_stats is not None:
            arrived = IncidentSamples(
                si.repeat(self.sampling.samples_per_vertex), sample.sample_stats.wi, sample.Li_bsdf
            )
        return StepTerms(materials, terms, arrived)

    def _learning(self) -> int:
        """At how many of the positions of each pixel the radiance field learns: the first ones, since positions are
        independent and those are as good as any.
        """
        return min(max(2, round(self.sampling.field_fraction * self.sampling.spp)), self.sampling.spp)

    def _image(self, si: SurfaceInteraction, surface: Surface, stream: Stream) -> RadianceEstimate:
        """The method's estimate at the positions of all pixels, spread evenly within each group."""
        stratum_size = self.sampling.spp // self.sampling.groups
        return self.estimator.image(si, surface, self.sampling.samples_per_vertex, stream, stratum_size)

    def _mean(self, samples: Tensor) -> Tensor:
        """Means over the secondary samples of every position [n, 3]."""
        count = self.sampling.samples_per_vertex
        return samples if count == 1 else samples.view(-1, count, 3).mean(1)

    def _control(self, sample: RadianceEstimate) -> ControlVariate | None:
        """The method's control variate by pixel and position, if it has one."""
        if sample.Li_bsdf is None or sample.sample_stats is None or not self.estimator.method.control_variate:
            return None
        n = self.sampling.spp
        around = sample.Li_bsdf * sample.sample_stats.relative
        light, deviation = (self._mean(x).view(-1, n, 3) for x in (around, sample.sample_stats.deviation))
        return ControlVariate(light, deviation, self.sampling.groups) if n > 1 else None

    def _normaliser(self, batch: PixelBatch, seen: Tensor | None) -> Tensor:
        """What the photometric residual is relative to [b, 3]; never the samples in it."""
        kind = self.settings.normaliser
        if kind == "prediction" and seen is not None:
            return seen
        if kind == "photograph":
            return batch.color
        return batch.color if batch.blurred is None else batch.blurred

    def _pull(self, roughness: Tensor) -> Loss:
        """A quadratic pull of roughness [n, 1] towards its mean over the batch.

        Where nobody sees a highlight the photographs say nothing about roughness, and noise would carry it anywhere.
        The pull adds up to nothing over the batch, so the mean itself is left to the photographs.
        """
        pull = ((roughness - roughness.detach().mean()) ** 2).mean()
        return Loss(pull, pull.detach())

    def _query(self, si: SurfaceInteraction, surface: Surface, sample: RadianceEstimate, stream: Stream) -> _Points:
        """The radiance field with its gradient."""
        radiance = self.estimator.radiance
        assert radiance is not None
        second = None
        if self.settings.prior > 0 and self.sampling.extra_bounce_fraction > 0 and sample.next is not None:
            second = sample.next[
                subsample(sample.next, self.sampling.extra_bounce_fraction, stream, self.sampling.samples_per_vertex)
            ]
        if second is None:
            values = radiance(si, surface.albedo.detach())
            return _Points(values, None, None, values[:0])
        with torch.set_grad_enabled(self.settings.prior_trains == "both"):
            second_surface = self.estimator.materials(second)
        albedo = torch.cat((surface.albedo.detach(), second_surface.albedo.detach()))
        values = radiance(SurfaceInteraction.cat(si, second), albedo)
        return _Points(values[: len(si)], second, second_surface, values[len(si) :])

    def _photometric(
        self, batch: PixelBatch, image: Tensor, weight: Tensor, control: ControlVariate | None, stream: Stream
    ) -> Loss:
        """The method's image against photographs, by the estimator that the settings choose."""
        if self.settings.estimator == "leave_one_out":
            return leave_one_out(image, batch.color, weight, control, self.sampling.groups)
        with torch.no_grad():
            first: NonDeltaHit = self.primary(batch, self.sampling.spp, stream)
            surface = self.estimator.materials(first.si)
            again = self._mean(self._image(first.si, surface, stream).value)
            other = first.attenuate(self.estimator.world.emitted(first.si) + again).view_as(image)
        if control is not None:
            image = image - control.residual()
        return two_pass(image, other, batch.color, weight)

    def _prior(
        self,
        si: SurfaceInteraction,
        surface: Surface,
        points: _Points,
        sample: RadianceEstimate,
        control: ControlVariate | None,
        stream: Stream,
    ) -> dict[str, tuple[float, Loss]]:
        """The prior at some first hits ``si`` and, where there are some, at second hits."""
        assert sample.transported is not None
        settings = self.settings
        if settings.prior_gradient == "full":
            prior = self._full_prior(si, surface, points.first, stream)
        else:
            transported = self._mean(sample.transported)
            if control is not None:
                transported = transported - control.residual().view(-1, 3)
            transported = first_of(transported, self._learning(), self.sampling.spp)
            prior = self._semi_prior(si, surface, points.first, transported, stream)
        terms = {"prior": (settings.prior, prior)}
        if points.second is not None and points.second_surface is not None:
            with torch.set_grad_enabled(settings.prior_trains == "both"):
                beyond = self.estimator.reflected(points.second, points.second_surface, 1, stream).squeeze(1)
            residual = self._semi_prior(points.second, points.second_surface, points.second_field, beyond, stream)
            terms["second"] = (settings.prior, residual)
        return terms

    def _semi_prior(
        self, si: SurfaceInteraction, surface: Surface, values: Tensor, transported: Tensor, stream: Stream
    ) -> Loss:
        """The prior with theta's gradient through the left side only."""
        if self.settings.prior_trains == "field":
            return semi_gradient_prior(values, transported, self.epsilon, si.valid)
        with torch.no_grad():
            other = self.estimator.reflected(si, surface, 1, stream).squeeze(1)
        return moving_prior(values, transported, other, self.epsilon, si.valid)

    def _full_prior(self, si: SurfaceInteraction, surface: Surface, values: Tensor, stream: Stream) -> Loss:
        """The prior at first hits with theta's gradient through both sides: two independent estimates of T."""
        fixed = surface if self.settings.prior_trains == "both" else surface.detach()
        half = max(1, self.sampling.samples_per_vertex // 2)
        lights = self.settings.prior_trains == "both"
        first = self.estimator.reflected(si, fixed, half, stream, field_gradient=True, light_gradient=lights)
        other = self.estimator.reflected(si, fixed, half, stream, field_gradient=True, light_gradient=lights)
        return full_gradient_prior(values, first.mean(1), other.mean(1), self.epsilon, si.valid)


def make_objective(assembly: Assembly, views: TrainingViews) -> ObjectiveStep:
    """The objective of a run."""
    settings = assembly.settings
    return ObjectiveStep(
        estimator=assembly.estimator,
        primary=views.primary,
        sampling=settings.sampling,
        settings=settings.objective,
        epsilon=settings.objective.epsilon * views.mean_square_radiance,
        emitter_mask=views.emitter_mask,
    )


def _through(first: NonDeltaHit, values: Tensor) -> Tensor:
    """What smooth surfaces before the first vertices leave of ``values`` [b, n, 3]."""
    return first.attenuate(values.view(-1, 3)).view_as(values)
