"""What pixels of the photographs say of the materials in them: residuals and derivatives, in independent halves."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.parameters import PARAMETERS, recovered
from neurad.core.protocols import PhotoSource
from neurad.core.records import BoolArray, FloatArray, IntArray, PixelBatch, Surface, SurfaceInteraction
from neurad.core.rng import Stream
from neurad.integrators.estimator import Estimator
from neurad.integrators.primary_hits import PrimaryHits
from neurad.losses.leave_one_out import ControlVariate
from neurad.runtime.threads import parallel_map

SPP = 8
"""Samples a pixel, both halves together: a pixel more says more than a sample more."""
GROUP = SPP // 2
"""Samples of a half."""
DARK = 0.01
"""Fraction of the mean squared radiance that is added to the squared brightness that pixels are weighted by."""
LIMIT = 1.0
"""Largest residual, and half of the largest derivative by roughness, in units of the brightness: fireflies are cut."""
_GROUPS = 2  # independent groups in a half, as its control variate needs
_LANES = 1 << 15  # samples in flight: bounds the memory
_STREAM, _GIVEN = 29, 31  # last number of the stream's key


@dataclass(frozen=True)
class PixelDerivatives:
    """Training pixels whose every sample met a surface [b]. Halves are independent of each other, so that a product of
    one with the other has no noise in its mean.
    """

    p: FloatArray
    """One of the surface points in each pixel [b, 3]."""
    area: FloatArray
    """Surface that the pixel covers, in squared scene units [b]."""
    odd: BoolArray
    """Whether the pixel belongs to the second half of the photographs' pixels [b]."""
    residual: FloatArray
    """Photograph less estimate, by half [2, b, 3]."""
    by: Mapping[str, FloatArray]
    """Derivatives of the estimate by half [2, b, 3], by the name of the surface parameter: by the same channel of the
    albedo, and by what has one channel; 0 of what the scene does not have.
    """
    misfit: FloatArray
    """Photograph less the radiance field's prediction, which has no noise; without a field less the estimate [b, 3]."""
    predicted: FloatArray
    """That prediction [b, 3]."""
    albedo: FloatArray
    """Recovered albedo, the mean over the pixel [b, 3]."""
    detail: FloatArray
    """Variance of the recovered albedo within the pixel [b, 3]."""
    points: FloatArray
    """Surface points of all samples [b, SPP, 3]."""
    prims: IntArray
    """Triangles that they lie on [b, SPP]."""

    def __len__(self) -> int:
        return len(self.p)

    @classmethod
    def join(cls, parts: list[Self]) -> Self | None:
        """Pixels of all parts; None where there are none."""
        if not sum(map(len, parts)):
            return None
        plain = [f.name for f in fields(cls) if f.name != "by"]
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts], int(name == "residual")) for name in plain
        }
        return cls(**arrays, by={name: np.concatenate([part.by[name] for part in parts], 1) for name in parts[0].by})


@dataclass(frozen=True)
class TrainingPixels:
    """Where estimates of training pixels come from, at the present materials."""

    estimator: Estimator
    """The method with the present materials and radiance field."""
    primary: PrimaryHits
    """Camera rays of the training views."""
    photographs: PhotoSource
    """Drawn from without replacement."""
    emitter_mask: Tensor
    """Pixels that an emitter covers [views, pixels], bool; they are left out."""
    seed: int
    """Seed of the samples."""
    mean_square_radiance: float
    """Mean square of the photographs."""
    develop: Callable[[PixelBatch], PixelBatch] | None = None
    """Corrects the photographs; None leaves them as they are."""

    def batches(self, first: int, pixels: int) -> Iterator[PixelBatch]:
        """About ``pixels`` of them, corrected, from the batch of iteration ``first`` on."""
        for batch in batches_without_replacement(self.photographs, self.emitter_mask, first, pixels):
            yield batch if self.develop is None else self.develop(batch)

    def of_batches(
        self, arrays: Callable[[int, PixelBatch], list[FloatArray]], first: int, pixels: int
    ) -> list[list[FloatArray]]:
        """What ``arrays`` makes of each batch and its number, in turn."""
        on_cpu = self.primary.origin.device.type == "cpu"  # a GPU is kept busy by one thread
        in_turn = enumerate(self.batches(first, pixels))
        return list((parallel_map if on_cpu else map)(lambda item: arrays(*item), in_turn))


def pixel_derivatives(source: TrainingPixels, first: int, pixels: int) -> PixelDerivatives | None:
    """Residuals and derivatives of about ``pixels`` training pixels at the present materials, from the batch of
    iteration ``first`` on; None if none is left.
    """
    parts = []
    for index, batch in enumerate(source.batches(first, pixels)):
        stream = Stream(source.seed, first, index, _STREAM, device=source.primary.origin.device)
        parts.append(_of_batch(source.estimator, source.primary, batch, stream))
    return PixelDerivatives.join(parts)


