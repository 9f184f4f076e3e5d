"""Fireflies: a bound on how far one value can pull."""

from __future__ import annotations

from torch import Tensor


def clamp_fireflies(value: Tensor, center: Tensor, epsilon: float, firefly_clamp: float) -> Tensor:
    """``value`` where it is at most ``center + firefly_clamp * sqrt(center^2 + epsilon)``, and that bound elsewhere.

    The gradient of a value beyond the bound is 0. What is cut off is lost, so the mean of what passes is too small by
    ``E[(value - bound)+]``: nothing where samples stay within ``firefly_clamp`` times the prediction, all of the energy
    of a firefly where they do not. With ``firefly_clamp`` 0 every value passes.

    Args:
        value: samples or photographed values [..., c].
        center: what is predicted there, taken without its gradient, of a shape that broadcasts to ``value``.
        epsilon: floor of the relative losses in squared radiance units.
        firefly_clamp: largest difference in units of the prediction.
    """
    if firefly_clamp <= 0:
        return value
    fixed = center.detach()
    bound = fixed + firefly_clamp * (fixed * fixed + epsilon).sqrt()
    return value.minimum(bound)


def typical_square(values: Tensor, firefly_clamp: float) -> float:
    """Mean square of photographed values [n, c], each clamped to ``firefly_clamp`` times the 99th percentile."""
    flat = values.double().flatten()
    bound = firefly_clamp * float(flat.kthvalue(max(1, round(0.99 * len(flat)))).values)
    return float(flat.clamp(max=bound).square().mean())
