"""What a scene does not need is not built: one scene with only the parts that it needs, with the parts of ``patterns``,
and with everything forced on.
"""

import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, glossy, photographs, plan_of, resized
from neurad.core.parameters import ROUGHNESS
from neurad.core.scene_records import EnvironmentMap
from neurad.emitters.area import AreaLights
from neurad.emitters.environment import Environment
from neurad.integrators.delta import DeltaSurfaces
from neurad.runtime.threads import at_most
from neurad.scene import builtin
from neurad.scene.description import Features, Scene

FASTER = 1.5
"""Least speed-up of a step of a Lambertian scene over one with the parts of ``patterns``."""
EVERYTHING = Features(True, True, True, False, True)
"""Every part enabled, whatever the scene has."""
Form = Literal["needed", "patterns", "forced"]


def make(form: Form, scene: Scene, images: torch.Tensor, plan: Plan) -> Fit:
    """A fit of ``scene`` in one of its forms; 'forced' takes the general path: principled BSDF with a roughness field,
    a black environment if the scene has none, the delta chain and the one-sided tests.
    """
    if form == "needed":
        return Fit(scene, images, plan)
    if form == "patterns":
        return Fit(glossy(scene), images, plan)
    dim = EnvironmentMap(np.full((8, 16, 3), 1e-12, np.float32))
    fit = Fit(replace(glossy(scene), environment=scene.environment or dim), images, plan)
    fit.world.delta = fit.world.delta or DeltaSurfaces(fit.scene, fit.world.geometry)
    fit.world.features = EVERYTHING
    return fit


def parts(fit: Fit) -> tuple[list[str], list[str]]:
    """Names of the parts that a fit has and of those that were left out."""
    world = fit.world
    has = {
        "area lights": not isinstance(world.lights, Environment),
        "environment": not isinstance(world.lights, AreaLights),
        "specular lobe": not world.bsdf.is_diffuse,
        "roughness field": ROUGHNESS.name in fit.materials.recovered,
        "control variate": world.bsdf.varying_weight,
        "guide": world.guide is not None,
        "radiance by direction": "direction" in fit.radiance.inputs,
        "radiance by albedo": fit.radiance.reads_albedo,
        "delta chain": world.delta is not None,
        "one-sided test": world.features.has_one_sided,
    }
    return [name for name, there in has.items() if there], [name for name, there in has.items() if not there]


def _fits(name: str, *forms: Form) -> list[Fit]:
    """A built-in scene in these forms, with the settings of patterns.yaml and training views of 24 x 24 pixels."""
    scene = replace(resized(builtin.build(name), 24), test=[])
    plan = replace(plan_of("patterns.yaml"), emitters_train=name == "furnace")
    images = photographs(replace(scene, max_depth=3), 1)
    return [make(form, scene, images, plan) for form in forms]


def _parameters(fit: Fit) -> int:
    """Trained numbers of all fields."""
    return sum(p.numel() for module in (fit.materials, fit.radiance) for p in module.parameters() if p.requires_grad)


def _milliseconds(fits: Sequence[Fit], steps: int) -> list[float]:
    """Processor time of the median step of each; the fits take turns, so that a busy machine slows all of them."""
    spent: list[list[float]] = [[] for _ in fits]
    with at_most(1):
        for i in range(steps + 3):
            for fit, times in zip(fits, spent, strict=True):
                begin = time.process_time()
                fit.advance(0.0)
                if i >= 3:
                    times.append(time.process_time() - begin)
    return [1e3 * statistics.median(times) for times in spent]


def _lambertian() -> Case:
    """A Lambertian scene under one area light against the path of ``patterns``, all settings those of its config."""

    def measure(quick: bool) -> Outcome:
        lean, usual = _fits("cornell", "needed", "patterns")
        ms, usual_ms = _milliseconds([lean, usual], 20 if quick else 60)
        note = (
            f"{ms:.1f} ms a step, {_parameters(lean)} parameters; patterns {usual_ms:.1f} ms, {_parameters(usual)}, "
            f"{usual_ms / ms:.2f} times"
        )
        return Outcome(ms / usual_ms, 1.0 / FASTER, note)

    extreme = "Lambertian, one area light, settings of patterns.yaml"
    return Case("features", extreme, "ms a step over patterns's path", measure)


def _compared(name: str) -> Case:
    """Parts that a scene has and lacks, and what leaving them out saves."""

    def measure(quick: bool) -> Outcome:
        lean, full = _fits(name, "needed", "forced")
        ms, all_ms = _milliseconds([lean, full], 20 if quick else 60)
        built, left_out = parts(lean)
        note = (
            f"built: {', '.join(built)}; left out: {', '.join(left_out) or 'nothing'}; {_parameters(lean)} parameters, "
            f"{ms:.1f} ms a step; forced on {_parameters(full)}, {all_ms:.1f} ms: {all_ms / ms:.2f} times"
        )
        return Outcome(ms / all_ms, None, note)

    return Case("features", f"scene {name}", "ms a step over those with everything forced on", measure, False)


def _same_result() -> Case:
    """A Lambertian scene recovers the same albedo either way."""

    def measure(quick: bool) -> Outcome:
        scene = resized(builtin.build("cornell"), 16)
        images = photographs(replace(scene, max_depth=6), 16)
        plan = Plan(steps=80 if quick else 400)
        lean, full = (make(form, scene, images, plan).run().albedo_error()[0] for form in ("needed", "forced"))
        note = f"albedo error {lean:.4f}, forced on {full:.4f} (it must find the roughness too)"
        return Outcome(max(0.0, lean - full), 0.01, note)

    extreme = "Lambertian scene, only the parts it needs"
    return Case("features", extreme, "albedo error no larger than forced on", measure)


def cases() -> list[Case]:
    """A Lambertian scene in detail, every built-in scene, and that leaving out changes nothing."""
    return [_lambertian(), *(_compared(name) for name in builtin.NAMES), _same_result()]