def derivatives_of(
    estimator: Estimator,
    primary: PrimaryHits,
    batch: PixelBatch,
    emitter_mask: Tensor,
    seed: int,
    iteration: int,
    groups: int,
) -> PixelDerivatives | None:
    """Derivatives of given pixels, those that ``emitter_mask`` covers left out, with so many groups of
    :data:`GROUP` samples in each half; None if none is left.
    """
    parts = []
    for index, part in enumerate(_split([_unmasked(batch, emitter_mask)])):
        stream = Stream(seed, iteration, index, _GIVEN, device=primary.origin.device)
        parts.append(_of_batch(estimator, primary, part, stream, groups))
    return PixelDerivatives.join(parts)


def _unmasked(batch: PixelBatch, emitter_mask: Tensor) -> PixelBatch:
    """The pixels of a batch that show surfaces and no emitter, on the mask's device."""
    view, pixel, color, alpha = (x.to(emitter_mask.device) for x in (batch.view, batch.pixel, batch.color, batch.alpha))
    kept = ~emitter_mask[view, pixel] & (alpha > 0)
    if batch.clipped is not None:  # no measurement
        kept &= ~batch.clipped.any(-1).to(kept.device)
    return PixelBatch(view[kept], pixel[kept], color[kept], alpha[kept], 0)


