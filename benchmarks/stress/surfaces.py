"""Roughness and albedo at the ends of their range, in truth and in the estimate, and rooms that tell of roughness
little, unevenly, or through noise.
"""

from dataclasses import replace

import numpy as np
import torch

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, glossy, photographs, resized, small_cube, with_material
from neurad.core.parameters import ROUGHNESS
from neurad.core.records import Surface, SurfaceInteraction
from neurad.core.reflection import DiffuseModel, PrincipledModel
from neurad.core.scene_records import Constant, EnvironmentMap, Material
from neurad.scene.builtin import build_cornell
from neurad.scene.builtin.plain import views
from neurad.scene.builtin.shapes import quad
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials
from neurad.training.scoring import error_bars

SEEDS = 3
"""Fits of a room of one glossy material."""
STEPS, LONG = 600, 1500
PANELS = (0.15, 0.3, 0.45, 0.6)
"""Roughness of the floor's panels where no highlight falls."""
NOISE = 0.2
"""Standard deviation of a photograph's pixels over their mean."""


def _found_and_true(fit: Fit, si: SurfaceInteraction) -> tuple[Surface, Surface]:
    with torch.no_grad():
        return fit.surface(si), TrueMaterials(fit.scene, fit.world.geometry)(si)


def _rms(found: torch.Tensor, truth: torch.Tensor) -> float:
    return float((found - truth).square().mean().sqrt())


def _recovered(albedo: float) -> Case:
    """Photographs of a room whose walls reflect nothing or everything.

    Where nothing is ever absorbed light never ends, and the noise of photographs sets the error. So that is the bar, as
    two draws of half the samples differ, over the root of 2, since no albedo is above 1 and half of it is cut off.
    """

    def measure(quick: bool) -> Outcome:
        scene = resized(small_cube(12, albedo=0.5), 12, 4 if quick else 8)
        scene = with_material(scene, DiffuseModel(), albedo)
        white = albedo == 1
        deep, spp = replace(scene, max_depth=200 if white else 8), 100 if white and not quick else 8
        first, second = (photographs(deep, spp, seed) for seed in (7, 1007))
        noise = float(((first - second) / (first + second).clamp_min(1e-30)).square().mean().sqrt())
        fit = Fit(scene, (first + second) / 2.0, Plan(steps=150 if quick else 600))
        error, mean = fit.run().albedo_error(lit=True)
        note = f"albedo found {mean:.3f}; the photographs' noise is {noise:.3f}"
        bar = None if quick else min(noise / 2.0**0.5, 0.2)
        return Outcome(error, bar if white else 0.05, note)

    extreme = f"albedo {albedo:g} in the truth: recovered"
    return Case("surfaces", extreme, "true albedo where light falls, RMS", measure, False)


def _estimate(albedo: float, roughness: float) -> Case:
    """The step at the ends of the fields' range: losses and gradients stay finite."""

    def measure(quick: bool) -> Outcome:
        scene = glossy(resized(build_cornell(), 12, 4))
        images = photographs(replace(scene, max_depth=4), 4)
        fit = Fit(scene, images, Plan(steps=1))
        with torch.no_grad():
            for field, value in zip(fit.materials.recovered.values(), (albedo, roughness), strict=True):
                list(field.mlp.parameters())[-1].fill_(40.0 if value >= 1 else -40.0)
        worst = 0.0
        for i in range(5 if quick else 50):
            loss = fit.advance(i / 50)
            grads = [p.grad for part in (fit.materials, fit.radiance) for p in part.parameters() if p.grad is not None]
            total = sum(float((g._values() if g.is_sparse else g).double().abs().sum()) for g in grads)
            worst += float(not (abs(float(loss)) < 1e30 and total < 1e30))
        found = fit.surface(fit.seen(512))
        note = f"albedo {float(found.albedo.mean()):.3g}, roughness {float(found.roughness.mean()):.3g} at the end"
        return Outcome(worst, 0.0, note)

    extreme = f"albedo {albedo:g}, roughness {roughness:g} in the estimate"
    return Case("surfaces", extreme, "steps with a loss or gradient that is not finite", measure)


