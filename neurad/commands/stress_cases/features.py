"""What a scene does not need is not built: parts, parameters and time, against everything forced on."""

from __future__ import annotations

import resource
import statistics
import time
from dataclasses import replace

import numpy as np
import torch

from neurad.commands.stress_cases.case import Case, Outcome
from neurad.commands.stress_cases.fit import Fit, Plan, photographs, resized
from neurad.core.records import Constant, EnvironmentMap
from neurad.integrators.delta import DeltaSurfaces
from neurad.scene import builtin
from neurad.scene.description import Features, Scene
from neurad.scene.geometry import Geometry

EVERYTHING = Features(True, True, True, False, True)
"""Every part asked for, whatever the scene has."""


def glossy(scene: Scene) -> Scene:
    """The same scene with the parts that ``kitchen`` has: principled BSDF and a roughness field."""
    matte = Constant(np.ones(1, np.float32))
    return replace(
        scene, materials=[replace(m, kind="principled", roughness=matte) if m.kind == "diffuse" else m
                          for m in scene.materials],
    )  # fmt: skip


def forced(scene: Scene) -> Scene:
    """The same scene through the general path: principled BSDF with a roughness field, a black environment, the delta
    chain, one-sided tests.
    """
    dim = EnvironmentMap(np.full((8, 16, 3), 1e-12, np.float32))
    return replace(glossy(scene), environment=dim)


def _built(fit: Fit) -> tuple[str, int]:
    """Names of the parts that a fit has, and the number of its parameters."""
    world = fit.world
    parts = [type(world.lights).__name__, type(world.bsdf).__name__]
    parts += ["roughness field"] if fit.materials.roughness is not None else []
    parts += ["delta chain"] if world.delta is not None else []
    parts += ["one-sided test"] if world.features.has_one_sided else []
    count = sum(p.numel() for module in (fit.materials, fit.radiance) for p in module.parameters())
    return ", ".join(parts), count


def _milliseconds(fits: list[Fit], steps: int) -> list[float]:
    """Processor time of the median step of each; the fits take turns, so that a busy machine slows all of them."""
    spent: list[list[float]] = [[] for _ in fits]
    for i in range(steps + 3):
        for fit, times in zip(fits, spent, strict=True):
            begin = time.process_time()
            fit.advance(0.0)
            if i >= 3:
                times.append(time.process_time() - begin)
    return [1e3 * statistics.median(times) for times in spent]


def _compared(name: str, barred: bool) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = resized(builtin.build(name), 24)
        steps = 20 if quick else 60
        images = photographs(replace(scene, max_depth=3), 1)
        plan = Plan(pixels=512, emitters_count=name == "furnace")
        lean, usual, full = (Fit(s, images, plan) for s in (scene, glossy(scene), forced(scene)))
        force_delta(full)
        (parts, count), (all_parts, all_count) = _built(lean), _built(full)
        ms, usual_ms, all_ms = _milliseconds([lean, usual, full], steps)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        note = (
            f"{parts}: {count} parameters, {ms:.1f} ms a step; forced on ({all_parts}): {all_count}, {all_ms:.1f} ms, "
            f"{all_ms / ms:.2f} times; the parts of kitchen {usual_ms:.1f} ms, {usual_ms / ms:.2f} times; "
            f"peak of the process {memory:.0f} MiB"
        )
        return Outcome(ms / all_ms, 1.0 / 1.5 if barred else None, note)

    return Case("features", f"scene {name}", "ms a step over those with everything forced on", measure,
                barred)  # fmt: skip


def force_delta(fit: Fit) -> None:
    """Give a world the delta chain though no surface is smooth."""
    fit.world.delta = fit.world.delta or DeltaSurfaces(fit.scene, Geometry(fit.scene))
    fit.world.features = EVERYTHING
    fit.primary.world = fit.world


def _same_result() -> Case:
    """A Lambertian scene recovers the same albedo either way."""

    def measure(quick: bool) -> Outcome:
        scene = resized(builtin.build("cornell"), 16)
        images = photographs(replace(scene, max_depth=6), 16)
        plan = Plan(steps=80 if quick else 400)
        lean, full = Fit(scene, images, plan), Fit(forced(scene), images, plan)
        force_delta(full)
        errors = [fit.run().albedo_error()[0] for fit in (lean, full)]
        note = f"albedo error {errors[0]:.4f}, forced on {errors[1]:.4f} (it must find the roughness too)"
        return Outcome(max(0.0, errors[0] - errors[1]), 0.01, note)

    return Case("features", "Lambertian scene, nothing but its needs", "albedo error no larger than forced on", measure)


def _not_there() -> Case:
    def measure(quick: bool) -> Outcome:
        fit = Fit(resized(builtin.build("cornell"), 8), torch.ones(8, 64, 3))
        parts, _ = _built(fit)
        wrong = [word for word in ("roughness", "delta", "Mixed", "Principled", "Environment") if word in parts]
        return Outcome(float(len(wrong)), 0.0, f"built: {parts}")

    return Case("features", "Lambertian under one area light", "no roughness, GGX, environment or delta part", measure)


def cases() -> list[Case]:
    """Every built-in scene, and that leaving out changes nothing."""
    names = ("cornell", *(n for n in builtin.NAMES if n != "cornell"))
    return [_not_there(), *(_compared(name, name == "cornell") for name in names), _same_result()]
