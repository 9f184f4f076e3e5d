"""The objective of one step (paper Eq. 11): which estimate trains which parameters.

====================  ===========================================  ======================
term                  compares                                     trains
====================  ===========================================  ======================
photometric           the method's estimate with photographs       materials and light (phi)
prior                 ``L`` with ``T_hat(E + L)``, first hits       radiance field (theta)
prior_extra_bounce    the same at hits of one more bounce          radiance field (theta)
lhs                   ``E + L`` with photographs                   radiance field (theta)
development           photographs with the method's estimate       gains and response
====================  ===========================================  ======================

A method without a field has the first row alone, which trains blending weights, too, where a method reads them.
``prior_trains: both`` lets the prior move phi too. Of the light only an environment that is being recovered is trained.
The last row is there where it is recovered how photographs were taken; all others see them as developed so far.

Shapes: b pixels of a batch, n samples per pixel (``spp``), of which the field learns at m (``field_fraction``), c
samples per vertex, e extra hits. Lanes are ordered by pixel, then sample, then vertex sample.
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neurad.assembly.lighting import recovered_lamps
from neurad.assembly.settings import Objective, Sampling
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch, Surface, SurfaceInteraction, first_of
from neurad.core.rng import Stream
from neurad.fields.development import FittedDevelopment
from neurad.integrators.estimator import Estimator, subsample
from neurad.integrators.method import RadianceEstimate
from neurad.integrators.primary_hits import PrimaryHits
from neurad.integrators.world import NonDeltaHit
from neurad.losses.lamps import shown_lamps
from neurad.losses.leave_one_out import ControlVariate, leave_one_out_censored
from neurad.losses.relative import (
    Loss,
    full_gradient_prior,
    moving_prior,
    relative_weight,
    semi_gradient_prior,
    two_pass,
)

LAMPS = 100.0
"""Weight of the photographs of the lamps themselves. While materials are still wrong all else pulls at the lamps: at 10
that of the Cornell box was 5 % off after 70 steps."""
MAX_SPECULAR_FRACTION = 0.65
"""Largest fraction of the BSDF samples that follow the specular lobe where highlights are."""


RESPONSE_RIDGE = 1e-4
"""Weight of the squared weights of the response curve: what no photograph tells stays as it was."""


GuideSamples = tuple[SurfaceInteraction, Tensor, Tensor]
"""Light that the first BSDF samples found: vertices that it arrived at [b * n * c], directions that it came from in
their shading frames and incident radiance that is reflected light itself [b * n * c, 3]."""


@dataclass(frozen=True)
class StepTerms:
    """Weighted terms of one step."""

    materials: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches materials, light and blending weights only."""
    field: dict[str, tuple[float, Loss]]
    """Terms whose gradient reaches the radiance field; phi too only with ``prior_trains: both``."""
    guide_samples: GuideSamples | None = None
    """What a guide records; None from a method whose estimates come without the radiance that arrived."""
    roughness: Tensor | None = None
    """At first hits [b * n, 1], with ``grad`` after the backward pass; None where pixels have no weights."""

    @property
    def all(self) -> dict[str, tuple[float, Loss]]:
        """Every term."""
        return self.materials | self.field


@dataclass(frozen=True)
class _ExtraHits:
    """Hits of one more bounce at which the prior is taken as well [e]."""

    si: SurfaceInteraction
    surface: Surface
    field: Tensor
    """``L_theta`` there, with its gradient [e, 3]."""


