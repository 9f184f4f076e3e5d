"""Gradient images of any method at one roughness of a scene, and their bias against a reference."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from benchmarks.bench.per_path import PathMaterials, PathRays, UniformMaterials
from neurad.core.camera import camera_rays
from neurad.core.protocols import Materials
from neurad.core.records import Camera, FloatArray, IntArray, SurfaceInteraction
from neurad.core.rng import Stream, mix
from neurad.integrators.film import pixel_positions, render
from neurad.integrators.method import Method, SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.renderer import path_tracer
from neurad.integrators.vertex import DIMENSIONS
from neurad.integrators.world import World
from neurad.scene.textures import TrueMaterials

LANES = 1 << 14
"""Paths that are traced at once."""


class PathField:
    """A radiance field without any error in the mean: a new path from every point at which it is queried.

    Every method is linear in its field and takes no gradient through it, so the mean of values and derivatives is that
    with the true radiance. The bias that remains is the method's, not a network's.

    Args:
        world: the scene.
        materials: what its surfaces are made of.
        stream: random numbers.
        factor: multiplies the radiance, to give the field a known error.
    """

    def __init__(self, world: World, materials: Materials, stream: Stream, factor: float = 1.0) -> None:
        self.parts, self.stream, self.factor = SceneModel(world, materials), stream, factor
        self.path = PathTracing(None)

    @torch.no_grad()
    def __call__(self, si: SurfaceInteraction, albedo: Tensor) -> Tensor:
        """Reflected radiance towards ``si.wo`` [n, 3], one sample."""
        u = self.stream.uniform(len(si), DIMENSIONS)
        return self.factor * self.path.reflected(self.parts, si, self.parts.materials(si), u, self.stream).value


@dataclass(frozen=True)
class Gradients:
    """Independent estimates of a picture and its derivatives, grey (means over the channels)."""

    image: FloatArray
    """[batches, pixels]."""
    roughness: FloatArray
    """Derivative of every pixel by the roughness of all surfaces [batches, pixels]."""
    albedo: FloatArray
    """Derivative of every pixel by an offset of all albedos [batches, pixels]."""
    seconds: float
    """Time that all of it took."""


@dataclass(frozen=True)
class Study:
    """One view of a scene, and how it is sampled."""

    world: World
    base: TrueMaterials
    camera: Camera
    spp: int
    """Paths a pixel in a batch."""
    factor: float = 1.0
    """Factor by which the radiance field that methods query is wrong: 1 is exact."""

    def gradients(self, method: Method, roughness: float, batches: int) -> Gradients:
        """Estimates of ``method`` with all surfaces at ``roughness``. Batch i has the same random numbers for every
        method, so that differences between methods have little noise.
        """
        begin = time.perf_counter()
        found = [self._batch(method, roughness, index) for index in range(batches)]
        rows = [np.stack(part) for part in zip(*found, strict=True)]
        return Gradients(rows[0], rows[1], rows[2], time.perf_counter() - begin)

    def _batch(self, method: Method, roughness: float, index: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        width, count = self.camera.width, self.camera.width * self.camera.height
        rows = max(1, LANES // self.spp)
        parts = []
        for begin in range(0, count, rows):
            stream = Stream(11, index, begin)
            pixels = torch.arange(begin, min(begin + rows, count))
            camera = camera_rays(self.camera, pixel_positions(width, pixels, self.spp, stream).view(-1, 2))
            paths = len(camera)
            rays = PathRays(camera.o, camera.d, torch.arange(paths))
            materials = PathMaterials(self.base, roughness, paths)
            field = PathField(self.world, materials, Stream(13, index, begin), self.factor)
            si = self.world.intersect(rays)
            u = stream.uniform(paths, DIMENSIONS)
            scene = SceneModel(self.world, materials, field if method.needs_field else None)
            value = method.reflected(scene, si, materials(si), u, stream).value
            grey = (self.world.emitted(si) + value).mean(-1)
            grads = torch.autograd.grad(grey.sum(), [materials.roughness, materials.offset])
            parts.append([x.view(len(pixels), self.spp).mean(1) for x in (grey.detach(), *grads)])
        image, by_roughness, by_albedo = (torch.cat(part).double().numpy() for part in zip(*parts, strict=True))
        return image, by_roughness, by_albedo

    def picture(self, roughness: float, spp: int) -> FloatArray:
        """An independent grey picture with all surfaces at ``roughness`` [pixels], without a cap of path length."""
        tracer = path_tracer(self.world, UniformMaterials(self.base, roughness), max_depth=None, rr_depth=6)
        image = render(self.camera, tracer, spp, mix(17, round(1000 * roughness)))
        grey: FloatArray = image.mean(-1).flatten().double().numpy()
        return grey


# ---- statistics


def jackknife(f: Callable[[IntArray], float], batches: int) -> tuple[float, float]:
    """A statistic of independent batches and its standard error.

    Args:
        f: takes the indices of the batches to use [n], int64.
        batches: how many there are, at least 3.
    """
    every = np.arange(batches)
    parts = np.array([f(np.delete(every, i)) for i in every])
    return f(every), math.sqrt((batches - 1) / batches * float(((parts - parts.mean()) ** 2).sum()))


def product(x: FloatArray, y: FloatArray) -> float:
    """Unbiased mean over pixels of the product of two expectations, which the batches [n, pixels] estimate with noise:
    the two factors always come from different batches.
    """
    n = len(x)
    return float(((x.sum(0) * y.sum(0) - (x * y).sum(0)) / (n * (n - 1))).mean())


def loss_gradient(image: FloatArray, grad: FloatArray, target: FloatArray) -> float:
    """Unbiased derivative of the mean squared difference to ``target`` [pixels], from batches [n, pixels]: residual and
    derivative always come from different ones.
    """
    return 2.0 * product(image - target, grad)


def image_bias(grad: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Relative bias of a gradient image, ``<grad, reference> / <reference, reference> - 1``, and its standard error: at
    -0.8 four fifths of the gradient are missing. Means over pixels would cancel where signs differ.

    Args:
        grad: batches of a method [n, pixels].
        reference: of the reference [m, pixels]; its first n batches are paired with those of the method.
    """
    n, whole = len(grad), product(reference, reference)
    paired = reference[:n]
    return jackknife(lambda i: product(grad[i] - paired[i], paired[i]) / whole, n)


def pixel_bias(grad: FloatArray, reference: FloatArray) -> float:
    """Root mean square over pixels of the gradient image's bias, relative to the reference image; noise drops out."""
    difference = grad - reference[: len(grad)]
    return math.sqrt(max(0.0, product(difference, difference)) / max(product(reference, reference), 1e-300))


def noise(grad: FloatArray, reference: FloatArray) -> float:
    """Root mean square over pixels of the gradient image's standard error, relative to that of the reference image."""
    variance = float(grad.var(0, ddof=1).mean()) / len(grad)
    return math.sqrt(variance / max(product(reference, reference), 1e-300))


def loss_bias(method: Gradients, reference: Gradients | None, target: FloatArray, unit: float) -> tuple[float, float]:
    """Bias of the loss's derivative by roughness (itself without a reference) over ``unit``, and its standard error."""

    def difference(i: IntArray) -> float:
        own = loss_gradient(method.image[i], method.roughness[i], target)
        if reference is None:
            return own / unit
        return (own - loss_gradient(reference.image[i], reference.roughness[i], target)) / unit

    return jackknife(difference, len(method.image))
