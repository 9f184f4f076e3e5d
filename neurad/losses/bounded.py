"""Fireflies: a bound on how far one value can pull."""

from __future__ import annotations

from torch import Tensor


def bounded(value: Tensor, center: Tensor, epsilon: float, spike: float) -> Tensor:
    """``value`` where it is at most ``center + spike * sqrt(center^2 + epsilon)``, and that bound elsewhere.

    The gradient of a value beyond the bound is 0. What is cut off is lost, so the mean of what passes is too small by
    ``E[(value - bound)+]``: nothing where samples stay within ``spike`` times the prediction, all of the energy of a
    firefly where they do not. With ``spike`` 0 every value passes.

    Args:
        value: samples or photographed values [..., c].
        center: what is predicted there, taken without its gradient, of a shape that broadcasts to ``value``.
        epsilon: floor of the relative losses in squared radiance units.
        spike: largest excess in units of the prediction.
    """
    if spike <= 0:
        return value
    fixed = center.detach()
    bound = fixed + spike * (fixed * fixed + epsilon).sqrt()
    return value.minimum(bound)


def typical_square(values: Tensor, spike: float) -> float:
    """Mean square of photographed values [n, c] of which none counts more than ``spike`` times the 99th percentile."""
    flat = values.double().flatten()
    bound = spike * float(flat.kthvalue(max(1, round(0.99 * len(flat)))).values)
    return float(flat.clamp(max=bound).square().mean())
