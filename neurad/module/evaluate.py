"""Pictures and scores of held-out views with the present materials and radiance field."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from neurad.core.records import FloatArray
from neurad.integrators.film import render
from neurad.integrators.radiometric import RadiometricLHS, RadiometricRHS
from neurad.metrics.held_out import HeldOut
from neurad.metrics.lit_glossy import lit_glossy, reflected_by
from neurad.module.estimate import Estimator

SEED = 20230806
"""Of evaluation pictures: their noise is the same at every evaluation, so that curves show learning only."""

GLOSSY_SAMPLES = 2
"""Estimates for each sub-sample and training view that decide whether a pixel is lit and glossy."""


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found."""

    scores: dict[str, float]
    """Keys as in ``metrics.csv``."""
    maps: list[dict[str, FloatArray]]
    """For each held-out view: ``render``, ``residual``, ``albedo``, ``roughness`` and, where files exist,
    ``photograph``, ``albedo_true`` and ``roughness_true`` [h, w, 1 or 3]."""


@torch.no_grad()
def evaluate(held_out: HeldOut, estimator: Estimator, render_spp: int, glossy: bool = False) -> Evaluation:
    """Score albedo, roughness and the RHS rendering at ``render_spp`` samples a pixel.

    With ``glossy`` also over the lit glossy pixels, which takes a while to find: seconds to minutes.
    """
    parts = (estimator.world, estimator.materials, estimator.radiance)
    rhs, lhs = RadiometricRHS(*parts), RadiometricLHS(*parts)
    device = estimator.world.geometry.vertices.device
    maps = held_out.predict(estimator.materials)
    for index, (view, entry) in enumerate(zip(held_out.views, maps, strict=True)):
        right = render(view.camera, rhs, render_spp, SEED + index, device)
        left = render(view.camera, lhs, min(4, render_spp), SEED + index, device)
        entry["render"] = right.cpu().numpy()
        entry["residual"] = (left - right).abs().cpu().numpy()
        entry.update(held_out.truth(index))
    regions = {"lit_glossy": lit_glossy(held_out, reflected_by(*parts), GLOSSY_SAMPLES)} if glossy else None
    return Evaluation(held_out.score(maps, [entry["render"] for entry in maps], regions), maps)
