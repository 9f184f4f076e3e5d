"""What a scene does not need is not built: parts, parameters, time and memory, against everything forced on."""

from dataclasses import replace

import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.parts import Form, Place, make, memory, milliseconds, parameters, parts
from neurad.scene import builtin

FASTER = 1.5
"""Least speed-up of a step of a Lambertian scene over one with the parts of ``patterns``."""


def _fits(place: Place, *forms: Form) -> list[Fit]:
    scene, plan = place.build(), place.plan()
    images = photographs(replace(scene, max_depth=3), 1)
    return [make(form, scene, images, plan) for form in forms]


def _lambertian() -> Case:
    """A Lambertian scene under one area light against the path of ``patterns``, all settings those of its config."""

    def measure(quick: bool) -> Outcome:
        lean, usual, full = _fits(Place("cornell"), "needed", "patterns", "forced")
        ms, usual_ms, all_ms = milliseconds([lean, usual, full], 20 if quick else 60)
        note = (
            f"{ms:.1f} ms a step, {parameters(lean)} parameters; patterns {usual_ms:.1f} ms, {parameters(usual)}, "
            f"{usual_ms / ms:.2f} times; forced {all_ms:.1f} ms, {parameters(full)}: {all_ms / ms:.2f} times"
        )
        return Outcome(ms / usual_ms, 1.0 / FASTER, note)

    return Case("features", "Lambertian, one area light, settings of patterns.yaml", "ms a step over patterns's path",
                measure)  # fmt: skip


def _compared(name: str) -> Case:
    """Parts that a scene has and lacks, and what leaving them out saves."""

    def measure(quick: bool) -> Outcome:
        place = Place(name)
        lean, full = _fits(place, "needed", "forced")
        ms, all_ms = milliseconds([lean, full], 20 if quick else 60)
        built, left_out = parts(lean)
        note = (
            f"built: {', '.join(built)}; left out: {', '.join(left_out) or 'nothing'}; {parameters(lean)} parameters, "
            f"{ms:.1f} ms a step, {_mib(memory(place, 'needed'))}; forced on {parameters(full)}, {all_ms:.1f} ms, "
            f"{_mib(memory(place, 'forced'))}: {all_ms / ms:.2f} times"
        )
        return Outcome(ms / all_ms, None, note)

    return Case("features", f"scene {name}", "ms a step over those with everything forced on", measure, False)


def _mib(value: float | None) -> str:
    return "memory not known" if value is None else f"{value:.0f} MiB"


def _same_result() -> Case:
    """A Lambertian scene recovers the same albedo either way."""

    def measure(quick: bool) -> Outcome:
        scene = resized(builtin.build("cornell"), 16)
        images = photographs(replace(scene, max_depth=6), 16)
        plan = Plan(steps=80 if quick else 400)
        errors = [make(form, scene, images, plan).run().albedo_error()[0] for form in ("needed", "forced")]
        note = f"albedo error {errors[0]:.4f}, forced on {errors[1]:.4f} (it must find the roughness too)"
        return Outcome(max(0.0, errors[0] - errors[1]), 0.01, note)

    return Case(
        "features", "Lambertian scene, only the parts it needs", "albedo error no larger than forced on", measure
    )


def _not_there() -> Case:
    def measure(quick: bool) -> Outcome:
        built, left_out = parts(Fit(resized(builtin.build("cornell"), 8), torch.ones(8, 64, 3)))
        return Outcome(float(len(built) - 1), 0.0, f"built: {', '.join(built)}; left out: {', '.join(left_out)}")

    return Case("features", "Lambertian under one area light", "parts built besides the area light", measure)


def cases() -> list[Case]:
    """A Lambertian scene in detail, every built-in scene, and that leaving out changes nothing."""
    scenes = [_compared(name) for name in builtin.NAMES]
    return [_not_there(), _lambertian(), *scenes, _same_result()]
