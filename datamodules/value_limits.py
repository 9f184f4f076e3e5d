"""What values of photographs cannot say: those at the ceiling how bright it was, those of codes what lies between."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from torch import Tensor

from neurad.core.errors import InputError
from neurad.core.records import FloatArray, PixelBatch, View
from neurad.scene.photographs import ceiling_of, rounding

_COARSE = 255
"""Largest code of formats whose rounding counts; that of 16 bits is lost in any photograph's noise."""
_FEW = 8
"""Pixels of a sample by which a photograph is judged."""


@dataclass(frozen=True)
class ValueLimits:
    """Ceilings and rounding of the training photographs."""

    ceiling: Tensor
    """Radiance from which on a view is clipped [views], infinite where it never is."""
    kind: Tensor
    """Which of the curves a view has [views], int64; -1 for none."""
    curves: tuple[tuple[FloatArray, FloatArray], ...]
    """Linear values of codes and the variance of their rounding, of each response."""
    gain: Tensor
    """Exposures [views]."""

    @classmethod
    def of(cls, views: Sequence[View]) -> Self | None:
        """Those of some views; None where there are no limits at all."""
        ceiling = torch.tensor([ceiling_of(view) for view in views])
        coarse = [0 < view.development.levels <= _COARSE for view in views]
        if not any(coarse) and bool(ceiling.isinf().all()):
            return None
        responses = list(dict.fromkeys(v.development.response for v, c in zip(views, coarse, strict=True) if c))
        kind = [responses.index(v.development.response) if c else -1 for v, c in zip(views, coarse, strict=True)]
        gain = torch.tensor([view.development.gain for view in views])
        return cls(ceiling, torch.tensor(kind), tuple(rounding(name, _COARSE) for name in responses), gain)

    def marked(self, batch: PixelBatch) -> PixelBatch:
        """A batch on the CPU, with ``clipped`` and ``variance`` of its pixels."""
        alpha = batch.alpha.unsqueeze(-1)
        clipped = (batch.color >= self.ceiling[batch.view].unsqueeze(-1) * alpha) & (alpha > 0)
        if not self.curves:
            return replace(batch, clipped=clipped)
        variance = torch.zeros_like(batch.color)
        kind, gain = self.kind[batch.view], self.gain[batch.view].unsqueeze(-1)
        for index, (values, squares) in enumerate(self.curves):
            mine = (kind == index).nonzero().squeeze(-1)
            linear = batch.color[mine] * gain[mine] / alpha[mine].clamp_min(1e-6)
            found = np.interp(linear.numpy(), values, squares).astype(np.float32)
            variance[mine] = torch.from_numpy(found) * (alpha[mine] / gain[mine]).square()
        return replace(batch, clipped=clipped, variance=variance)

    def check(self, sample: PixelBatch, views: Sequence[View], scene: str) -> None:
        """Name the photographs that are clipped everywhere.

        Args:
            sample: random pixels of all photographs, marked.
            views: the training views.
            scene: name for the sentence.

        Raises:
            InputError: all photographs are.
        """
        assert sample.clipped is not None
        free = ~sample.clipped.all(-1)
        if len(free) and not bool(free.any()):
            raise InputError(
                f"scene {scene}: every photograph is at its ceiling everywhere and says nothing; expose less, or set "
                "--data.ceiling"
            )
        count, kept = (torch.bincount(index, minlength=len(views)) for index in (sample.view, sample.view[free]))
        blown = [view.name for view, n, k in zip(views, count, kept, strict=True) if int(n) >= _FEW and int(k) == 0]
        if blown:
            named = ", ".join(blown[:8]) + (" ..." if len(blown) > 8 else "")
            print(f"neurad: warning: at their ceiling everywhere, so they say nothing: {named}", file=sys.stderr)
