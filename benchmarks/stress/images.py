"""Black, scaled and spoilt photographs."""

import torch
from torch import Tensor

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.runs import fit, sentence
from benchmarks.stress.scenes import small_cube
from neurad.core.rng import Stream
from neurad.scene.description import Scene


def _scene(views: int = 4, albedo: float = 0.5) -> tuple[Scene, Tensor]:
    scene = resized(small_cube(12, albedo), 12, views)
    return scene, photographs(scene, 16)


def _black() -> Case:
    def measure(quick: bool) -> Outcome:
        scene, images = _scene(2)
        text = sentence(scene, torch.zeros_like(images))
        return Outcome(float("black" not in text), 0.0, text)

    return Case("images", "every photograph black", "one sentence that says so", measure)


def _one_black() -> Case:
    def measure(quick: bool) -> Outcome:
        scene, images = _scene()
        images[0] = 0.0
        found = Fit(scene, images, Plan(steps=60 if quick else 300)).run()
        return Outcome(0.0, 0.0, f"albedo error {found.albedo_error()[0]:.3f} with one view of four black")

    return Case("images", "one photograph of four black", "every loss finite", measure)


def _scaled(factor: float) -> Case:
    def measure(quick: bool) -> Outcome:
        scene, images = _scene(2)
        _, printed = fit(scene, images * factor)
        _, unscaled = fit(scene, images)
        warned = printed.count("times as bright") == 1 and "times as bright" not in unscaled
        return Outcome(float(not warned), 0.0, " ".join(printed.split())[:200])

    return Case("images", f"photographs alone scaled by {factor:g}", "one warning that names the factor", measure)


def _fireflies() -> Case:
    """One pixel in a thousand 1000 times too bright."""

    def measure(quick: bool) -> Outcome:
        scene, images = _scene(8, albedo=0.8)
        spoilt = images.clone().view(-1, 3)
        hit = Stream(3).uniform(len(spoilt)) < 1e-3
        hit[7] = True
        spoilt[hit] *= 1000.0
        plan = Plan(steps=200 if quick else 400)
        clean = Fit(scene, images, plan).run().albedo_error()
        error, mean = Fit(scene, spoilt.view_as(images), plan).run().albedo_error()
        note = f"albedo error {error:.3f}, without fireflies {clean[0]:.3f}; mean albedo {mean:.3f} and {clean[1]:.3f}"
        return Outcome(abs(error - clean[0]), None, note)

    return Case("images", "0.1 % of the pixels 1000 times too bright", "the fit without them: albedo error",
                measure, quick=False)  # fmt: skip


def cases() -> list[Case]:
    """Bad photographs."""
    return [_black(), _one_black(), _scaled(1e3), _scaled(1e-3), _fireflies()]
