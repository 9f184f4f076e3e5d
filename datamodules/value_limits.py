"""What values of photographs cannot say: those at the ceiling how bright it was, those of codes what lies between."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import Float64Array, PixelBatch
from neurad.core.scene_records import View
from neurad.images.photographs import ceiling_of, read_spread, rounding
from neurad.runtime.progress import say
from neurad.runtime.reading import listed

_COARSE = 255
"""Largest code of formats whose rounding counts; that of 16 bits is lost in any photograph's noise."""
_BITS = (1, 2, 4)
_MIN_SAMPLES = 8
"""Pixels of a sample by which a photograph is judged."""


@dataclass(frozen=True)
class ValueLimits:
    """Ceilings and rounding of the training photographs."""

    ceiling: Tensor
    """Radiance from which on a view is clipped [views], infinite where it never is."""
    kind: Tensor
    """Which of the curves a view has [views], int64; -1 for none."""
    curves: tuple[tuple[Float64Array, Float64Array], ...]
    """Linear values of codes and the variance of their rounding, of each response."""
    gain: Tensor
    """Exposures [views]."""
    spread: Tensor | None = None
    """Standard deviation of each pixel [views, pixels], bfloat16, 0 where it is not given; None where it never is."""
    blown: Tensor | None = None
    """Which channels of each pixel every exposure of a bracket was clipped in [views, pixels], a bit each, uint8; None
    where none was."""

    @classmethod
    def of(cls, views: Sequence[View]) -> Self | None:
        """Those of some views; None where there are no limits at all."""
        ceiling = torch.tensor([ceiling_of(view) for view in views])
        coarse = [0 < view.development.levels <= _COARSE for view in views]
        spread, blown = _spreads(views)
        if not any(coarse) and bool(ceiling.isinf().all()) and spread is None:
            return None
        responses = list(dict.fromkeys(v.development.response for v, c in zip(views, coarse, strict=True) if c))
        kind = [responses.index(v.development.response) if c else -1 for v, c in zip(views, coarse, strict=True)]
        gain = torch.tensor([view.development.gain for view in views])
        return cls(
            ceiling, torch.tensor(kind), tuple(rounding(name, _COARSE) for name in responses), gain, spread, blown
        )

    def marked(self, batch: PixelBatch) -> PixelBatch:
        """A batch on the CPU, with ``clipped`` and ``variance`` of its pixels; ``clipped`` is None where nothing says
        from which value on photographs are.
        """
        alpha, clipped = batch.alpha.unsqueeze(-1), None
        if self.blown is not None or not bool(self.ceiling.isinf().all()):
            clipped = (batch.color >= self.ceiling[batch.view].unsqueeze(-1) * alpha) & (alpha > 0)
        if clipped is not None and self.blown is not None:
            bits = self.blown[batch.view, batch.pixel].unsqueeze(-1)
            clipped |= (bits & torch.tensor(_BITS, dtype=torch.uint8)) > 0
        if not self.curves and self.spread is None:
            return replace(batch, clipped=clipped)
        variance = torch.zeros_like(batch.color)
        kind, gain = self.kind[batch.view], self.gain[batch.view].unsqueeze(-1)
        for index, (values, squares) in enumerate(self.curves):
            mine = (kind == index).nonzero().squeeze(-1)
            linear = batch.color[mine] * gain[mine] / alpha[mine].clamp_min(1e-6)
            found = np.interp(linear.numpy(), values, squares).astype(np.float32)
            variance[mine] = torch.from_numpy(found) * (alpha[mine] / gain[mine]).square()
        if self.spread is not None:
            known = self.spread[batch.view, batch.pixel].float().square().unsqueeze(-1)
            variance = variance + (known if clipped is None else torch.where(clipped, 0.0, known))  # a bound has none
        return replace(batch, clipped=clipped, variance=variance)

    def check(self, sample: PixelBatch, views: Sequence[View], scene: str) -> None:
        """Name the photographs that are clipped everywhere.

        Args:
            sample: random pixels of all photographs, marked.

        Raises:
            InputError: all photographs are.
        """
        if sample.clipped is None:
            return
        free = ~sample.clipped.all(-1)
        if len(free) and not bool(free.any()):
            raise InputError(
                f"scene {scene}: every photograph is at its ceiling everywhere and says nothing; expose less, or set "
                "--data.ceiling"
            )
        count, kept = (torch.bincount(index, minlength=len(views)) for index in (sample.view, sample.view[free]))
        counts = zip(views, count.tolist(), kept.tolist(), strict=True)
        blown = [view.name for view, n, k in counts if n >= _MIN_SAMPLES and k == 0]
        if blown:
            say(f"warning: at their ceiling everywhere, so they say nothing: {listed(blown)}")


def _spreads(views: Sequence[View]) -> tuple[Tensor | None, Tensor | None]:
    """Standard deviations of all photographs [views, pixels] and what of them is clipped, a bit a channel; None where
    no view has a file of them, or nothing is.

    Raises:
        InputError: a file cannot be read or does not fit.
    """
    if not any(view.spread for view in views):
        return None, None
    most = max(view.camera.width * view.camera.height for view in views)
    found, blown = (torch.zeros(len(views), most, dtype=kind) for kind in (torch.bfloat16, torch.uint8))
    for index, view in enumerate(views):
        if view.spread is not None:
            spread, clipped = (torch.from_numpy(part).flatten(0, 1) for part in read_spread(view))
            found[index, : len(spread)] = spread.to(torch.bfloat16)
            blown[index, : len(spread)] = (clipped * torch.tensor(_BITS, dtype=torch.uint8)).sum(-1, dtype=torch.uint8)
    return found, blown if bool(blown.any()) else None
