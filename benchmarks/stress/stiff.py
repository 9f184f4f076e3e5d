"""Stiff transport: albedo near 1, where light bounces a hundred times."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.field import Lab, relative_error, settle, steps_to
from benchmarks.stress.fit import Fit, Plan
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.fields.radiance import RadianceField
from neurad.scene.builtin import build_cube, build_furnace, build_sphere
from neurad.scene.builtin.plain import views
from neurad.scene.description import Scene

ALBEDOS = (0.5, 0.9, 0.97, 0.99, 0.999)
BAR = 0.05
"""Error at which the steps of the two albedos are compared."""
FORWARD_STEPS, RACE_STEPS = 800, 400


def closed_form(scene: Scene, albedo: float) -> float:
    """Reflected radiance of the furnace and of the integrating sphere, the same everywhere."""
    if scene.name == "furnace":
        return albedo / (1.0 - albedo)
    lab = Lab(scene)
    geometry = lab.world.geometry
    emitted = float((geometry.face_area * geometry.emission[:, 0]).sum() / geometry.face_area.sum())
    return emitted * albedo / (1.0 - albedo)


def all_round(scene: Scene, size: int) -> Scene:
    """The scene with six training views that together see every wall: the albedo of what no photograph shows stays
    unknown, and in a closed room its reflected light biases the rest.
    """
    directions = [
        (1.0, 0.0, 0.01),
        (-1.0, 0.0, 0.01),
        (0.0, 1.0, 0.01),
        (0.0, -1.0, 0.01),
        (0.01, 0.0, 1.0),
        (0.01, 0.0, -1.0),
    ]
    return replace(scene, train=views("train", [((0.0, 0.0, 0.0), d) for d in directions], 110.0, size))


def _forward(builder: str, albedo: float, bar: float | None) -> Case:
    """The field alone against the closed form."""

    def measure(quick: bool) -> Outcome:
        scene = (build_furnace if builder == "furnace" else build_sphere)(albedo)
        lab = Lab(scene)
        si = lab.open_points(512, Stream(77))
        truth = torch.full((len(si), 3), closed_form(scene, albedo))
        field, _ = settle(lab, _cameras(scene), FORWARD_STEPS)
        with torch.no_grad():
            mean = float(field(si, lab.materials.albedo(si)).mean() / truth.mean())
        return Outcome(_error(lab, truth)(field), bar, f"mean {mean:.4f} of the truth after {FORWARD_STEPS} steps")

    return Case("stiff", f"{builder}, albedo {albedo}: field alone", "closed form, relative RMS", measure,
                albedo in (0.99,) and builder == "furnace")  # fmt: skip


def _cameras(scene: Scene) -> list[Camera]:
    """Cameras that together see every wall."""
    return [view.camera for view in all_round(scene, 64).train]


def _error(lab: Lab, truth: Tensor, other: Tensor | None = None, count: int = 512) -> Callable[[RadianceField], float]:
    si = lab.open_points(count, Stream(77))
    albedo = lab.materials.albedo(si)

    def error(field: RadianceField) -> float:
        with torch.no_grad():
            return relative_error(field(si, albedo), truth, other)

    return error


def _race(builder: str) -> Case:
    """Steps to 5 % at albedo 0.97 over those at 0.5."""

    def measure(quick: bool) -> Outcome:
        needed: list[int | None] = []
        for albedo in (0.5, 0.97):
            lab = Lab((build_furnace if builder == "furnace" else build_cube)(albedo))
            count = 512 if builder == "furnace" else 128
            if builder == "furnace":
                truth, other = torch.full((count, 3), albedo / (1.0 - albedo)), None
            else:
                si, spp = lab.open_points(count, Stream(77)), 512
                truth, other = lab.traced(si, spp, 1), lab.traced(si, spp, 2)
            error = _error(lab, truth, other, count)
            needed.append(steps_to(settle(lab, _cameras(lab.scene), RACE_STEPS, error)[1], BAR))
        half, stiff = needed
        ratio = stiff / half if half and stiff else float("inf")
        return Outcome(ratio, 3.0, f"steps at 0.5 and 0.97: {half} and {stiff}")

    oracle = "closed form" if builder == "furnace" else "path-traced field"
    return Case("stiff", f"{builder}, albedo 0.97: steps to 5 %", f"those at 0.5, {oracle}: their ratio", measure,
                False)  # fmt: skip


def _recovered(builder: str, albedo: float, bar: float | None) -> Case:
    """Albedo from photographs."""

    def measure(quick: bool) -> Outcome:
        scene = all_round((build_furnace if builder == "furnace" else build_sphere)(albedo), 16)
        pixels = 16 * 16
        reflected = closed_form(scene, albedo)
        images = torch.full((len(scene.train), pixels, 3), reflected)
        plan = Plan(steps=500 if quick else 2000, emitters_train=builder == "furnace")
        if builder == "furnace":
            images += 1.0
        fit = Fit(scene, images, plan).run()
        error, mean = fit.albedo_error()
        passes = bar if bar is None or not quick else 5.0 * bar  # a quarter of the steps does not converge
        return Outcome(error, passes, f"albedo found {mean:.4f}, {plan.steps} steps")

    return Case("stiff", f"{builder}, albedo {albedo}: recovered", "true albedo, RMS", measure,
                builder == "furnace" and albedo == 0.99)  # fmt: skip


def cases() -> list[Case]:
    """Field alone, race and recovery."""

    def bar(builder: str, albedo: float) -> float | None:
        if albedo > 0.99:
            return None
        return 0.03 if builder == "sphere" else 0.01 if albedo == 0.99 else 0.02

    forward = [
        _forward(builder, albedo, bar(builder, albedo)) for builder in ("furnace", "sphere") for albedo in ALBEDOS
    ]
    recovered = [
        _recovered(builder, albedo, None if albedo > 0.99 else 0.002 if albedo == 0.99 else 0.01)
        for builder in ("furnace", "sphere")
        for albedo in ALBEDOS
    ]
    return [*forward, _race("furnace"), _race("cube"), *recovered]