def _split(batches: list[PixelBatch]) -> Iterator[PixelBatch]:
    """Batches joined and cut so that they fit in memory."""
    names = "view", "pixel", "color", "alpha"
    joined = [torch.split(torch.cat([getattr(part, name) for part in batches]), _LANES // SPP) for name in names]
    for columns in zip(*joined, strict=True):
        if len(columns[0]):
            yield PixelBatch(columns[0], columns[1], columns[2], columns[3], 0)


def batches_without_replacement(
    photographs: PhotoSource, emitter_mask: Tensor, first: int, pixels: int
) -> Iterator[PixelBatch]:
    """Batches of the photographs from iteration ``first`` on, cut or joined to fit in memory, on the mask's device: so
    many pixels that count, or fewer where as many as there are in all have been drawn.
    """
    taken, drawn, iteration = 0, 0, first
    waiting: list[PixelBatch] = []
    while taken < pixels and drawn < emitter_mask.numel():
        batch = photographs.batch(iteration)
        iteration, take = iteration + 1, len(batch.view) - batch.candidates
        drawn += take
        kept = _unmasked(batch[torch.arange(take)], emitter_mask)
        kept = kept[torch.arange(min(len(kept.view), pixels - taken), device=kept.view.device)]
        taken += len(kept.view)
        waiting.append(kept)
        if taken < pixels and drawn < emitter_mask.numel() and sum(len(part.view) for part in waiting) < _LANES // SPP:
            continue
        yield from _split(waiting)
        waiting = []


@dataclass(frozen=True)
class SampleGroup:
    """The estimate of the pixels of a batch by a few samples in each."""

    image: Tensor
    """[b, 3]."""
    by: Mapping[str, Tensor]
    """Its derivatives by the surface parameters that are recovered [b, 3]."""
    field: Tensor | None
    """What the radiance field predicts [b, 3]; None without one, or where it was not asked."""
    albedo: Tensor
    """By sample [b, n, 3]."""
    p: Tensor
    """Surface points by sample [b, n, 3]."""
    prim: Tensor
    """Triangles by sample [b, n]."""
    cosine: Tensor
    """Cosine of the viewing direction, by sample [b, n]."""
    valid: Tensor
    """Whether all samples met a surface [b]."""


def _of_batch(
    estimator: Estimator, primary: PrimaryHits, batch: PixelBatch, stream: Stream, groups: int = 1
) -> PixelDerivatives:
    """Residuals and derivatives are means over the groups of each half, all else is of its first group."""
    parts = [
        [group_of_samples(estimator, primary, batch, stream, predict=index == 0) for index in range(groups)]
        for _ in range(2)
    ]
    halves = [part[0] for part in parts]

    def mean(of: Callable[[SampleGroup], Tensor]) -> Tensor:
        """[2, b, 3]."""
        return torch.stack([torch.stack([of(group) for group in part]).mean(0) for part in parts])

    image = mean(lambda group: group.image)
    lhs = [half.field for half in halves if half.field is not None]
    predicted = torch.stack(lhs).mean(0) if lhs else image.mean(0)  # [b, 3]
    albedo = torch.cat([half.albedo for half in halves], 1)  # [b, SPP, 3]
    p, cosine = halves[0].p[:, 0], halves[0].cosine[:, 0]
    distance = torch.linalg.vector_norm(p - primary.origin[batch.view], dim=-1)  # [b]
    corner = primary.views.corner(batch.view, batch.pixel)  # [b, 2]
    side = distance * primary.views.footprint(batch.view, corner + 0.5)
    kept = torch.stack([group.valid for part in parts for group in part]).all(0)
    # Neighbouring pixels alternate between the halves of the photographs.
    odd = (corner.sum(-1) + batch.view) % 2 == 1
    whole = {
        "p": p, "area": side * side / cosine.clamp_min(0.1), "odd": odd, "misfit": batch.color - predicted,
        "predicted": predicted, "albedo": albedo.mean(1), "detail": albedo.var(1),
        "points": torch.cat([half.p for half in halves], 1), "prims": torch.cat([half.prim for half in halves], 1),
    }  # fmt: skip
    derivatives = {name: mean(lambda group, name=name: group.by[name]) for name in halves[0].by}  # type: ignore[misc]
    arrays: dict[str, Any] = {name: values[kept].cpu().numpy() for name, values in whole.items()}
    return PixelDerivatives(
        **arrays, residual=(batch.color - image)[:, kept].cpu().numpy(),
        by={name: values[:, kept].cpu().numpy() for name, values in derivatives.items()},
    )  # fmt: skip


def group_of_samples(
    estimator: Estimator,
    primary: PrimaryHits,
    batch: PixelBatch,
    stream: Stream,
    predict: bool = True,
    n: int = GROUP,
) -> SampleGroup:
    """``n`` samples of every pixel, an even number, with the control variate where the method has one, and with what
    the radiance field predicts unless ``predict`` says no. Directions are stratified in each half of them.
    """
    b = len(batch.view)
    first = primary(batch, n, stream)
    si, world = first.si, estimator.world
    with torch.no_grad():
        found, emitted = estimator.materials(si), world.emitted(si)
        field = None
        if predict and estimator.radiance is not None:
            field = first.attenuate(emitted + si.where_hit(estimator.radiance(si, found.albedo))).view(b, n, 3).mean(1)
    leaves = {
        parameter.name: value.detach().clone().requires_grad_()
        for parameter in recovered(PARAMETERS)
        if (value := found.parameters.get(parameter.name)) is not None
    }
    surface = replace(found, **leaves)
    with torch.enable_grad():
        image = image_of(estimator, first.attenuate, si, surface, stream, n)
        by = _jacobian(image, leaves)
    return SampleGroup(
        (image.detach() + first.attenuate(emitted).view(b, n, 3)).mean(1), by, field,
        surface.albedo.detach().view(b, n, 3), si.p.view(b, n, 3), si.prim.view(b, n),
        (si.n * si.wo).sum(-1).abs().view(b, n),
        si.valid.view(b, n).all(1),
    )  # fmt: skip


def image_of(
    estimator: Estimator,
    attenuate: Callable[[Tensor], Tensor],
    si: SurfaceInteraction,
    surface: Surface,
    stream: Stream,
    n: int,
) -> Tensor:
    """Estimates of pixels by each of ``n`` samples [b, n, 3], with the control variate where the method has one.

    Args:
        attenuate: dims values [b n, 3] by what lies before the surfaces.
        si: where the samples' camera rays ended [b n].
        surface: BSDF parameters there; gradients flow into them where they are enabled.
        n: samples of a pixel, an even number.
    """
    sample = estimator.image(si, surface, 1, stream, n // _GROUPS)
    image = attenuate(sample.value).view(-1, n, 3)
    if sample.Li_bsdf is not None and sample.sample_stats is not None and estimator.method.control_variate:
        light = (sample.Li_bsdf * sample.sample_stats.relative).view(-1, n, 3)
        deviation = attenuate(sample.sample_stats.deviation).view(-1, n, 3)
        image = image - ControlVariate(light, deviation, _GROUPS).residual()
    return image


def _jacobian(image: Tensor, parameters: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Derivatives of pixels, the means of samples ``image`` [b, n, 3], by a change of each surface parameter of the
    whole pixel: of the albedo channel by channel, [b, 3] each.
    """
    b, n, channels = image.shape
    by = dict(zip(parameters, image.new_zeros(len(parameters), b, channels).unbind(), strict=True))
    if torch.is_inference_mode_enabled():
        raise RuntimeError("derivatives of pixels cannot be taken in torch's inference mode")
    if not image.requires_grad:  # nothing reflects
        return by
    for channel in range(channels):
        gradients = torch.autograd.grad(
            image[..., channel].sum(), tuple(parameters.values()), retain_graph=channel + 1 < channels,
            allow_unused=True,
        )  # fmt: skip
        for name, gradient in zip(parameters, gradients, strict=True):
            if gradient is not None:
                own = gradient[:, channel if gradient.shape[1] > 1 else 0]
                by[name][:, channel] = own.view(b, n).mean(1)
    return by
