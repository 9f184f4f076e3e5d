"""Whether lamps that are taken as known are as bright as the photographs show them: said before training."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neurad.assembly.build import Assembly
from neurad.assembly.common_causes import common_causes
from neurad.core.errors import InputError
from neurad.core.protocols import PhotoSource
from neurad.core.records import Float64Array, PixelBatch
from neurad.core.scene_records import Camera
from neurad.emitters.area import AreaLights
from neurad.emitters.lights import make_lights
from neurad.evidence.shared_errors import MATTERS
from neurad.lamps.photographed import MIN_PIXELS, REFUSE, WARN, PhotographedLamp, lamp_photographs, photographed_lamps
from neurad.runtime.progress import say

MAX_LISTED_LAMPS = 8
"""Lamps that get a line of their own; those that differ always do."""


def check_lamps(assembly: Assembly, photographs: PhotoSource, sample: PixelBatch) -> tuple[list[str] | None, bool]:
    """Print how bright each lamp is in the photographs, of which ``sample`` are random pixels that show no emitter, and
    refuse those that are far from what the scene says.

    Returns:
        What is wrong with all photographs, so that lamps seem to differ, None where no lamp does; and whether some lamp
        is as bright as declared.

    Raises:
        InputError: a lamp is more than three times brighter or darker than declared, and
            ``model.lighting.lamp_mismatch`` is ``refuse``.
    """
    scene = assembly.scene
    if not scene.features.has_area_lights or not photographs.has_photographs:
        return None, False
    cameras, seed = [view.camera for view in scene.train], assembly.settings.seed
    shown = lamp_photographs(assembly.world, cameras, photographs, sample, seed).developed(assembly.development)
    lamps = photographed_lamps(scene, assembly.world, assembly.materials, cameras, shown, seed)
    off = any(lamp.beyond(WARN) for lamp in lamps)
    causes = causes_of_mismatch(assembly, photographs, lamps) if off else []
    say(*(f"warning: {cause}" for cause in causes), *report(lamps, bool(causes)))
    wrong = far_off(lamps)
    if wrong and not causes and assembly.settings.lighting.lamp_mismatch == "refuse":
        raise InputError(f"scene {scene.name}: {refusal(wrong)}")
    return causes if off else None, any(map(agrees, lamps))


def agrees(lamp: PhotographedLamp) -> bool:
    """Whether photographs show a lamp as bright as it is declared."""
    return lamp.pixels - lamp.clipped >= MIN_PIXELS and not lamp.beyond(WARN)


def causes_of_mismatch(
    assembly: Assembly,
    photographs: PhotoSource,
    lamps: Sequence[PhotographedLamp],
    views: Sequence[tuple[Tensor, Camera, Tensor]] | None = None,
) -> list[str]:
    """What all photographs have in common that may make lamps look wrong, some of which they show not as declared; by
    ``views`` as of :func:`common_causes`.
    """
    off = [lamp for lamp in lamps if lamp.beyond(WARN)]
    scene, world = assembly.scene, assembly.world
    emission = world.geometry.emission.clone()
    for lamp in off:
        radiance = np.where(np.isnan(lamp.radiance), lamp.declared, lamp.radiance)
        emission[world.geometry.mesh_index == lamp.mesh] = torch.as_tensor(radiance).to(emission)
    shining = AreaLights(world.geometry, emission)
    relit = world.under(make_lights(scene, world.geometry, lamps=shining).to(emission.device))
    shown = np.concatenate([lamp.photographed for lamp in off])
    given = np.concatenate([lamp.declared + lamp.reflected for lamp in off])
    logs = np.log(np.stack((shown, given)))
    power = _common(logs[0] / np.where(np.abs(logs[1]) > 0.5, logs[1], np.nan))
    return common_causes(
        relit, [view.camera for view in scene.train], photographs, assembly.settings.seed, assembly.development, views,
        scale_known=True, declared=world, power=power if power and abs(power - 1.0) > MATTERS else None,
        offset=_common(shown - given),
    )  # fmt: skip


def _common(values: Float64Array) -> float | None:
    """The positive number that values agree on; None where there is none."""
    values = values[np.isfinite(values)]
    middle = float(np.median(values)) if len(values) else 0.0
    return middle if middle > 0.0 and np.ptp(values) <= MATTERS * middle else None


def far_off(lamps: Sequence[PhotographedLamp]) -> list[PhotographedLamp]:
    """Those that a fit refuses: surely more than three times brighter or darker than declared."""
    return [lamp for lamp in lamps if lamp.pixels - lamp.clipped >= MIN_PIXELS and lamp.beyond(REFUSE)]


def report(lamps: Sequence[PhotographedLamp], excused: bool = False) -> list[str]:
    """Lines about lamps: all that differ, some of the others, and where some are shown, which ones are not. Where
    something is wrong with all photographs they are ``excused``, and no radiance is advised.
    """
    lines: list[str] = []
    listed = unknown = 0
    for lamp in lamps:
        differs = lamp.beyond(WARN)
        if lamp.pixels == 0 or (listed >= MAX_LISTED_LAMPS and not differs):
            unknown += 0 < lamp.pixels == lamp.clipped
            continue
        listed += 1
        seen = f"{lamp.pixels} pixel{'s' * (lamp.pixels != 1)} of {lamp.views} view{'s' * (lamp.views != 1)}"
        if lamp.clipped == lamp.pixels:
            lines.append(
                f"lamp {lamp.name}: {seen} show it, half or more of them clipped in each, so it cannot be checked"
            )
            continue
        clipped = f", {lamp.clipped} clipped" if lamp.clipped else ""
        lines.append(f"lamp {lamp.name}: photographed over declared radiance {_three(lamp.factor)} ({seen}{clipped})")
        if differs and excused:
            lines[-1] += "; that is no measure of its radiance before the photographs are mended"
        elif differs:
            lines.append(
                f"warning: lamp {lamp.name} is {_brighter(lamp)} in the photographs than in the scene; with known "
                f"lamps the materials take that up, so set its radiance to {_three(lamp.radiance)}, or check the "
                "photographs' exposure"
            )
    shown = sum(lamp.pixels > 0 for lamp in lamps)
    if shown > listed + unknown:
        lines.append(f"{shown - listed - unknown} more lamps are as bright in the photographs as declared")
    if unknown:
        lines.append(f"{unknown} more lamps are clipped wherever they are shown, so they cannot be checked")
    hidden = [lamp.name for lamp in lamps if lamp.pixels == 0]
    if hidden and shown:
        more = f" and {len(hidden) - MAX_LISTED_LAMPS} others" if len(hidden) > MAX_LISTED_LAMPS else ""
        names = ", ".join(hidden[:MAX_LISTED_LAMPS]) + more
        lines.append(f"no photograph shows {names} alone in a pixel: nothing checks the radiance there")
    return lines


def refusal(wrong: Sequence[PhotographedLamp]) -> str:
    """The sentence about lamps that are far from what the scene says."""
    first = max(wrong, key=lambda lamp: float(np.nanmax(np.abs(np.log(np.maximum(lamp.compared, 1e-30))))))
    others = f" (and {len(wrong) - 1} other lamps)" if len(wrong) > 1 else ""
    return (
        f"lamp {first.name}{others} is {_brighter(first)} in the photographs than the declared radiance "
        f"{_three(first.declared)}: no material makes up for that; set it to {_three(first.radiance)}, take it from "
        "the photographs with --model.lighting.emitters photographs, or train all the same with "
        "--model.lighting.lamp_mismatch warn"
    )


def _brighter(lamp: PhotographedLamp) -> str:
    """By how much a lamp differs, by the channel that differs most."""
    factor = lamp.compared[~np.isnan(lamp.compared)]
    most = float(factor[np.argmax(np.abs(np.log(np.maximum(factor, 1e-30))))])
    alike = float(factor.max()) < 1.1 * float(factor.min())
    where = "" if alike else f" in {('red', 'green', 'blue')[int(np.argmax(lamp.compared == most))]}"
    if most >= 1.0:
        return f"{most:.3g} times brighter{where}"
    return f"{1.0 / max(most, 1e-30):.3g} times darker{where}"


def _three(values: Float64Array) -> str:
    return ", ".join(f"{float(x):.3g}" for x in values)
