"""Relative L2 with unbiased gradients.

The derivative of a squared Monte Carlo mean needs a second, independent estimate: ``d (I - GT)^2 = 2 (I' - GT) dI``
with ``I'`` independent of ``I``. Two forms of it stand here; both return a *surrogate*, whose gradient is the unbiased
one, together with an unbiased estimate of the loss itself for reports.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Loss:
    """A term of the objective."""

    surrogate: Tensor
    """Scalar whose gradient is used."""
    value: Tensor
    """Scalar estimate of the loss, without gradient, for reports."""


@dataclass(frozen=True)
class Control:
    """A control variate for samples of independent groups: ``deviation`` has mean zero whatever light there is."""

    incident: Tensor
    """Incident radiance that each sample found, without gradient [b, n, c]."""
    deviation: Tensor
    """Weight of each sample less the weight's mean, with the same gradient as the samples' [b, n, c]."""
    groups: int
    """Independent groups of as many samples each, at least 2; ``n`` of them where all samples are independent."""

    def guess(self) -> Tensor:
        """Incident radiance at each sample by the other groups of its pixel [b, n, c]."""
        light = grouped(self.incident, self.groups)
        others = (light.sum(1, keepdim=True) - light) / (self.groups - 1)
        return others.repeat_interleave(self.incident.shape[1] // self.groups, 1)

    def excess(self) -> Tensor:
        """What each sample has too much if the light of the others is all around [b, n, c]; its mean is zero."""
        return self.guess() * self.deviation

    def excess_of_others(self) -> Tensor:
        """Mean over all groups but i of their excess by the light of all others but i [b, groups, c], detached.

        Nothing of group i is in it, so a residual less it stays independent of group i. Zero for two groups.
        """
        n = self.groups
        light, z = grouped(self.incident, n), grouped(self.deviation.detach(), n)
        if n < 3:
            return torch.zeros_like(z)
        both = light * z
        light, z, both = (x.sum(1, keepdim=True) - x for x in (light, z, both))
        return (light * z - both) / ((n - 1) * (n - 2))


def grouped(samples: Tensor, groups: int) -> Tensor:
    """Means over groups of neighbouring samples: [b, n, c] -> [b, groups, c]."""
    count = samples.shape[1]
    return samples if count == groups else samples.reshape(len(samples), groups, count // groups, -1).mean(2)


def leave_one_out(
    samples: Tensor, target: Tensor, weight: Tensor, control: Control | None = None, groups: int | None = None
) -> Loss:
    """Relative L2 of a pixel mean from n >= 2 independent groups of samples, in one pass.

    With ``s_i`` the mean of a group, the gradient is ``(2/n) w sum_i (mean_{j != i} s_j - GT) ds_i``, averaged over
    pixels and channels.

    Args:
        samples: samples of every pixel, group by group [b, n * samples of a group, c].
        target: photographed value [b, c].
        weight: ``1 / (normaliser^2 + eps)``, independent of the samples [b, 1] or [b, c].
        control: takes noise from samples and residuals; the mean of the gradient stays the same.
        groups: how many; None where every sample is independent of all others.
    """
    n = samples.shape[1] if groups is None else groups
    fixed = grouped(samples.detach(), n)
    others = (fixed.sum(1, keepdim=True) - fixed) / (n - 1)
    if control is not None:
        others = others - control.excess_of_others()
        samples = samples - control.excess()
    samples = grouped(samples, n)
    fixed = samples.detach()
    residual = others - target.unsqueeze(1)
    scale = weight.unsqueeze(1)
    surrogate = (2.0 * scale * residual * samples).mean()
    value = (scale * residual * (fixed - target.unsqueeze(1))).mean()
    return Loss(surrogate, value)


def two_pass(samples: Tensor, independent: Tensor, target: Tensor, weight: Tensor) -> Loss:
    """Relative L2 of a pixel mean, its residual taken from a second rendering (the paper's way).

    Args:
        samples: samples that carry the gradient [b, n, c].
        independent: samples of another random stream, without gradient [b, m, c].
        target: photographed value [b, c].
        weight: as in :func:`leave_one_out`.
    """
    residual = independent.detach().mean(1) - target
    mean = samples.mean(1)
    surrogate = (2.0 * weight * residual * mean).mean()
    return Loss(surrogate, (weight * residual * (mean.detach() - target)).mean())


def relative_weight(normaliser: Tensor, epsilon: float) -> Tensor:
    """``1 / (sg(normaliser)^2 + epsilon)``; ``epsilon`` is in squared radiance units."""
    fixed = normaliser.detach()
    return 1.0 / (fixed * fixed + epsilon)


def semi_gradient_prior(field: Tensor, transported: Tensor, epsilon: float, mask: Tensor) -> Loss:
    """Radiometric prior (paper Eq. 10) with the right side detached: a fixed-point iteration.

    Args:
        field: ``L_theta`` at the vertices [n, 3].
        transported: ``T_hat(E + L_theta)`` there [n, 3].
        epsilon: as in :func:`relative_weight`; the normaliser is the field's own, noise-free prediction.
        mask: lanes that count [n], bool.
    """
    residual = (field - transported.detach()) * mask.unsqueeze(-1)
    loss = (relative_weight(field, epsilon) * residual * residual).mean()
    return Loss(loss, loss.detach())


def full_gradient_prior(field: Tensor, first: Tensor, second: Tensor, epsilon: float, mask: Tensor) -> Loss:
    """Radiometric prior with gradients through both sides, unbiased by two independent estimates of T.

    Args:
        field: ``L_theta`` at the vertices [n, 3].
        first: one estimate of ``T_hat(E + L_theta)``, differentiable in theta [n, 3].
        second: another, of an independent random stream [n, 3].
        epsilon: as in :func:`semi_gradient_prior`.
        mask: lanes that count [n], bool.
    """
    scale = relative_weight(field, epsilon) * mask.unsqueeze(-1)
    loss = (scale * (field - first) * (field - second)).mean()
    return Loss(loss, loss.detach())


def moving_prior(field: Tensor, transported: Tensor, other: Tensor, epsilon: float, mask: Tensor) -> Loss:
    """:func:`semi_gradient_prior` whose right side has a gradient too, that of the materials; unbiased by a second
    estimate of T.

    Args:
        field: ``L_theta`` at the vertices [n, 3].
        transported: ``T_hat(E + sg[L_theta])`` there, differentiable in the materials [n, 3].
        other: another estimate, of an independent random stream [n, 3].
        epsilon: as in :func:`semi_gradient_prior`.
        mask: lanes that count [n], bool.
    """
    left = semi_gradient_prior(field, transported, epsilon, mask)
    fixed = field.detach()
    scale = relative_weight(fixed, epsilon) * mask.unsqueeze(-1) * (fixed - other.detach())
    surrogate = left.surrogate - 2.0 * (scale * transported).mean()
    return Loss(surrogate, (scale * (fixed - transported.detach())).mean())


def smoothed(photographs: Tensor, alpha: Tensor | None, width: int) -> Tensor:
    """Means over 5 x 5 pixels, to weigh a pixel by: the noise of a pixel's own photograph would be in the residual too,
    and weights that follow it make everything darker.

    Args:
        photographs: linear colours, premultiplied by alpha [views, h * w, 3].
        alpha: coverage [views, h * w], or None.
        width: of the photographs in pixels.

    Returns:
        Premultiplied colours [views, h * w, 3]; with alpha the mean is over what is covered.
    """
    if alpha is not None:
        covered = alpha.unsqueeze(-1)
        mean = _blur(photographs, width) / _blur(covered, width).clamp_min(1e-6)
        return mean * covered
    return _blur(photographs, width)


def _blur(values: Tensor, width: int) -> Tensor:
    views, pixels, channels = values.shape
    image = values.view(views, pixels // width, width, channels).permute(0, 3, 1, 2)
    mean = torch.nn.functional.avg_pool2d(image, 5, 1, 2, count_include_pad=False)
    return mean.permute(0, 2, 3, 1).reshape(views, pixels, channels)


def total(losses: dict[str, tuple[float, Loss]]) -> Tensor:
    """The weighted sum of surrogates."""
    return torch.stack([weight * loss.surrogate for weight, loss in losses.values()]).sum()
