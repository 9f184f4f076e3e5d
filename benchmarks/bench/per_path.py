"""Paths that carry their index, and materials with separate parameters for every path.

A backward pass gives the derivatives of one number by many parameters. With one copy of a scalar parameter for every
path, a single backward pass of the sum over paths gives the derivative of every path's radiance by that scalar, for any
method: paths share nothing but the scene. A gradient image then costs no more than a gradient.
"""

from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from neurad.assembly.build import build_world
from neurad.core.errors import InputError
from neurad.core.records import Hit, Rays, Surface, SurfaceInteraction
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials


@dataclass(frozen=True)
class PathRays(Rays):
    """Rays with the index of the path that they belong to."""

    path: Tensor
    """Index of the path [n], int64."""


@dataclass(frozen=True)
class PathInteraction(SurfaceInteraction):
    """Surface points with the index of the path that they belong to."""

    path: Tensor
    """Index of the path [n], int64."""


class PathGeometry(Geometry):
    """Geometry that copies the path index from rays to their hits, and from there to the rays spawned."""

    def interact(self, rays: Rays, hit: Hit) -> SurfaceInteraction:
        """The surface points [n] that rays ended at."""
        si = super().interact(rays, hit)
        if not isinstance(rays, PathRays):
            return si
        return PathInteraction(**{f.name: getattr(si, f.name) for f in fields(si)}, path=rays.path)

    def spawn(self, si: SurfaceInteraction, wi: Tensor) -> Rays:
        """Rays from ``si`` in directions ``wi`` [n, 3]."""
        rays = super().spawn(si, wi)
        return PathRays(rays.o, rays.d, si.path) if isinstance(si, PathInteraction) else rays


class UniformMaterials(nn.Module):
    """The scene's own albedo, and one roughness everywhere.

    Args:
        base: gives the albedo.
        roughness: of all surfaces.
    """

    def __init__(self, base: TrueMaterials, roughness: float) -> None:
        super().__init__()
        self.base = base
        self.value = roughness

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """Base colour [n, 3]."""
        return self.base.albedo(si)

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        albedo = self.albedo(si)
        return Surface(albedo, torch.full_like(albedo[:, :1], self.value))


class PathMaterials(UniformMaterials):
    """:class:`UniformMaterials` with a roughness and an offset of the albedo for every path, both parameters.

    Args:
        base: gives the albedo.
        roughness: of all surfaces.
        paths: number of paths.
    """

    def __init__(self, base: TrueMaterials, roughness: float, paths: int) -> None:
        super().__init__(base, roughness)
        self.roughness = nn.Parameter(torch.full((paths,), roughness))
        self.offset = nn.Parameter(torch.zeros(paths))

    def albedo(self, si: SurfaceInteraction) -> Tensor:
        """Base colour [n, 3], the same as without parameters, with a derivative by the path's offset."""
        assert isinstance(si, PathInteraction)
        return super().albedo(si) + self.offset.index_select(0, si.path).unsqueeze(-1)

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``, differentiable in those of their path."""
        assert isinstance(si, PathInteraction)
        return Surface(self.albedo(si), self.roughness.index_select(0, si.path).unsqueeze(-1))


def build_path_world(scene: Scene, tracer: str) -> World:
    """The world of a scene whose interactions carry their path index.

    Raises:
        InputError: the scene has smooth surfaces, where the path index would be lost.
    """
    if scene.features.has_delta:
        raise InputError(f"scene {scene.name}: it has smooth surfaces, which this benchmark does not follow")
    world = build_world(scene, tracer)
    world.geometry = PathGeometry(scene)
    return world
