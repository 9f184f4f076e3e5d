"""Planted NaN and Inf: each must stop the run with the right message."""

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.stress.case import Case, Outcome
from benchmarks.stress.fit import Fit, photographs, resized
from benchmarks.stress.parts import glossy
from benchmarks.stress.runs import fit
from benchmarks.stress.scenes import small_cube
from neurad.core.errors import InputError
from neurad.core.records import PixelBatch
from neurad.images.image_io import write_exr
from neurad.images.photographs import read_photograph
from neurad.integrators import vertex_diffuse, vertex_principled_kernels
from neurad.training.inverse import InverseRenderer


def _texel() -> Case:
    def measure(quick: bool) -> Outcome:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "photograph.exr"
            pixels = np.ones((4, 4, 3), np.float32)
            pixels[1, 2, 0] = np.nan
            write_exr(path, pixels)
            try:
                read_photograph(str(path))
            except InputError as error:
                return Outcome(float("photograph.exr" not in str(error)), 0.0, str(error).replace(folder + "/", ""))
        return Outcome(1.0, 0.0, "it was read")

    return Case("guard", "a NaN texel in a photograph", "refused with a sentence that names the file", measure)


def _planted(what: str, words: str, spoil: Callable[[InverseRenderer], None], diffuse: bool = True) -> Case:
    def measure(quick: bool) -> Outcome:
        scene = resized(small_cube(8), 8, 2)
        scene = scene if diffuse else glossy(scene)
        images = photographs(scene, 4)
        step, resolve_diffuse, resolve_principled = (
            InverseRenderer.training_step,
            vertex_diffuse.resolve_hits_diffuse,
            vertex_principled_kernels.resolve_hits_principled,
        )

        def spoilt(self: InverseRenderer, batch: PixelBatch, batch_idx: int) -> Tensor:
            if self.iteration == 2:
                with torch.no_grad():
                    spoil(self)
            return step(self, batch, batch_idx)

        InverseRenderer.training_step = spoilt  # type: ignore[method-assign]
        try:
            fit(scene, images, steps=4)
        except InputError as error:
            text = str(error)
            return Outcome(float("iteration 2" not in text or words not in text), 0.0, text)
        finally:
            InverseRenderer.training_step = step  # type: ignore[method-assign]
            vertex_diffuse.resolve_hits_diffuse = resolve_diffuse
            vertex_principled_kernels.resolve_hits_principled = resolve_principled
        return Outcome(1.0, 0.0, "the run went on")

    return Case("guard", what, f"stops and says: {words}", measure)


def _weight(module: InverseRenderer) -> None:
    assert module.assembly.radiance is not None
    next(module.assembly.radiance.mlp.parameters())[0, 0] = math.nan


def _sample(module: InverseRenderer) -> None:
    original = vertex_principled_kernels.resolve_hits_principled

    def broken(*arrays: Any) -> None:
        original(*arrays)
        direct = arrays[-1].value[0]
        direct[direct > 0] = math.inf

    vertex_principled_kernels.resolve_hits_principled = broken  # type: ignore[assignment]


def _diffuse_sample(module: InverseRenderer) -> None:
    original = vertex_diffuse.resolve_hits_diffuse

    def broken(*arrays: Any) -> None:
        original(*arrays)
        direct = arrays[-2]
        direct[direct > 0] = math.inf

    vertex_diffuse.resolve_hits_diffuse = broken  # type: ignore[assignment]


def _cost() -> Case:
    """Time of the checks of a step."""

    def measure(quick: bool) -> Outcome:
        import statistics
        import time

        scene = resized(small_cube(12), 12, 2)
        made = Fit(scene, photographs(scene, 4))
        step, source = made.training.step, made.photos
        made.advance(0.0)
        spent: tuple[list[float], list[float]] = ([], [])
        for i in range(1, 60):
            begin = time.process_time()
            made.advance(0.0)
            spent[0].append(time.process_time() - begin)
            batch = source.batch(i)
            terms = step.terms(batch).all
            begin = time.process_time()
            step.guard.check(i, batch, terms, lambda: None)
            spent[1].append(time.process_time() - begin)
        whole, check = (1e3 * statistics.median(times) for times in spent)
        return Outcome(check / whole, 0.05, f"{check:.3f} of {whole:.2f} ms a step, medians of processor time")

    return Case("guard", "cost of the checks", "fraction of a step", measure)


def cases() -> list[Case]:
    """What is planted."""
    bad = "returned is not finite"
    return [
        _texel(),
        _planted("a NaN weight", "the weight radiance.mlp.layers.0.weight is not finite", _weight),
        _planted(
            "an infinite sample of a light",
            f"integrators.vertex_principled._resolve_hits.values {bad}",
            _sample,
            False,
        ),
        _planted(
            "an infinite sample, Lambertian",
            f"integrators.vertex_diffuse.bounce_diffuse.direct_demodulated {bad}",
            _diffuse_sample,
        ),
        _cost(),
    ]
