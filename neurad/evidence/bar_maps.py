"""Error bars of held-out views: their maps, and how well they fit the errors."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch

from neurad.core.parameters import RECOVERED
from neurad.core.records import FloatArray, SurfaceInteraction
from neurad.evidence.error_bars import BarFields, ErrorBars
from neurad.metrics.bar_scores import bar_scores
from neurad.metrics.held_out import HeldOut


def bars_at(
    bars: ErrorBars, materials: BarFields, si: SurfaceInteraction, emits: torch.Tensor
) -> dict[str, FloatArray]:
    """Standard deviations at the lanes of ``si``: ``albedo`` [n, 3] and, where there is one, ``roughness`` [n, 1]; 0 on
    triangles that emit, whose materials are known, and where there is no surface.
    """
    recovered = (si.valid & ~emits[si.prim.clamp_min(0)]).cpu().numpy()[:, None]
    return {
        name: np.where(recovered, values, np.float32(0.0)) for name, values in bars.at(materials, si.p, si.prim).items()
    }


def predict_bars(held_out: HeldOut, bars: ErrorBars, materials: BarFields) -> list[dict[str, FloatArray]]:
    """``albedo_std`` [h, w, 3] and, where there is one, ``roughness_std`` [h, w, 1] of every view, the root of the mean
    variance of a few points in each pixel; and ``albedo_bars`` and ``roughness_bars`` [h, w, 1], which are these over
    the spreads.
    """
    emits = (held_out.geometry.emission > 0).any(-1)
    maps = []
    for index in range(len(held_out.views)):
        size = held_out.size(index)
        parts: dict[str, list[FloatArray]] = {}
        for part, si in held_out.sub_samples(index, few=True):
            for name, std in bars_at(bars, materials, si, emits).items():
                variance = np.square(std).reshape(part.stop - part.start, -1, std.shape[-1]).mean(1)
                parts.setdefault(name, []).append(np.sqrt(variance))
        stds = {name: np.concatenate(values).reshape(*size, -1) for name, values in parts.items()}
        shares = bars.shares(stds)
        maps.append(
            {f"{name}_{kind}": value for kind, of in (("std", stds), ("bars", shares)) for name, value in of.items()}
        )
    return maps


def score_bars(held_out: HeldOut, maps: Sequence[Mapping[str, FloatArray]]) -> dict[str, float]:
    """:func:`bar_scores` over the counted pixels of all views, after ``albedo_`` and ``roughness_``; what has
    no bars or no truth is left out.
    """
    scores: dict[str, float] = {}
    for name in RECOVERED:
        parts = []
        for index, entry in enumerate(maps):
            truth = held_out.truth(index).get(f"{name}_true")
            if truth is not None and f"{name}_std" in entry:
                counted = held_out.counted(index)
                parts.append([values[counted] for values in (entry[name], entry[f"{name}_std"], truth)])
        if parts:
            found = bar_scores(*(np.concatenate(values).astype(np.float64) for values in zip(*parts, strict=True)))
            scores |= {f"{name}_{score}": value for score, value in found.items()}
    return scores
