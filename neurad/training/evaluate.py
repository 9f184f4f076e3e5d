"""Pictures and scores of held-out views with the present materials and radiance field."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from neurad.assembly.fitted_materials import FittedMaterials
from neurad.assembly.lighting import recovered_lamps, relit_world
from neurad.core.protocols import Materials
from neurad.core.records import FloatArray
from neurad.core.scene_records import View
from neurad.emitters.fitted import FittedEnvironment
from neurad.evidence.bar_maps import predict_bars, score_bars
from neurad.evidence.error_bars import ErrorBars
from neurad.integrators.estimator import Estimator
from neurad.integrators.film import box_mean, render
from neurad.integrators.renderer import FieldRenderer, MethodRenderer, path_tracer
from neurad.integrators.world import World
from neurad.metrics.environment import EnvironmentScores
from neurad.metrics.held_out import HeldOut
from neurad.metrics.held_out_scores import albedo_factors, relight_map, score, score_relit
from neurad.metrics.limits import albedo_at_limits, roughness_spread
from neurad.metrics.lit_glossy import lit_glossy
from neurad.metrics.unseen import seen_map
from neurad.runtime.progress import counted
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

SEED = 20230806
"""Seed of evaluation pictures: their noise is alike at every evaluation, so that curves show learning only."""

FIELD_SPP = 16
"""Largest number of positions in a pixel at which the radiance field's own picture is taken: it has no other noise."""
STEADY = 9
"""Side in pixels of what differences of both sides are averaged over: 17 gained next to nothing more."""


@dataclass(frozen=True)
class Evaluation:
    """What an evaluation found."""

    scores: dict[str, float]
    """Keys as in ``metrics.csv``."""
    maps: list[dict[str, FloatArray]]
    """For each held-out view: ``render``; ``seen``, which surfaces training photographs show, see
    :func:`neurad.metrics.unseen.seen_map`; of materials that are fitted ``albedo`` and ``roughness``; with a radiance
    field ``residual``; with error bars ``albedo_std`` and ``roughness_std``; where there are files, ``photograph``,
    ``albedo_true`` and ``roughness_true`` [h, w, 1 or 3]; in a thorough evaluation also ``relit`` and
    ``photograph_relit``."""
    exposure: float = 1.0
    """What radiance is multiplied with to be shown, see :attr:`HeldOut.exposure`."""
    environment: dict[str, FloatArray] = field(default_factory=dict)
    """Maps of an environment that is recovered: ``fitted`` and, where known, ``truth`` [height, width, 3]."""


def steadied(right: Tensor, left: Tensor) -> Tensor:
    """The right side's picture by few samples with the left side's as control variate [h, w, 3]: the left side plus the
    mean difference of both over the pixels around. What the sides differ by is smooth where the field is, and has the
    noise of as many times more samples; both pictures are of the same positions, so emitters cancel.
    """
    return left + box_mean(right - left, STEADY)


@torch.no_grad()
def evaluate(
    held_out: HeldOut,
    estimator: Estimator,
    render_spp: int,
    glossy: bool = False,
    light: tuple[FittedEnvironment, EnvironmentScores] | None = None,
    scene: Scene | None = None,
    steady: bool = False,
    bars: ErrorBars | None = None,
) -> Evaluation:
    """Score albedo, roughness, light and the method's own rendering at ``render_spp`` samples a pixel.

    Args:
        light: an environment that is recovered, and what scores it.
        glossy: also score the lit glossy pixels, which takes seconds to minutes to find, and what needs ``scene``.
        scene: where it has another light for its held-out views, they are rendered in it, too.
        steady: take the noise of few samples from the rendering, see :func:`steadied`, as long as there is a field.
    """
    world, materials, radiance = estimator.world, estimator.materials, estimator.radiance
    rhs = MethodRenderer(estimator.method, estimator)
    lhs = None if radiance is None else FieldRenderer(estimator, parts=True)
    lamps = recovered_lamps(world)
    found_light = light is not None or lamps is not None
    device, stride = world.geometry.vertices.device, held_out.stride
    fitted = not isinstance(materials, TrueMaterials)
    maps: list[dict[str, FloatArray]] = held_out.predict(materials) if fitted else [{} for _ in held_out.views]
    fields: list[FloatArray] = []
    for index, (view, entry) in enumerate(_counted(held_out, maps, "pictures")):
        right = render(view.camera, rhs, render_spp, SEED + index, device, stride=stride)
        entry["render"] = right.cpu().numpy()
        if lhs is not None:
            spp = render_spp if steady else min(FIELD_SPP, render_spp)  # positions of the rendering, for a difference
            left, emitted = render(view.camera, lhs, spp, SEED + index, device, stride=stride).tensor_split((3,), -1)
            missing = torch.zeros_like(left)
            if world.delta is None:
                missing = held_out.emitted(index, world.emitted, found_light) - emitted
            right = steadied(right, left) + missing if steady else right
            left = left + missing
            entry["render"] = right.cpu().numpy()
            entry["residual"] = (left - right).abs().cpu().numpy()
            fields.append(left.cpu().numpy())
        entry.update(held_out.truth(index))
        entry["seen"] = seen_map(held_out.counted(index), held_out.seen(index))
    if bars is not None and isinstance(materials, FittedMaterials):
        for entry, found_bars in zip(maps, predict_bars(held_out, bars, materials), strict=True):
            entry.update(found_bars)
    unknown = light is not None or (lamps is not None and lamps.values.requires_grad)
    regions = {"lit_glossy": lit_glossy(held_out, estimator.method, estimator)} if glossy and fitted else None
    scores = score(held_out, maps, [entry["render"] for entry in maps], regions, fitted and unknown, fields or None)
    if fitted:
        counted = [held_out.counted(index) for index in range(len(held_out.views))]
        scores |= albedo_at_limits(maps, counted)
        if unknown and not world.features.is_diffuse:
            scores |= roughness_spread(maps, counted)
    if glossy and fitted and scene is not None:
        scores |= _relight(held_out, scene, world, materials, render_spp, maps)
    if bars is not None and glossy:
        scores |= score_bars(held_out, maps)
    if light is None:
        return Evaluation(scores, maps, held_out.exposure)
    environment, against = light
    found = environment.map()
    scores |= against(found, albedo_factors(held_out, maps))
    truth = {} if against.truth is None else {"truth": against.truth}
    return Evaluation(scores, maps, held_out.exposure, {"fitted": found, **truth})


def _relight(
    held_out: HeldOut, scene: Scene, world: World, materials: Materials, spp: int, maps: list[dict[str, FloatArray]]
) -> dict[str, float]:
    """Path-trace the held-out views under the scene's other light, into ``maps``, and score them."""
    other = relight_map(scene)
    if other is None:
        return {}
    tracer = path_tracer(relit_world(world, scene, other), materials, scene.max_depth, scene.rr_depth)
    device = world.geometry.vertices.device
    for index, (view, entry) in enumerate(_counted(held_out, maps, "relit pictures")):
        entry["relit"] = render(view.camera, tracer, spp, SEED + index, device, stride=held_out.stride).cpu().numpy()
    return score_relit(held_out, [entry["relit"] for entry in maps])


def _counted(
    held_out: HeldOut, maps: list[dict[str, FloatArray]], what: str
) -> Iterator[tuple[View, dict[str, FloatArray]]]:
    """Every held-out view and what was found for it, counted on the terminal."""
    return counted(zip(held_out.views, maps, strict=True), "evaluating", len(maps), what)
