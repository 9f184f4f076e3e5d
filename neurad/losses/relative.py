"""Relative L2 with unbiased gradients.

The derivative of a squared Monte Carlo mean needs a second, independent estimate: ``d (I - GT)^2 = 2 (I' - GT) dI``
with ``I'`` independent of ``I``. One form of it stands here, the other in :mod:`neurad.losses.leave_one_out`; both
return a *surrogate*, whose gradient is the unbiased one, together with an unbiased estimate of the loss itself for
reports.
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

    @classmethod
    def of_gradient(cls, x: Tensor, gradient: Tensor, value: Tensor) -> Loss:
        """A loss whose ``gradient`` by ``x`` is known: autograd sees one product."""
        return cls((x * gradient.detach()).sum(), value.detach())


def weighted(residual: Tensor, weight: Tensor, chroma: float = 1.0) -> Tensor:
    """``W r``: half of the gradient of ``r^T W r`` by a residual ``r`` [..., c].

    In units of the normaliser what channels share, their mean, counts once and what they differ by ``chroma`` times:

        W = w^(1/2) (chroma I - (chroma - 1) 1 1^T / c) w^(1/2).

    Noise of path-traced light is much the same in all channels and what is wrong with a colour or a sheen is not, so
    that differences tell more (generalised least squares, whose W is the inverse of the noise's covariance).

    Args:
        weight: ``1 / (normaliser^2 + eps)`` [..., 1] or [..., c].
        chroma: above 0; 1 for channels of their own.
    """
    if chroma == 1.0:
        return weight * residual
    root = weight.sqrt()
    relative = root * residual
    return root * (chroma * relative - (chroma - 1.0) * relative.mean(-1, keepdim=True))


def two_pass(
    samples: Tensor,
    independent: Tensor,
    target: Tensor,
    weight: Tensor,
    censored: Tensor | None = None,
    chroma: float = 1.0,
) -> Loss:
    """Relative L2 of a pixel mean, its residual taken from a second rendering (the paper's way).

    Args:
        samples: samples that carry the gradient [b, n, c].
        independent: samples of another random stream, without gradient [b, m, c].
        target: photographed value [b, c].
        censored: where the target is a lower bound only, see :mod:`neurad.losses.leave_one_out` [b, c], bool.
    """
    residual = independent.detach().mean(1) - target
    if censored is not None:
        residual = torch.where(censored, residual.clamp_max(0.0), residual)
    mean = samples.mean(1)
    scaled = weighted(residual, weight, chroma)
    return Loss((2.0 * scaled * mean).mean(), (scaled * (mean.detach() - target)).mean())


NOISE = 0.05
"""Relative noise that photographs are taken to have where their rounding is weighed against it."""


def relative_weight(normaliser: Tensor, epsilon: float, variance: Tensor | None = None) -> Tensor:
    """``1 / (sg(normaliser)^2 + epsilon + variance / NOISE^2)``.

    The inverse of a variance of which ``NOISE`` is the relative part: a target that is known less well than that by
    itself counts as much less.

    Args:
        normaliser: what errors are relative to.
        epsilon: in squared radiance units.
        variance: of the target, in squared radiance units; None for none.
    """
    fixed = normaliser.detach()
    if variance is None:
        return 1.0 / (fixed * fixed + epsilon)
    return 1.0 / (fixed * fixed + epsilon + variance / NOISE**2)


def semi_gradient_prior(field: Tensor, transported: Tensor, epsilon: float, mask: Tensor) -> Loss:
    """Radiometric prior (paper Eq. 3, 10) with the right side detached: a fixed-point iteration.

    Args:
        field: ``L_theta`` at the vertices [n, 3].
        transported: ``T_hat(E + L_theta)`` there [n, 3].
        epsilon: as in :func:`relative_weight`; the normaliser is the field's own, noise-free prediction.
        mask: lanes that count [n], bool.
    """
    fixed = field.detach()
    residual = (fixed - transported.detach()) * mask.unsqueeze(-1)
    scaled = relative_weight(fixed, epsilon) * residual
    return Loss.of_gradient(field, scaled * (2.0 / max(field.numel(), 1)), (scaled * residual).mean())


def full_gradient_prior(field: Tensor, first: Tensor, second: Tensor, epsilon: float, mask: Tensor) -> Loss:
    """Radiometric prior (paper Eq. 4, 10), gradients through both sides: unbiased by two independent estimates of T.

    Args:
        field: ``L_theta`` at the vertices [n, 3].
        first: one estimate of ``T_hat(E + L_theta)``, differentiable in theta [n, 3].
        second: another, of an independent random stream [n, 3].
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
    """
    left = semi_gradient_prior(field, transported, epsilon, mask)
    fixed = field.detach()
    scale = relative_weight(fixed, epsilon) * mask.unsqueeze(-1) * (fixed - other.detach())
    surrogate = left.surrogate - 2.0 * (scale * transported).mean()
    return Loss(surrogate, (scale * (fixed - transported.detach())).mean())


def total(losses: dict[str, tuple[float, Loss]]) -> Tensor:
    """The weighted sum of surrogates."""
    return torch.stack([weight * loss.surrogate for weight, loss in losses.values()]).sum()
