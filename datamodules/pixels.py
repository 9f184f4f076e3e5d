"""Means around pixels."""

import torch
from torch import Tensor

_WINDOW = 5
"""Side in pixels of the square that :func:`blurred` averages over."""


def blurred(photographs: Tensor, alpha: Tensor | None, width: int) -> Tensor:
    """Means over the 5 x 5 pixels around each pixel, as far as they lie in the photograph: normalisers of residuals.

    The residual of a pixel has the noise of the pixel's own photograph in it. A weight with the same noise would
    correlate with the residual and bias the result towards dark; the mean has little of it.

    Args:
        photographs: linear colours, premultiplied by alpha [views, h * w, 3].
        alpha: coverage [views, h * w], or None.
        width: of the photographs in pixels.

    Returns:
        Premultiplied colours [views, h * w, 3]; with alpha the mean is over what is covered.
    """
    if alpha is None:
        return _box_filtered(photographs, width)
    coverage = alpha.unsqueeze(-1)
    mean = _box_filtered(photographs, width) / _box_filtered(coverage, width).clamp_min(1e-6)
    return mean * coverage


def _box_filtered(values: Tensor, width: int) -> Tensor:
    """Means over 5 x 5 pixels, at the border over those inside [views, h * w, c]."""
    views, pixels, channels = values.shape
    image = values.view(views, pixels // width, width, channels).permute(0, 3, 1, 2)
    mean = torch.nn.functional.avg_pool2d(image, _WINDOW, 1, _WINDOW // 2, count_include_pad=False)
    return mean.permute(0, 2, 3, 1).reshape(views, pixels, channels)
