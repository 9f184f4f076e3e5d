"""Number formats, seeds and long runs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, Plan, glossy, photographs, resized
from neurad.bsdf import directional
from neurad.core.protocols import Tracer
from neurad.core.records import Hit, Rays
from neurad.core.rng import Stream
from neurad.scene.builtin import build_cornell
from neurad.scene.description import Scene
from neurad.tracing.counting import CountingTracer


def _box(size: int = 16, views: int = 4) -> Scene:
    return replace(glossy(resized(build_cornell(), size, views)), max_depth=6)


def _dense(fit: Fit) -> Tensor:
    """All gradients as one float64 vector."""
    parameters = [p for part in (fit.materials, fit.radiance) for p in part.parameters()]
    grads = [torch.zeros_like(p) if p.grad is None else p.grad.to_dense() for p in parameters]
    return torch.cat([g.double().flatten() for g in grads])


def _step(fit: Fit) -> tuple[dict[str, float], Tensor]:
    """Losses and gradients of the first step, whose gradients move nothing."""
    fit.training.step.optimizers = {}
    fit.advance(0.0)
    return {name: float(value) for name, value in fit.training.step.losses.items()}, _dense(fit)


def _float64() -> Case:
    """One step from the same random numbers and the same rays, all shading and networks in float64."""

    def measure(quick: bool) -> Outcome:
        scene = _box(12, 2)
        images = photographs(scene, 8)
        single, double = Fit(scene, images, Plan()), Fit(scene, images, Plan())
        with in_double(double):
            values64, gradient64 = _step(double)
        values, gradient = _step(single)
        off = max(abs(values[k] - values64[k]) / max(abs(values64[k]), 1e-12) for k in values)
        grad_error = float((gradient - gradient64).norm() / gradient64.norm())
        return Outcome(
            max(off, grad_error), 1e-2, f"losses differ by {off:.2g}, gradients by {grad_error:.2g} of their norm"
        )

    return Case("precision", "one step in float32", "the same step in float64: losses and gradients", measure)


@contextmanager
def in_double(fit: Fit) -> Iterator[None]:
    """Everything but the rays in float64: hits come from the same float32 tracer."""
    for module in (fit.materials, fit.radiance, fit.world):
        module.double()
    tracer, uniform, table = fit.world.tracer, Stream.uniform, directional.table
    fit.world.tracer = CountingTracer(_Rounded(tracer))
    primary = fit.training.views.primary
    primary.origin = primary.origin.double()
    fit.photos.photographs = fit.photos.photographs.double()
    Stream.uniform = lambda self, *shape: uniform(self, *shape).double()  # type: ignore[method-assign]
    directional.table = lambda *key, **lobe: table(*key, **lobe).double()  # type: ignore[assignment]
    try:
        yield
    finally:
        directional.table = table
        Stream.uniform = uniform  # type: ignore[method-assign]


class _Rounded:
    """A tracer that takes and returns float64 and traces in float32."""

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer

    def closest(self, rays: Rays) -> Hit:
        """The nearest hit of every ray."""
        hit = self.tracer.closest(replace(rays, o=rays.o.float(), d=rays.d.float()))
        return replace(hit, t=hit.t.double(), u=hit.u.double(), v=hit.v.double())

    def occluded(self, rays: Rays, t_max: Tensor) -> Tensor:
        """Whether something lies on the ray."""
        return self.tracer.occluded(replace(rays, o=rays.o.float(), d=rays.d.float()), t_max.float())


def _seeds(count: int) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = _box()
        images = photographs(scene, 32)
        plan = Plan(steps=60 if quick else 300)
        runs = 3 if quick else count
        errors = [Fit(scene, images, plan.with_seed(seed)).run().albedo_error()[0] for seed in range(runs)]
        psnr = -20.0 * np.log10(errors)
        return Outcome(
            float(np.ptp(psnr)), 3.0, f"albedo PSNR {psnr.mean():.2f} dB, standard deviation {psnr.std():.2f}"
        )

    return Case("precision", f"{count} seeds (quick: 3)", "spread of the albedo PSNR in dB, none diverges", measure)


def _long() -> Case:
    """Ten times the normal number of steps at a constant rate: the median of three seeds, as it has a spread of 0.2."""

    def measure(quick: bool) -> Outcome:
        scene = _box()
        images = photographs(scene, 1024)  # with 32 samples the error grows as the fit learns their noise
        ends, notes = [], []
        for seed in range(3):
            fit = Fit(scene, images, Plan(steps=300).with_seed(seed))
            marks = []
            for i in range(3000):
                fit.advance(0.3)
                if (i + 1) % 300 == 0:
                    marks.append(fit.albedo_error()[0])
            ends.append(marks[-1] / min(marks))
            notes.append(f"seed {seed}: " + " ".join(f"{m:.3f}" for m in marks))
        return Outcome(float(np.median(ends)), 1.5, "; ".join(notes))

    oracle = "last albedo error over the smallest"
    return Case("precision", "ten times the normal number of steps", oracle, measure, False)


def cases() -> list[Case]:
    """Formats, seeds, length."""
    return [_float64(), _seeds(10), _long()]
