"""Rooms that tell of roughness little, unevenly, or through noise."""

from dataclasses import replace

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs
from benchmarks.stress.scenes import small_cube, with_material
from neurad.core.parameters import ROUGHNESS
from neurad.core.reflection import PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material
from neurad.scene.builtin.plain import views
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.scoring import error_bars

STEPS, LONG = 600, 1500
PANELS = (0.15, 0.3, 0.45, 0.6)
"""Roughness of the floor's panels where no highlight falls."""
NOISE = 0.2
"""Standard deviation of a photograph's pixels over their mean."""


def _material(name: str, albedo: float, roughness: float) -> Material:
    return Material(
        name,
        PrincipledModel(),
        Constant(np.full(3, albedo, np.float32)),
        Constant(np.full(1, roughness, np.float32)),
    )


def even_sky() -> Scene:
    """A floor of four panels under a sky of one radiance, seen from above: all coats look the same."""
    meshes = [
        quad((-2.0 + 2.0 * (i % 2), 0.0, -2.0 + 2.0 * (i // 2)), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0)).mesh(f"panel {i}", i)
        for i in range(len(PANELS))
    ]
    eyes = [((x, 3.0, z), (0.5 * x, 0.0, 0.5 * z)) for x in (-0.8, 0.8) for z in (-0.8, 0.8)]
    return Scene(
        name="even sky",
        meshes=meshes,
        materials=[_material(mesh.name, 0.5, roughness) for mesh, roughness in zip(meshes, PANELS, strict=True)],
        environment=EnvironmentMap(np.ones((8, 16, 3), np.float32)),
        train=views("train", eyes, 40.0, 16),
        test=views("test", eyes[:1], 40.0, 16),
        max_depth=4,
    )


def shiny_floor(roughness: float) -> Scene:
    """The cube of rough paint on a floor that is nearly a mirror; in 16 pixels its highlights cover too few."""
    scene = with_material(small_cube(32), PrincipledModel(), 0.5, 0.6)
    floor = quad((-1.0, -0.995, -1.0), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0))
    mesh = floor.mesh("floor", len(scene.materials), smooth_shading=False)
    return replace(
        scene, meshes=[*scene.meshes, mesh], materials=[*scene.materials, _material("floor", 0.3, roughness)]
    )


def _no_highlight() -> Case:
    """Error bars where no photograph tells the roughness: they must not say that one does."""

    def measure(quick: bool) -> Outcome:
        scene = even_sky()
        fit = Fit(scene, photographs(scene, 256), Plan(steps=STEPS)).run()
        si = fit.seen(2048)
        training = fit.training
        bars = error_bars(training.assembly, training.views, fit.photos, training.step.counters)
        if bars is None:
            raise FloatingPointError("the fit has no error bars")
        std = bars.at(fit.materials, si.p)[ROUGHNESS.name]
        found = fit.surface(si)
        with torch.no_grad():
            truth = TrueMaterials(scene, fit.world.geometry)(si)
        off = (found.roughness - truth.roughness).numpy()
        outside = float((np.abs(off) > 2.0 * std).mean())
        albedo = float((found.albedo - truth.albedo).square().mean().sqrt())
        note = f"error {float(np.sqrt(np.square(off).mean())):.3f}, standard deviation {float(np.median(std)):.3f}"
        return Outcome(outside, 0.1, f"{note}; albedo's RMS error {albedo:.4f}")

    return Case("surfaces", "no highlight in any photograph: what error bars claim",
                "roughness more than two standard deviations off, part of the surface", measure, False)  # fmt: skip


def _shiny_floor(roughness: float) -> Case:
    """One surface that is nearly a mirror in a room of rough paint."""

    def measure(quick: bool) -> Outcome:
        scene = shiny_floor(roughness)
        fit = Fit(scene, photographs(scene, 64), Plan(steps=LONG)).run()
        si = fit.seen(4096)
        found = fit.surface(si)
        with torch.no_grad():
            truth = TrueMaterials(scene, fit.world.geometry)(si)
        floor = truth.roughness[:, 0] == truth.roughness.min()
        error = float((found.roughness - truth.roughness).abs()[floor].mean())
        rest = float((found.roughness - truth.roughness).abs()[~floor].mean())
        albedo = float((found.albedo - truth.albedo).square().mean().sqrt())
        mean = float(found.roughness[floor].mean())
        note = f"roughness of the floor {mean:.3f}, error of the rest {rest:.3f}; albedo's RMS error {albedo:.4f}"
        return Outcome(error, 0.05, note)

    return Case("surfaces", f"a floor of roughness {roughness:g} among rough paint",
                "true roughness of the floor, mean", measure, False)  # fmt: skip


def _noisy() -> Case:
    """Photographs whose pixels are off by a fifth."""

    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(32), PrincipledModel(), 0.5, 0.3)
        clean = photographs(scene, 256)
        noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(11))
        fits = [Fit(scene, images, Plan(steps=STEPS)).run() for images in (clean, clean * (1.0 + NOISE * noise))]
        errors = []
        for fit in fits:
            si = fit.seen(4096)
            found = fit.surface(si)
            errors.append(
                (float((found.albedo - 0.5).square().mean().sqrt()), float((found.roughness - 0.3).abs().mean()))
            )
        (clean_albedo, clean_roughness), (albedo, roughness) = errors
        note = (
            f"without noise {clean_albedo:.4f}; roughness off by {roughness:.3f}, without noise {clean_roughness:.3f}"
        )
        return Outcome(albedo, 0.06, note)

    return Case("surfaces", "photographs of 20 % noise", "true albedo, RMS", measure, False)


def cases() -> list[Case]:
    """What tells nothing, what tells at one place alone, what is noisy."""
    return [_no_highlight(), _shiny_floor(0.05), _noisy()]
