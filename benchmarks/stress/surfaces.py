"""Roughness and albedo at the ends of their range, in truth and in the estimate."""

from dataclasses import replace

import torch

from benchmarks.stress import highlights
from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, photographs, resized
from benchmarks.stress.scenes import small_cube, with_material
from neurad.assembly.build import build_world
from neurad.core.frame import Frame
from neurad.core.records import Surface
from neurad.core.reflection import DiffuseModel, PrincipledModel
from neurad.core.rng import Stream
from neurad.core.sampling import cosine_hemisphere
from neurad.scene.builtin import build_cornell
from neurad.scene.description import Scene
from neurad.scene.textures import TrueMaterials

SEEDS = 3
"""Fits of a room of one glossy material."""


def _energy(roughness: float) -> Case:
    """Mean of the BSDF's sampling weights against the integral of its values by uniform directions."""

    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(), PrincipledModel(), 0.0, roughness)
        bsdf = build_world(scene).bsdf
        n = 200_000 if quick else 1_000_000
        stream = Stream(1)
        wo = torch.tensor([[0.6, 0.0, 0.8]]).expand(n, 3)
        surface = Surface(torch.zeros(n, 3), torch.full((n, 1), roughness))
        sample = bsdf.sample(surface, wo, stream.uniform(n, 3))
        again, pdf = bsdf.eval_pdf(surface, wo, sample.wi)
        ratio = torch.where(pdf > 0, again[:, 0] / pdf.clamp_min(1e-30), 0.0)
        worst = float((ratio - sample.weight[:, 0]).abs().max())  # weight = f cos / pdf, lane by lane
        mean = float(sample.weight.mean())
        if not bool(torch.isfinite(sample.weight).all() and torch.isfinite(pdf).all()):
            raise FloatingPointError("weight or pdf is not finite")
        error = worst + max(0.0, mean - 1.0)
        return Outcome(error, 1e-3, f"directional albedo of the specular lobe {mean:.4f}")

    return Case("surfaces", f"roughness {roughness:g} in the truth",
                "weight = value / pdf lane by lane, energy <= 1", measure)  # fmt: skip


def _diffuse_energy() -> Case:
    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(), DiffuseModel(), 1.0)
        world = build_world(scene)
        n = 20_000
        stream = Stream(2)
        normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(n, 3)
        wo = Frame.around(normal).to_world(cosine_hemisphere(stream.uniform(n, 2)))
        sample = world.bsdf.sample(Surface(torch.ones(n, 3), torch.ones(n, 1)), wo, stream.uniform(n, 3))
        return Outcome(float((sample.weight.mean() - 1.0).abs()), 1e-3, "")

    return Case("surfaces", "albedo 1 in the truth", "directional albedo 1", measure)


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

    return Case("surfaces", f"albedo {albedo:g} in the truth: recovered", "true albedo where light falls, RMS", measure,
                False)  # fmt: skip


def _estimate(albedo: float, roughness: float) -> Case:
    """The step at the ends of the fields' range: losses and gradients stay finite."""

    def measure(quick: bool) -> Outcome:
        scene = _glossy(resized(build_cornell(), 12, 4))
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

    return Case("surfaces", f"albedo {albedo:g}, roughness {roughness:g} in the estimate",
                "steps with a loss or gradient that is not finite", measure)  # fmt: skip


def _glossy(scene: Scene) -> Scene:
    return replace(scene, materials=[replace(m, model=PrincipledModel()) for m in scene.materials])


def _rough_fit(roughness: float) -> Case:
    """A room of one glossy material, recovered with a few seeds: at 0.001 they end between 0.02 and 0.06."""

    def measure(quick: bool) -> Outcome:
        scene = with_material(small_cube(16), PrincipledModel(), 0.3, roughness)
        images, rows = photographs(scene, 64), []
        for seed in range(SEEDS):
            fit = Fit(scene, images, Plan(steps=600).with_seed(seed)).run()
            si = fit.seen(2048)
            found = fit.surface(si)
            with torch.no_grad():
                truth = TrueMaterials(scene, fit.world.geometry)(si)
            off = (found.roughness - roughness).abs().mean(), (found.albedo - truth.albedo).square().mean().sqrt()
            rows.append(torch.stack((*off, found.roughness.mean())))
        error, albedo, rough = torch.stack(rows).mean(0).tolist()
        return Outcome(error, 0.05, f"roughness found {rough:.3f}; albedo's RMS error {albedo:.4f}, {SEEDS} seeds")

    return Case("surfaces", f"roughness {roughness:g} in the truth: recovered", "true roughness, mean", measure, False)


def cases() -> list[Case]:
    """Truth first, then the estimate."""
    return [
        *(_energy(r) for r in (1e-3, 0.02, 1.0)),
        _diffuse_energy(),
        _recovered(0.0),
        _recovered(1.0),
        *(_estimate(a, r) for a in (0.0, 1.0) for r in (0.0, 1.0)),
        *(_rough_fit(r) for r in (1e-3, 0.02, 1.0)),
        *highlights.cases(),
    ]