def _rough_fit(roughness: float) -> Case:
    """A room of one glossy material, recovered with a few seeds: at 0.001 they end between 0.02 and 0.06."""

    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(16), PrincipledModel(), 0.3, roughness)
        images, rows = photographs(scene, 64), []
        for seed in range(SEEDS):
            fit = Fit(scene, images, Plan(steps=STEPS).with_seed(seed)).run()
            found, truth = _found_and_true(fit, fit.seen(2048))
            off = float((found.roughness - roughness).abs().mean())
            rows.append((off, _rms(found.albedo, truth.albedo), float(found.roughness.mean())))
        error, albedo, rough = np.mean(rows, 0)
        return Outcome(error, 0.05, f"roughness found {rough:.3f}; albedo's RMS error {albedo:.4f}, {SEEDS} seeds")

    return Case("surfaces", f"roughness {roughness:g} in the truth: recovered", "true roughness, mean", measure, False)


def _material(name: str, albedo: float, roughness: float) -> Material:
    colour, rough = np.full(3, albedo, np.float32), np.full(1, roughness, np.float32)
    return Material(name, PrincipledModel(), Constant(colour), Constant(rough))


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
        found, truth = _found_and_true(fit, si)
        off = (found.roughness - truth.roughness).numpy()
        outside = float((np.abs(off) > 2.0 * std).mean())
        note = f"error {float(np.sqrt(np.square(off).mean())):.3f}, standard deviation {float(np.median(std)):.3f}"
        return Outcome(outside, 0.1, f"{note}; albedo's RMS error {_rms(found.albedo, truth.albedo):.4f}")

    extreme = "no highlight in any photograph: what error bars claim"
    oracle = "roughness more than two standard deviations off, part of the surface"
    return Case("surfaces", extreme, oracle, measure, False)


def _shiny_floor(roughness: float) -> Case:
    """A floor that is nearly a mirror in a room of rough paint; in 16 pixels its highlights would cover too few."""

    def measure(quick: bool) -> Outcome:
        room = with_material(small_cube(32), PrincipledModel(), 0.5, 0.6)
        floor = quad((-1.0, -0.995, -1.0), (0.0, 0.0, 2.0), (2.0, 0.0, 0.0))
        mesh = floor.mesh("floor", len(room.materials), smooth_shading=False)
        materials = [*room.materials, _material("floor", 0.3, roughness)]
        scene = replace(room, meshes=[*room.meshes, mesh], materials=materials)
        fit = Fit(scene, photographs(scene, 64), Plan(steps=LONG)).run()
        found, truth = _found_and_true(fit, fit.seen(4096))
        here = truth.roughness[:, 0] == truth.roughness.min()
        off = (found.roughness - truth.roughness).abs()
        mean, rest, albedo = found.roughness[here].mean(), off[~here].mean(), _rms(found.albedo, truth.albedo)
        note = f"roughness of the floor {mean:.3f}, error of the rest {rest:.3f}; albedo's RMS error {albedo:.4f}"
        return Outcome(float(off[here].mean()), 0.05, note)

    extreme = f"a floor of roughness {roughness:g} among rough paint"
    return Case("surfaces", extreme, "true roughness of the floor, mean", measure, False)


def _noisy() -> Case:
    """Photographs whose pixels are off by a fifth."""

    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(32), PrincipledModel(), 0.5, 0.3)
        clean = photographs(scene, 256)
        noise = torch.randn(clean.shape, generator=torch.Generator().manual_seed(11))
        errors = []
        for images in (clean, clean * (1.0 + NOISE * noise)):
            fit = Fit(scene, images, Plan(steps=STEPS)).run()
            found, truth = _found_and_true(fit, fit.seen(4096))
            rough = float((found.roughness - truth.roughness).abs().mean())
            errors.append((_rms(found.albedo, truth.albedo), rough))
        (clean_albedo, clean_rough), (albedo, rough) = errors
        note = f"without noise {clean_albedo:.4f}; roughness off by {rough:.3f}, without noise {clean_rough:.3f}"
        return Outcome(albedo, 0.06, note)

    return Case("surfaces", "photographs of 20 % noise", "true albedo, RMS", measure, False)


def cases() -> list[Case]:
    """Extreme albedo and roughness in the truth, then in the estimate; what tells nothing, or at one place alone, or is
    noisy.
    """
    return [
        _recovered(0.0),
        _recovered(1.0),
        *(_estimate(a, r) for a in (0.0, 1.0) for r in (0.0, 1.0)),
        *(_rough_fit(r) for r in (1e-3, 0.02, 1.0)),
        _no_highlight(),
        _shiny_floor(0.05),
        _noisy(),
    ]
