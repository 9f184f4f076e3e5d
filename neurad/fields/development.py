"""How photographs were taken, where it is not known: a gain for each, perhaps for each colour, and a response curve."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor, nn

from neurad.core.records import FloatArray, PixelBatch
from neurad.core.scene_records import View
from neurad.images.development import Photography
from neurad.images.response import FIT

DEGREES = 5
"""Degrees of the polynomial that bends the response curve, besides its logarithm."""
NEAR_CEILING = 0.65
"""Share of the ceiling from which on the response curve is not fitted: what noise lifts above the ceiling is missing
there, and the rest is too dark on average. With the kitchen's noise of 7 % a fit that begins at the true curve ends 3 %
too bright with a share of 0.9, and within 0.3 % with this one."""
_TOE = 0.02
"""Code at which that logarithm levels off."""
_STEPS = 256
"""Intervals of the curve's table."""
_MIN_SRGB = 1e-3
"""Part of sRGB's curve in every other, so that all rise by more than rounding."""


class FittedDevelopment(nn.Module):
    """Corrects photographs from what is taken as known of them to what is recovered.

    ``gain = exp(v - mean of v over the views)`` with trainable ``v`` per view, or per view and colour, so the mean of
    their logarithms stays 0: the common factor of photographs and lights is not looked for. With a known exposure the
    colours of a view have the mean 0, too.

    The response curve is ``f(t) = integral of s(t) exp(a(t))`` over codes up to ``t``, over the same up to 1, with
    ``s`` the slope of sRGB's decoding and ``a`` a sum of a logarithm and Legendre polynomials with trainable weights:
    it rises everywhere, whatever the weights, and they begin at 0, sRGB's curve.
    """

    values: nn.Parameter | None
    bend: nn.Parameter | None
    exposure: Tensor
    coded: Tensor
    ceiling: Tensor
    basis: Tensor
    slope: Tensor

    def __init__(self, views: Sequence[View], photography: Photography) -> None:
        super().__init__()
        self.fits_exposure = photography.exposure == "fit"
        colours = 3 if photography.white_balance == "fit" else 1
        self.values = nn.Parameter(torch.zeros(len(views), colours)) if photography.fits_gains else None
        self.bend = nn.Parameter(torch.zeros(DEGREES + 1)) if photography.response == FIT else None
        exposure = torch.tensor([view.development.gain for view in views])
        self.register_buffer("exposure", exposure, persistent=False)
        coded = torch.tensor([view.development.levels > 0 for view in views], dtype=torch.bool)
        self.register_buffer("coded", coded, persistent=False)
        ceiling = torch.tensor([1.0 if (code := view.development.ceiling) is None else code for view in views])
        self.register_buffer("ceiling", ceiling, persistent=False)
        middle = (torch.arange(_STEPS) + 0.5) / _STEPS
        self.register_buffer("basis", _basis(middle), persistent=False)
        edge = _decoded(torch.arange(_STEPS + 1) / _STEPS)
        self.register_buffer("slope", edge.diff(), persistent=False)

    @classmethod
    def of(cls, views: Sequence[View], photography: Photography) -> FittedDevelopment | None:
        """What is to be recovered; None where all is known."""
        if not views or not (photography.fits_gains or photography.response == FIT):
            return None
        return cls(views, photography)

    def gains(self) -> Tensor:
        """What each view's photograph is brighter by than its known exposure says [views, 3]."""
        if self.values is None:
            return torch.ones(len(self.exposure), 3, device=self.exposure.device)
        log = self.values - self.values.mean(0)
        if not self.fits_exposure:
            log = log - log.mean(1, keepdim=True)
        return log.exp().expand(-1, 3)

    @torch.no_grad()
    def begin(self, log: Tensor) -> None:
        """Let the gains begin at the exponentials of ``log`` [views, 3]."""
        if self.values is not None:
            self.values.copy_(log if self.values.shape[1] == 3 else log.mean(1, keepdim=True))

    def curve(self) -> Tensor:
        """Linear values at equidistant codes from 0 to 1 [steps + 1]; rises from 0 to 1."""
        rise = self.slope
        if self.bend is not None:
            bent = rise * (self.basis @ self.bend).exp()
            rise = torch.lerp(bent / bent.sum(), rise, _MIN_SRGB)
        return torch.cat((rise.new_zeros(1), rise.cumsum(0)))

    def respond(self, linear: Tensor) -> Tensor:
        """Values by the present curve of those by sRGB's, both in [0, 1]."""
        if self.bend is None:
            return linear
        place = _encoded(linear.clamp(0.0, 1.0)) * _STEPS
        low = place.long().clamp_max(_STEPS - 1)
        table = self.curve()
        return torch.lerp(table[low], table[low + 1], place - low)

    def _stretch(self, batch: PixelBatch) -> Tensor:
        """How many times as far apart as by sRGB's curve values lie by the present one around a batch's [b, 3]."""
        if self.bend is None:
            return torch.ones_like(batch.color)
        linear = (batch.color * self._scale(batch)).clamp(0.0, 1.0)
        low = (_encoded(linear) * _STEPS).long().clamp_max(_STEPS - 1)
        return torch.where(self._coded(batch), (self.curve().diff() / self.slope)[low], 1.0)

    def colors(self, batch: PixelBatch, radiance: Tensor | None = None) -> Tensor:
        """Radiance of a batch's pixels as it is recovered, with its gradient [b, 3].

        Args:
            batch: photographed pixels.
            radiance: what they are predicted to show [b, 3]. The gradient is then that of photographs of just this:
                where it is taken at the photographed values themselves, their noise is in both factors of
                the gradient of a squared residual, and darker photographs always fit better.
        """
        if radiance is not None:
            shown = self.colors(replace(batch, color=self._photographed(radiance, batch)))
            return self.colors(batch).detach() + shown - shown.detach()
        color = batch.color
        if self.bend is not None:
            scale = self._scale(batch)
            color = torch.where(self._coded(batch), self.respond(color * scale) / scale, color)
        return color / self.gains()[batch.view]

    @torch.no_grad()
    def below_ceiling(self, batch: PixelBatch, radiance: Tensor) -> Tensor:
        """Whether pixels that show this radiance [b, 3] are too far below the ceiling for noise to clip them [b, 3]."""
        ceiling = self.respond(_decoded(self.ceiling))[batch.view].unsqueeze(-1)
        shown = radiance * self.gains()[batch.view] * self._scale(batch)
        return (shown < NEAR_CEILING * ceiling) | ~self._coded(batch)

    @torch.no_grad()
    def _photographed(self, radiance: Tensor, batch: PixelBatch) -> Tensor:
        """The inverse of :meth:`colors`: values of photographs that show this radiance [b, 3]."""
        color = radiance * self.gains()[batch.view]
        if self.bend is None:
            return color
        table, scale = self.curve(), self._scale(batch)
        linear = (color * scale).clamp(0.0, 1.0)
        high = torch.searchsorted(table, linear).clamp(1, _STEPS)
        low = high - 1
        place = low + (linear - table[low]) / (table[high] - table[low])
        return torch.where(self._coded(batch), _decoded(place / _STEPS) / scale, color)

    def _scale(self, batch: PixelBatch) -> Tensor:
        """From radiance to shares of the ceiling [b, 1]."""
        return (self.exposure[batch.view] / batch.alpha.clamp_min(1e-6)).unsqueeze(-1)

    def _coded(self, batch: PixelBatch) -> Tensor:
        """Whether photographs are of codes [b, 1]."""
        return self.coded[batch.view].unsqueeze(-1)

    @torch.no_grad()
    def forward(self, batch: PixelBatch) -> PixelBatch:
        """A batch whose photographs are developed with what is recovered so far, without gradient."""
        batch = batch.to(self.exposure.device)
        blurred, variance = batch.blurred, batch.variance
        if blurred is not None:
            blurred = self.colors(replace(batch, color=blurred))
        if variance is not None:
            variance = variance * (self._stretch(batch) / self.gains()[batch.view]).square()
        return replace(batch, color=self.colors(batch), blurred=blurred, variance=variance)

    @torch.no_grad()
    def exposures(self) -> FloatArray:
        """Exposures as they are recovered, a colour each [views, 3]."""
        found: FloatArray = (self.exposure.unsqueeze(1) * self.gains()).cpu().numpy()
        return found


def _encoded(linear: Tensor) -> Tensor:
    """The sRGB code of linear values in [0, 1]."""
    return torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-9) ** (1 / 2.4) - 0.055)


def _decoded(code: Tensor) -> Tensor:
    """The linear value of sRGB codes in [0, 1]."""
    return torch.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def _basis(code: Tensor) -> Tensor:
    """What the logarithm of the curve's slope is a sum of, at codes in [0, 1] [n, DEGREES + 1]."""
    x = 2.0 * code - 1.0
    parts = [torch.ones_like(x), x]
    for k in range(1, DEGREES):
        parts.append(((2 * k + 1) * x * parts[k] - k * parts[k - 1]) / (k + 1))
    return torch.stack([(code + _TOE).log(), *parts[1 : DEGREES + 1]], -1)
