"""Paths that know their number, and materials with parameters of their own for every path.

A backward pass gives the derivative of one number by many. Turned around with one copy of a scalar parameter for every
path, a single backward pass gives the derivative of every path's radiance by that scalar, for any method: paths share
nothing but the scene. So a gradient image costs no more than a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from neurad.core.errors import InputError
from neurad.core.records import Hit, Interaction, Rays, Surface
from neurad.integrators.world import World
from neurad.module.assemble import build_world
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials


@dataclass(frozen=True)
class PathRays(Rays):
    """Rays that know which path they belong to."""

    path: Tensor
    """Number of the path [n], int64."""


@dataclass(frozen=True)
class PathInteraction(Interaction):
    """A surface point that knows which path it belongs to."""

    path: Tensor
    """Number of the path [n], int64."""


class PathGeometry(Geometry):
    """Geometry that hands the number of a path on from rays to where they end, and to rays that go on from there."""

    def interact(self, rays: Rays, hit: Hit) -> Interaction:
        """The surface points [n] that rays ended at."""
        it = super().interact(rays, hit)
        if not isinstance(rays, PathRays):
            return it
        return PathInteraction(**{f.name: getattr(it, f.name) for f in fields(it)}, path=rays.path)

    def spawn(self, it: Interaction, wi: Tensor) -> Rays:
        """Rays from ``it`` in directions ``wi`` [n, 3]."""
        rays = super().spawn(it, wi)
        return PathRays(rays.o, rays.d, it.path) if isinstance(it, PathInteraction) else rays


class UniformMaterials(nn.Module):
    """The scene's own albedo, and one roughness everywhere.

    Args:
        base: gives the albedo.
        roughness: of all surfaces.
    """

    def __init__(self, base: TrueMaterials, roughness: float) -> None:
        super().__init__()
        self.base = base
        self.start = roughness

    def albedo(self, it: Interaction) -> Tensor:
        """Base colour [n, 3]."""
        return self.base.albedo(it)

    def forward(self, it: Interaction) -> Surface:
        """BSDF parameters at the lanes of ``it``."""
        albedo = self.albedo(it)
        return Surface(albedo, torch.full_like(albedo[:, :1], self.start))


class PathMaterials(UniformMaterials):
    """:class:`UniformMaterials` with a roughness and an offset of the albedo for every path, both parameters.

    Args:
        base: gives the albedo.
        roughness: of all surfaces.
        paths: how many there are.
    """

    def __init__(self, base: TrueMaterials, roughness: float, paths: int) -> None:
        super().__init__(base, roughness)
        self.roughness = nn.Parameter(torch.full((paths,), roughness))
        self.offset = nn.Parameter(torch.zeros(paths))

    def albedo(self, it: Interaction) -> Tensor:
        """Base colour [n, 3], the same as without parameters, with a derivative by the path's offset."""
        assert isinstance(it, PathInteraction)
        return super().albedo(it) + self.offset.index_select(0, it.path).unsqueeze(-1)

    def forward(self, it: Interaction) -> Surface:
        """BSDF parameters at the lanes of ``it``, differentiable in those of their path."""
        assert isinstance(it, PathInteraction)
        return Surface(self.albedo(it), self.roughness.index_select(0, it.path).unsqueeze(-1))


def build_path_world(scene: Scene, tracer: str) -> World:
    """The world of a scene whose interactions know their path.

    Raises:
        InputError: the scene has smooth surfaces, on which the numbers would get lost.
    """
    if scene.features.has_delta:
        raise InputError(f"scene {scene.name}: it has smooth surfaces, which this benchmark does not follow")
    world = build_world(scene, tracer)
    world.geometry = PathGeometry(scene)
    return world
