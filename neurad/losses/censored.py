"""Photographs at their ceiling: the target is a lower bound, and only a render below it is wrong."""

from torch import Tensor

from neurad.losses.leave_one_out import ControlVariate, grouped, leave_one_out, with_gradient
from neurad.losses.relative import Loss
from neurad.runtime.dispatch import use_warp


def leave_one_out_censored(
    samples: Tensor,
    target: Tensor,
    weight: Tensor,
    censored: Tensor | None,
    control: ControlVariate | None = None,
    groups: int | None = None,
    chroma: float = 1.0,
) -> Loss:
    """:func:`leave_one_out`, one-sided where the photograph is clipped.

    There the residual that multiplies the derivative of a group is ``min(mean of the others - target, 0)``, still
    independent of that group. Its mean lies below the minimum of the means, so noise of the size of the distance to the
    ceiling draws a render up; where a prediction without noise lies above the ceiling, the caller sets the weight to 0.

    Args:
        censored: where the target is a lower bound [b, c], bool, and counts by channel; None for nowhere. All others
            are those of :func:`leave_one_out`.
    """
    if censored is None:
        return leave_one_out(samples, target, weight, control, groups, chroma=chroma)
    n = samples.shape[1] if groups is None else groups
    if use_warp(samples.shape[2] == 3, samples):
        return with_gradient(samples, target, weight, censored, control, n, chroma)
    exact = leave_one_out(samples, target, weight * ~censored, control, groups, chroma=chroma)
    rows = censored.any(-1).nonzero().squeeze(-1)
    if len(rows) == 0:
        return exact
    picked = samples[rows]
    fixed = grouped(picked.detach(), n)  # [r, groups, c]
    others = (fixed.sum(1, keepdim=True) - fixed) / (n - 1)
    if control is not None:
        mine = ControlVariate(control.Li[rows], control.deviation[rows], n)
        others = others - mine.residual_of_others()
        picked = picked - mine.residual()
    own, bound = grouped(picked, n), target[rows].unsqueeze(1)
    residual = (weight * censored)[rows].unsqueeze(1) * (others - bound).clamp_max(0.0)
    terms = len(samples) * n * samples.shape[2]
    surrogate = (2.0 * residual * own).sum() / terms
    value = (residual * (own.detach() - bound)).sum() / terms
    return Loss(exact.surrogate + surrogate, exact.value + value)
