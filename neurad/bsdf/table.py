"""Which implementation a description of a reflection model has, and the table of those that one scene needs."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from neurad.bsdf.diffuse import Diffuse
from neurad.bsdf.principled import Principled
from neurad.bsdf.roughconductor import RoughConductor
from neurad.bsdf.roughplastic import RoughPlastic
from neurad.core.protocols import BSDF, LobeKernels
from neurad.core.records import BSDFSample, Surface
from neurad.core.reflection import (
    DiffuseModel,
    PrincipledModel,
    ReflectionModel,
    RoughConductorModel,
    RoughPlasticModel,
)
from neurad.scene.description import Features

IMPLEMENTATIONS: dict[type[ReflectionModel], Callable[[Any, float], BSDF]] = {
    DiffuseModel: lambda model, specular_fraction: Diffuse(),
    PrincipledModel: lambda model, specular_fraction: Principled(
        model.eta, specular_fraction=specular_fraction, lambert=float(model.diffuse == "lambert")
    ),
    RoughConductorModel: lambda model, specular_fraction: RoughConductor(model),
    RoughPlasticModel: RoughPlastic,
}
"""What evaluates a description: called with it and with the probability of the specular lobe."""


class BSDFTable(BSDF):
    """Several reflection models: each lane is evaluated by its own, ``Surface.model``.

    Args:
        models: by index; None where a model has no implementation, which no lane may have then.
        fitted: model of lanes without an index, such as fitted materials give. They cost no more than without a table.
    """

    is_diffuse = False

    def __init__(self, models: list[BSDF | None], fitted: BSDF) -> None:
        self.models = models
        self.fitted = fitted
        self.varying_weight = any(bsdf.varying_weight for bsdf in (*models, fitted) if bsdf is not None)

    def kernels(self, surface: Surface) -> LobeKernels | None:
        """Those of the fitted model, for lanes without an index."""
        return self.fitted.kernels(surface) if surface.model is None else None

    def eval_pdf(self, surface: Surface, wo: Tensor, wi: Tensor) -> tuple[Tensor, Tensor]:
        """Value [n, 3] and density [n] by the model of each lane."""
        value, pdf = self._gather(lambda bsdf, *lanes: bsdf.eval_pdf(*lanes), surface, wo, wi)
        return value, pdf

    def sample(self, surface: Surface, wo: Tensor, u: Tensor) -> BSDFSample:
        """Directions drawn by the model of each lane."""

        def draw(bsdf: BSDF, *lanes: Any) -> tuple[Tensor, ...]:
            sample = bsdf.sample(*lanes)
            return sample.wi, sample.pdf, sample.weight

        return BSDFSample(*self._gather(draw, surface, wo, u))

    def diffuse_fraction(self, surface: Surface, wo: Tensor) -> float | Tensor:
        """Probability [n] that the model of each lane draws by the cosine."""
        if surface.model is None:
            return self.fitted.diffuse_fraction(surface, wo)

        def expanded(bsdf: BSDF, *lanes: Any) -> tuple[Tensor, ...]:
            return (
                torch.as_tensor(bsdf.diffuse_fraction(*lanes), dtype=wo.dtype, device=wo.device).expand(len(lanes[1])),
            )

        return self._gather(expanded, surface, wo)[0]

    def mean_weight(self, surface: Surface, wo: Tensor) -> Tensor:
        """Directional albedo [n, 3] by the model of each lane."""
        return self._gather(lambda bsdf, *lanes: (bsdf.mean_weight(*lanes),), surface, wo)[0]

    def _gather(
        self, function: Callable[..., tuple[Tensor, ...]], surface: Surface, *directions: Tensor
    ) -> tuple[Tensor, ...]:
        """Results of ``function(bsdf, surface, *directions)`` of every model on its own lanes, each [n, ...]."""
        if surface.model is None:
            return function(self.fitted, surface, *directions)
        results: tuple[Tensor, ...] | None = None
        for index, bsdf in enumerate(self.models):
            lanes = (surface.model == index).nonzero().squeeze(-1)
            if bsdf is None or len(lanes) == 0:
                continue
            if len(lanes) == len(surface):
                return function(bsdf, surface, *directions)
            parts = function(bsdf, surface[lanes], *(x.index_select(0, lanes) for x in directions))
            if results is None:
                results = tuple(part.new_zeros(len(surface), *part.shape[1:]) for part in parts)
            results = tuple(whole.index_copy(0, lanes, part) for whole, part in zip(results, parts, strict=True))
        if results is None:  # smooth surfaces alone, which have no model here
            return tuple(torch.zeros_like(x) for x in function(self.fitted, surface, *directions))
        return results


def make_bsdf(features: Features, specular_fraction: float = 0.5) -> BSDF:
    """The least reflection model for what a scene has: a table only where its own materials need several.

    ``specular_fraction`` is the probability that a sample is drawn from the specular lobe.
    """
    fitted = _implementation(features.fitted_model, specular_fraction)
    assert fitted is not None
    if not features.is_mixed:
        return fitted
    return BSDFTable([_implementation(model, specular_fraction) for model in features.models], fitted)


def _implementation(model: ReflectionModel, specular_fraction: float) -> BSDF | None:
    """None of a model that a scene is refused for."""
    make = IMPLEMENTATIONS.get(type(model))
    if make is None and model.unsupported is None:
        raise NotImplementedError(f"{type(model).__name__} has no line in IMPLEMENTATIONS of the BSDF table")
    return None if make is None else make(model, specular_fraction)
