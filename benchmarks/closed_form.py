"""Closed diffuse rooms: their light in closed form, and the integrating sphere with every method's derivative."""

import math

import torch

from neurad.assembly.build import build_world
from neurad.core.records import SurfaceInteraction
from neurad.core.rng import Stream, mix
from neurad.integrators.debiased import Debiased
from neurad.integrators.method import Method, SceneModel
from neurad.integrators.path import PathTracing
from neurad.integrators.radiometric import Radiometric
from neurad.integrators.vertex import DIMENSIONS
from neurad.scene.builtin import build_sphere
from neurad.scene.geometry import Geometry
from neurad.scene.textures import ConstantMaterials

BATCHES = 16
"""Of paths, by whose spread a standard error is known."""


def emitted(geometry: Geometry) -> float:
    """Radiance of the red channel that surfaces send out by themselves, in the mean over their area."""
    area = geometry.face_area.double()
    return float((area * geometry.emission[:, 0].double()).sum() / area.sum())


def reflected_radiance(geometry: Geometry, albedo: float) -> float:
    """Mean reflected light of a closed room of one albedo: ``E rho / (1 - rho)`` with :func:`emitted` ``E``."""
    return emitted(geometry) * albedo / (1.0 - albedo)


class Sphere:
    """Mean reflected light of a closed diffuse sphere: ``E a rho / (1 - rho)``, its derivative ``E a / (1 - rho)^2``,
    ``a`` the emitting patch's fraction of the area.

    Points are drawn evenly over the area: in a closed convex diffuse room light that starts so stays so at every
    bounce, on facets too, which makes the closed form exact for their mean.

    Args:
        albedo: rho.
        tracer: name of the ray caster.
        factor: error of the radiance field that methods read; 1 is the true, constant one.
    """

    def __init__(self, albedo: float, tracer: str, factor: float = 1.0) -> None:
        self.albedo, self.factor = albedo, factor
        self.world = build_world(build_sphere(albedo, subdivisions=3), tracer)
        self.value = torch.nn.Parameter(torch.tensor(albedo))
        self.materials = ConstantMaterials(self.value)
        geometry = self.world.geometry
        area = geometry.face_area.double()
        self.light = emitted(geometry)
        self.derivative = self.light / (1.0 - albedo) ** 2
        field = factor * reflected_radiance(geometry, albedo)
        self.parts = SceneModel(self.world, self.materials, lambda si, albedo: torch.full_like(albedo, field))
        self.until = (area.cumsum(0) / area.sum()).float()

    def _points(self, n: int, stream: Stream) -> SurfaceInteraction:
        geometry = self.world.geometry
        prim = torch.searchsorted(self.until, stream.uniform(n)).clamp_max(len(self.until) - 1)
        root, other = stream.uniform(n).sqrt(), stream.uniform(n)
        valid = torch.ones(n, dtype=torch.bool)
        return geometry.interact_at(prim, root * (1.0 - other), root * other, geometry.face_normal[prim], valid)

    def gradient_fraction(self, method: Method, paths: int) -> tuple[float, float]:
        """Fraction of the true derivative that ``method`` finds, and its standard error."""
        found = []
        for index in range(BATCHES):
            stream = Stream(mix(19, round(1000 * self.albedo)), index)
            si = self._points(-(-paths // BATCHES), stream)
            u = stream.uniform(len(si), DIMENSIONS)
            value = method.reflected(self.parts, si, self.materials(si), u, stream).value.mean()
            (grad,) = torch.autograd.grad(value, [self.value])
            found.append(grad.double() / self.derivative)
        fractions = torch.stack(found)
        return float(fractions.mean()), float(fractions.std()) / math.sqrt(BATCHES)

    def predicted(self, method: Method) -> float:
        """That fraction in closed form: 1 - rho^k after k bounces that end in the true field, 1 without truncation."""
        rho = self.albedo
        if isinstance(method, Radiometric):
            k = method.k
            return 1.0 - rho**k + (self.factor - 1.0) * k * rho**k * (1.0 - rho)
        if isinstance(method, PathTracing) and method.max_depth is not None:
            n = method.max_depth - 1
            return 1.0 - (n + 1) * rho**n + n * rho ** (n + 1)
        assert isinstance(method, PathTracing | Debiased)
        return 1.0
