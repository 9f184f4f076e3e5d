"""Puts the parts of a run together from what its scene has; what a scene does not need is not built."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from neurad.bsdf.table import make_bsdf
from neurad.core.protocols import Field
from neurad.core.records import Surface, SurfaceInteraction
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.lights import make_lights
from neurad.fields.material import AlbedoField, RoughnessField
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import FieldConfig, RadianceConfig
from neurad.integrators.delta import DeltaSurfaces
from neurad.integrators.world import World
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import OnEmitters
from neurad.tracing.counting import CountingTracer
from neurad.tracing.select import make_tracer


def build_world(
    scene: Scene,
    tracer: str = "embree",
    hide_environment: bool = False,
    fitted: FittedEnvironment | None = None,
    specular_fraction: float = 0.5,
) -> World:
    """Geometry, tracer, lights and BSDF of a scene, on the CPU (``.to(device)`` moves them).

    Args:
        scene: a checked scene.
        tracer: 'embree', 'open3d' or 'warp'.
        hide_environment: camera rays that miss see black (photographs with an alpha channel).
        fitted: an environment to be recovered, in place of the scene's own.
        specular_fraction: share of the BSDF samples that the specular lobe draws.

    Raises:
        InputError: unknown tracer, or its package is missing.
    """
    geometry = Geometry(scene)
    two_sided = torch.tensor([m.two_sided for m in scene.materials])[geometry.material]
    return World(
        geometry=geometry,
        tracer=CountingTracer(make_tracer(tracer, geometry.vertices, geometry.faces)),
        lights=make_lights(scene, geometry, fitted),
        bsdf=make_bsdf(scene.features, specular_fraction),
        features=scene.features,
        two_sided=two_sided,
        hide_environment=hide_environment,
        delta=DeltaSurfaces(scene, geometry) if scene.features.has_delta else None,
    )


class FittedMaterials(nn.Module):
    """Materials read from fields.

    Args:
        albedo: field with three channels in [0, 1].
        roughness: field with one channel, or None for a Lambertian scene, which has no roughness to find.
    """

    def __init__(self, albedo: Field, roughness: RoughnessField | None) -> None:
        super().__init__()
        self.albedo = albedo
        self.roughness = roughness

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        albedo = self.albedo(si)
        if self.roughness is None:  # nobody reads it: one number seen everywhere
            return Surface(albedo, albedo.new_ones(1, 1).expand(len(albedo), 1))
        roughness: Tensor = self.roughness(si, albedo)
        return Surface(albedo, roughness)


def build_materials(
    scene: Scene, albedo: FieldConfig, roughness: FieldConfig, geometry: Geometry | None = None
) -> FittedMaterials:
    """Fields for albedo and, where the scene is not Lambertian, roughness.

    With the scene's ``geometry`` the materials of emitting surfaces are the scene's own: they are part of the light,
    and photographs do not tell them.
    """
    bounds = torch.from_numpy(scene.bounds)
    on_lamps: list[OnEmitters | None] = [None, None]
    if geometry is not None and scene.features.has_area_lights:
        textures = ([m.albedo for m in scene.materials], 3), ([m.roughness for m in scene.materials], 1)
        on_lamps = [OnEmitters(*texture, geometry) for texture in textures]
    return FittedMaterials(
        AlbedoField(albedo, bounds, on_lamps[0]),
        None if scene.features.is_diffuse else RoughnessField(roughness, bounds, on_lamps[1]),
    )


def build_radiance(scene: Scene, config: RadianceConfig) -> RadianceField:
    """The radiance field, its units still those of the scene: set ``scale`` once the photographs are known."""
    return RadianceField(config.resolved(scene.features.is_diffuse), torch.from_numpy(scene.bounds))
