"""Stiff transport: albedo near 1, where light bounces a hundred times."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from benchmarks.closed_form import reflected_radiance
from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.field import Lab, relative_error, settle, steps_to
from benchmarks.stress.fit import Fit, Plan
from neurad.core.rng import Stream
from neurad.core.scene_records import Camera
from neurad.fields.radiance import RadianceField
from neurad.scene.builtin import build_cube, build_furnace, build_sphere
from neurad.scene.builtin.plain import views
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry

ALBEDOS = (0.5, 0.9, 0.97, 0.99, 0.999)
ROOMS: dict[str, Callable[[float], Scene]] = {"furnace": build_furnace, "sphere": build_sphere, "cube": build_cube}
BAR = 0.05
"""Error at which the steps of the two albedos are compared."""
FORWARD_STEPS, RACE_STEPS = 800, 400


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


def _cameras(scene: Scene) -> list[Camera]:
    """Cameras that together see every wall."""
    return [view.camera for view in all_round(scene, 64).train]


def _forward(name: str, albedo: float) -> Case:
    """The field alone against the closed form."""

    def measure(quick: bool) -> Outcome:
        lab = Lab(ROOMS[name](albedo))
        si = lab.open_points(512, Stream(77))
        truth = torch.full((len(si), 3), reflected_radiance(lab.world.geometry, albedo))
        field, _ = settle(lab, _cameras(lab.scene), FORWARD_STEPS)
        with torch.no_grad():
            found = field(si, lab.materials.albedo(si))
        bar = None if albedo > 0.99 else 0.03 if name == "sphere" else 0.01 if albedo == 0.99 else 0.02
        note = f"mean {float(found.mean() / truth.mean()):.4f} of the truth after {FORWARD_STEPS} steps"
        return Outcome(relative_error(found, truth), bar, note)

    quick = name == "furnace" and albedo == 0.99
    return Case("stiff", f"{name}, albedo {albedo}: field alone", "closed form, relative RMS", measure, quick)


def _race(name: str) -> Case:
    """Steps to 5 % at albedo 0.97 over those at 0.5."""

    def error_of(lab: Lab, albedo: float) -> Callable[[RadianceField], float]:
        si = lab.open_points(512 if name == "furnace" else 128, Stream(77))
        at_points, other = lab.materials.albedo(si), None
        if name == "furnace":
            truth: Tensor = torch.full((len(si), 3), reflected_radiance(lab.world.geometry, albedo))
        else:
            truth, other = lab.traced(si, 512, 1), lab.traced(si, 512, 2)
        return lambda field: relative_error(field(si, at_points), truth, other)

    def measure(quick: bool) -> Outcome:
        needed: list[int | None] = []
        for albedo in (0.5, 0.97):
            lab = Lab(ROOMS[name](albedo))
            history = settle(lab, _cameras(lab.scene), RACE_STEPS, error_of(lab, albedo))[1]
            needed.append(steps_to(history, BAR))
        half, stiff = needed
        ratio = stiff / half if half and stiff else float("inf")
        return Outcome(ratio, 3.0, f"steps at 0.5 and 0.97: {half} and {stiff}")

    oracle = f"those at 0.5, {'closed form' if name == 'furnace' else 'path-traced field'}: their ratio"
    return Case("stiff", f"{name}, albedo 0.97: steps to 5 %", oracle, measure, False)


def _recovered(name: str, albedo: float) -> Case:
    """Albedo from photographs."""

    def measure(quick: bool) -> Outcome:
        scene = all_round(ROOMS[name](albedo), 16)
        images = torch.full((len(scene.train), 16 * 16, 3), reflected_radiance(Geometry(scene), albedo))
        if name == "furnace":
            images += 1.0
        plan = Plan(steps=500 if quick else 2000, emitters_train=name == "furnace")
        error, mean = Fit(scene, images, plan).run().albedo_error()
        bar = None if albedo > 0.99 else 0.002 if albedo == 0.99 else 0.01
        if bar is not None and quick:
            bar *= 5.0  # a quarter of the steps does not converge
        return Outcome(error, bar, f"albedo found {mean:.4f}, {plan.steps} steps")

    quick = name == "furnace" and albedo == 0.99
    return Case("stiff", f"{name}, albedo {albedo}: recovered", "true albedo, RMS", measure, quick)


def cases() -> list[Case]:
    """Field alone, race and recovery."""
    rooms = [(name, albedo) for name in ("furnace", "sphere") for albedo in ALBEDOS]
    forward, recovered = ([make(*room) for room in rooms] for make in (_forward, _recovered))
    return [*forward, _race("furnace"), _race("cube"), *recovered]