@dataclass(frozen=True)
class ObjectiveStep:
    """Builds the terms of a step (paper Eq. 11 and, in its term ``lhs``, Eq. 14).

    Attributes:
        estimator: world, materials, method and radiance field.
        primary: camera rays of the training views.
        sampling: numbers of samples.
        settings: weights and forms of the terms.
        epsilon: floor of the relative losses in squared radiance units.
        emitter_mask: pixels that an emitter covers, in part or whole, or that a mask leaves out; they train nothing
            [views, pixels], bool.
        development: how the photographs were taken, where that is recovered.
    """

    estimator: Estimator
    primary: PrimaryHits
    sampling: Sampling
    settings: Objective
    epsilon: float
    emitter_mask: Tensor
    development: FittedDevelopment | None = None

    def __call__(self, batch: PixelBatch, stream: Stream) -> StepTerms:
        """Terms for a batch of photographed pixels."""
        b, n, settings = len(batch.view), self.sampling.spp, self.settings
        taken = batch
        if self.development is not None:
            batch = self.development(batch)

        # Stage 1: primary hits.
        first = self.primary(batch, n, stream)  # [b * n]
        si = first.si

        # Stage 2: what surfaces are made of, and what they emit.
        surface = self._surface(first)  # [b * n]
        if batch.weight is not None and surface.roughness.requires_grad:
            surface.roughness.retain_grad()
        if batch.highlight is not None:
            own = self.sampling.specular_fraction
            fraction = own + (max(own, MAX_SPECULAR_FRACTION) - own) * batch.highlight
            surface = replace(surface, specular_fraction=fraction.repeat_interleave(n).unsqueeze(-1))
        emitted = self.estimator.world.emitted(si)  # [b * n, 3]

        # Stage 3: the method's estimate of reflected light, and the RHS image with it.
        sample = self._estimate(si, surface, stream)  # [b * n * c]
        image = first.attenuate(emitted + self._mean(sample.value)).view(b, n, 3)
        control = self._control(sample)

        # Stage 4: the radiance field at first hits, and the LHS image with it.
        extra, lhs_image, predicted = None, None, None
        if self.estimator.radiance is not None:
            m = self._field_samples
            at, at_surface = first.first(m, n), surface.first(m, n)  # [b * m]
            field, extra = self._query(at.si, at_surface, sample, stream)  # [b * m, 3]
            lhs_image = at.attenuate(first_of(emitted.detach(), m, n) + at.si.where_hit(field)).view(b, m, 3)
            predicted = lhs_image.detach().mean(1)  # [b, 3]

        # Stage 5: losses. Where alpha is 0 nothing is photographed, even if a sample meets the edge of a surface.
        counts = (~self.emitter_mask[batch.view, batch.pixel] & (batch.alpha > 0)).float().unsqueeze(-1)  # [b, 1]
        if batch.clipped is not None and predicted is not None:  # above the ceiling nothing is wrong
            counts = counts * ~(batch.clipped & (predicted >= batch.color))  # [b, 3]
        weight = relative_weight(self._normaliser(batch, predicted), self.epsilon, batch.variance) * counts  # [b, 3]
        if batch.weight is not None:
            weight = weight * batch.weight.unsqueeze(-1)
        in_image = None if control is None else replace(control, deviation=_attenuated(first, control.deviation))
        materials = {"photometric": (1.0, self._photometric(batch, image, weight, in_image, stream))}
        lamps = recovered_lamps(self.estimator.world)
        if lamps is not None and lamps.trains:
            materials["lamps"] = LAMPS, shown_lamps(lamps)
        if self.development is not None:
            materials["development"] = 1.0, self._development(self.development, taken, image, predicted, weight)
        if (wanted := self.estimator.method.regulariser(si, surface)) is not None:
            of_pixel = wanted.view(b, n).mean(1)
            loss = (of_pixel if batch.weight is None else batch.weight * of_pixel).mean()
            materials["regulariser"] = 1.0, Loss(loss, loss.detach())
        terms: dict[str, tuple[float, Loss]] = {}
        if lhs_image is not None and predicted is not None:
            if settings.prior > 0:
                terms["prior"] = settings.prior, self._prior(at.si, at_surface, field, sample, control, stream)
            if extra is not None:
                terms["prior_extra_bounce"] = settings.prior, self._prior_extra_bounce(extra, stream)
            if settings.lhs > 0:
                lhs_weight = relative_weight(predicted, self.epsilon, batch.variance) * counts
                lhs = leave_one_out_censored(
                    lhs_image, batch.color, lhs_weight, batch.clipped, chroma=settings.chroma_weight
                )
                terms["lhs"] = settings.lhs, lhs
        roughness = surface.roughness if surface.roughness.retains_grad else None
        return StepTerms(materials, terms, self._guide_samples(si, sample), roughness)

    def _surface(self, first: NonDeltaHit) -> Surface:
        """What surfaces are made of at first hits, read once where a position of a pixel was drawn more often."""
        if first.distinct is None:
            return self.estimator.materials(first.si)
        return self.estimator.materials(first.si[first.distinct.lanes]).map(first.distinct.spread)

    def _development(
        self, development: FittedDevelopment, batch: PixelBatch, image: Tensor, predicted: Tensor | None, weight: Tensor
    ) -> Loss:
        """The photographs as they are developed against the method's image [b, n, 3], which is held fixed.

        What is clipped says nothing here. The residual is linear in the image, so its noise leaves the gradient
        unbiased, and so does that of the photographs, since the derivative is that of what is predicted: by the
        radiance field [b, 3], or without one by half of the samples, which the residual then lacks.
        """
        if batch.clipped is not None:
            weight = weight * ~batch.clipped
        image = image.detach()
        if predicted is None and image.shape[1] > 1:
            halves = image.tensor_split(2, dim=1)
            predicted, image = halves[0].mean(1), halves[1]
        if development.bend is not None and predicted is not None:
            weight = weight * development.below_ceiling(batch, predicted)
        residual = development.colors(batch, predicted) - image.mean(1)
        loss = (weight * residual * residual).mean()
        if development.bend is not None:
            loss = loss + RESPONSE_RIDGE * development.bend.square().sum()
        return Loss(loss, loss.detach())

    @property
    def _field_samples(self) -> int:
        """Samples of a pixel at which the radiance field learns: the first ones, since samples are independent."""
        return min(max(2, round(self.sampling.field_fraction * self.sampling.spp)), self.sampling.spp)

    def _estimate(self, si: SurfaceInteraction, surface: Surface, stream: Stream) -> RadianceEstimate:
        """The method's estimate at first hits [b * n], stratified within each group of a pixel's samples."""
        stratum_size = self.sampling.spp // self.sampling.groups
        return self.estimator.image(si, surface, self.sampling.samples_per_vertex, stream, stratum_size)

    def _mean(self, samples: Tensor) -> Tensor:
        """Means over the samples of every vertex: [b * n * c, 3] to [b * n, 3]."""
        count = self.sampling.samples_per_vertex
        return samples if count == 1 else samples.view(-1, count, 3).mean(1)

    def _control(self, sample: RadianceEstimate) -> ControlVariate | None:
        """The method's control variate by pixel and sample [b, n, 3], if it has one."""
        if sample.Li_bsdf is None or sample.sample_stats is None or not self.estimator.method.control_variate:
            return None
        n = self.sampling.spp
        around = sample.Li_bsdf * sample.sample_stats.relative
        light, deviation = (self._mean(x).view(-1, n, 3) for x in (around, sample.sample_stats.deviation))
        return ControlVariate(light, deviation, self.sampling.groups) if n > 1 else None

    def _guide_samples(self, si: SurfaceInteraction, sample: RadianceEstimate) -> GuideSamples | None:
        """The radiance that arrived along BSDF samples, where the method has it."""
        if sample.Li_bsdf is None or sample.sample_stats is None:
            return None
        return si.repeat(self.sampling.samples_per_vertex), sample.sample_stats.wi, sample.Li_bsdf

    def _normaliser(self, batch: PixelBatch, predicted: Tensor | None) -> Tensor:
        """What the photometric residual is relative to [b, 3]; never the samples in it."""
        kind = self.settings.normaliser
        if kind == "prediction" and predicted is not None:
            return predicted
        if kind == "photograph":
            return batch.color
        return batch.color if batch.blurred is None else batch.blurred

    def _query(
        self, si: SurfaceInteraction, surface: Surface, sample: RadianceEstimate, stream: Stream
    ) -> tuple[Tensor, _ExtraHits | None]:
        """``L_theta`` with its gradient at first hits [b * m, 3] and, in the same query, at some of the next hits."""
        radiance = self.estimator.radiance
        assert radiance is not None
        fraction, c = self.sampling.extra_bounce_fraction, self.sampling.samples_per_vertex
        if self.settings.prior == 0 or fraction == 0 or sample.next is None:
            return radiance(si, surface.albedo.detach()), None
        extra = sample.next[subsample(sample.next, fraction, stream, c)]  # [e]
        with torch.set_grad_enabled(self.settings.prior_trains == "both"):
            extra_surface = self.estimator.materials(extra)
        albedo = torch.cat((surface.albedo.detach(), extra_surface.albedo.detach()))
        field = radiance(SurfaceInteraction.cat(si, extra), albedo)
        return field[: len(si)], _ExtraHits(extra, extra_surface, field[len(si) :])

    def _photometric(
        self, batch: PixelBatch, image: Tensor, weight: Tensor, control: ControlVariate | None, stream: Stream
    ) -> Loss:
        """The method's image [b, n, 3] against photographs (Eq. 11, 12), by the estimator of the settings."""
        chroma = self.settings.chroma_weight
        if self.settings.estimator == "leave_one_out":
            groups = self.sampling.groups
            return leave_one_out_censored(image, batch.color, weight, batch.clipped, control, groups, chroma)
        with torch.no_grad():
            first: NonDeltaHit = self.primary(batch, self.sampling.spp, stream)
            surface = self._surface(first)
            again = self._mean(self._estimate(first.si, surface, stream).value)
            other = first.attenuate(self.estimator.world.emitted(first.si) + again).view_as(image)
        if control is not None:
            image = image - control.residual()
        return two_pass(image, other, batch.color, weight, batch.clipped, chroma)

    def _prior(
        self,
        si: SurfaceInteraction,
        surface: Surface,
        field: Tensor,
        sample: RadianceEstimate,
        control: ControlVariate | None,
        stream: Stream,
    ) -> Loss:
        """The radiometric prior (Eq. 10) at first hits ``si`` [b * m], where ``field`` is ``L_theta``."""
        if self.settings.prior_gradient == "full":
            return self._full_prior(si, surface, field, stream)
        if sample.transported is None:
            name = type(self.estimator.method).__name__
            raise InputError(
                f"method {name}: it reads the radiance field, so what reflected gives back needs transported, which "
                "the prior compares with the field; if it reads none, say needs_field = False"
            )
        transported = self._mean(sample.transported)  # [b * n, 3]
        if control is not None:
            transported = transported - control.residual().view(-1, 3)
        transported = first_of(transported, self._field_samples, self.sampling.spp)
        return self._semi_prior(si, surface, field, transported, stream)

    def _prior_extra_bounce(self, extra: _ExtraHits, stream: Stream) -> Loss:
        """The prior at hits of one more bounce [e]."""
        with torch.set_grad_enabled(self.settings.prior_trains == "both"):
            transported = self.estimator.reflected(extra.si, extra.surface, 1, stream).squeeze(1)
        return self._semi_prior(extra.si, extra.surface, extra.field, transported, stream)

    def _semi_prior(
        self, si: SurfaceInteraction, surface: Surface, values: Tensor, transported: Tensor, stream: Stream
    ) -> Loss:
        """The prior (Eq. 10) with theta's gradient through the left side only."""
        if self.settings.prior_trains == "field":
            return semi_gradient_prior(values, transported, self.epsilon, si.valid)
        with torch.no_grad():
            other = self.estimator.reflected(si, surface, 1, stream).squeeze(1)
        return moving_prior(values, transported, other, self.epsilon, si.valid)

    def _full_prior(self, si: SurfaceInteraction, surface: Surface, values: Tensor, stream: Stream) -> Loss:
        """The prior (Eq. 10) with theta's gradient through both sides: two independent estimates of T."""
        fixed = surface if self.settings.prior_trains == "both" else surface.detach()
        half = max(1, self.sampling.samples_per_vertex // 2)
        lights = self.settings.prior_trains == "both"
        first = self.estimator.reflected(si, fixed, half, stream, field_gradient=True, light_gradient=lights)
        other = self.estimator.reflected(si, fixed, half, stream, field_gradient=True, light_gradient=lights)
        return full_gradient_prior(values, first.mean(1), other.mean(1), self.epsilon, si.valid)


def _attenuated(first: NonDeltaHit, values: Tensor) -> Tensor:
    """``values`` [b, n, 3] of first vertices, as delta surfaces before them let them pass to the camera."""
    return first.attenuate(values.view(-1, 3)).view_as(values)
