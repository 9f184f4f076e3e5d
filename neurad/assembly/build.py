"""The parts of a run, built from what its scene has; what a scene does not need is not built."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import Tensor, nn

from neurad.assembly.lighting import (
    fitted_environment,
    lamps_of_scene,
    recovered_lamps,
    unknown_environment,
    unknown_lamps,
)
from neurad.assembly.region import Region, training_region
from neurad.assembly.resolution import finest_cells, resolve_finest
from neurad.assembly.settings import ModelSettings
from neurad.bsdf.table import make_bsdf
from neurad.core.protocols import Emitter, Field
from neurad.core.records import Surface, SurfaceInteraction
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.emitters.lights import Lights, WithPunctual, make_lights
from neurad.fields.development import FittedDevelopment
from neurad.fields.material import CORRECTION_CELLS, CORRECTION_FACTOR, AlbedoField, Correction, RoughnessField
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import FieldConfig, RadianceConfig, RoughnessConfig
from neurad.integrators.delta import DeltaSurfaces
from neurad.integrators.estimator import Estimator
from neurad.integrators.focus import Focus
from neurad.integrators.guide import Guide
from neurad.integrators.method import Method
from neurad.integrators.world import World
from neurad.optim.polyak_average import PolyakAverage
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import OnEmitters, TrueMaterials
from neurad.tracing.counting import CountingTracer
from neurad.tracing.select import make_tracer


def build_world(
    scene: Scene,
    tracer: str = "embree",
    hide_environment: bool = False,
    fitted: FittedEnvironment | None = None,
    specular_fraction: float = 0.5,
    lights: Emitter | None = None,
) -> World:
    """Geometry, tracer, lights and BSDF of a scene, on the CPU (``.to(device)`` moves them).

    Args:
        scene: a checked scene.
        tracer: 'embree', 'open3d' or 'warp'.
        hide_environment: camera rays that miss see black, as in photographs whose alpha is below 1 there.
        fitted: an environment to be recovered, in place of the scene's own.
        specular_fraction: fraction of the BSDF samples that the specular lobe draws.
        lights: in place of all of the scene's.

    Raises:
        InputError: the scene has no light, unknown tracer, or its package is missing.
    """
    geometry = Geometry(scene)
    two_sided = torch.tensor([m.two_sided for m in scene.materials])[geometry.material]
    return World(
        geometry=geometry,
        tracer=CountingTracer(make_tracer(tracer, geometry.vertices, geometry.faces)),
        lights=make_lights(scene, geometry, fitted) if lights is None else lights,
        bsdf=make_bsdf(scene.features, specular_fraction),
        features=scene.features,
        two_sided=two_sided,
        hide_environment=hide_environment,
        delta=DeltaSurfaces(scene, geometry) if scene.features.has_delta else None,
    )


def adapt(world: World, region: Region) -> None:
    """Choose between kinds of lights by what the region gets of them, not by what lies around it."""
    if region.contracted and isinstance(world.lights, Lights | WithPunctual):
        world.lights.radius = region.radius


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
        self.known_meshes: frozenset[int] = frozenset()
        """Meshes on which the scene's own values hold, see :func:`know_lamps`."""

    def forward(self, si: SurfaceInteraction) -> Surface:
        """BSDF parameters at the lanes of ``si``."""
        albedo = self.albedo(si)
        if self.roughness is None:  # not read: one number for all lanes
            return Surface(albedo, albedo.new_ones(1, 1).expand(len(albedo), 1))
        roughness: Tensor = self.roughness(si, albedo)
        return Surface(albedo, roughness)

    def to_unit_cube(self, p: Tensor) -> Tensor:
        """Positions [n, 3] in the scene's frame, on any device, to the unit cube that the fields span [n, 3]."""
        cube: nn.Module = self.albedo.cube  # type: ignore[attr-defined]
        inside: Tensor = cube(p.to(next(iter(cube.buffers())).device))
        return inside

    def albedo_at(self, p: Tensor) -> Tensor:
        """Albedo [n, 3] at positions [n, 3] in the scene's frame, on any device."""
        found: Tensor = self.albedo.at(p.to(next(iter(self.albedo.parameters())).device))  # type: ignore[attr-defined]
        return found

    def roughness_at(self, p: Tensor) -> Tensor:
        """Roughness [n, 1] at such positions; 1 in a Lambertian scene."""
        albedo = self.albedo_at(p)
        return torch.ones_like(albedo[:, :1]) if self.roughness is None else self.roughness.at(p.to(albedo), albedo)


def build_materials(
    scene: Scene,
    albedo: FieldConfig,
    roughness: FieldConfig,
    geometry: Geometry | None = None,
    region: Region | None = None,
) -> FittedMaterials:
    """Fields for albedo and, where the scene is not Lambertian, roughness.

    With the scene's ``geometry`` emitting surfaces keep the albedo and roughness of the scene file: these are part of
    the light, and photographs do not show them. They are shaded by the fitted model (principled, or diffuse in a
    Lambertian scene) like every recovered surface, whatever model the file gives them. The grids span ``region``, by
    default all triangles.
    """
    region = region or Region(scene.bounds)
    bounds, cells = torch.from_numpy(region.bounds), region.cells(CORRECTION_CELLS, CORRECTION_FACTOR)
    materials = FittedMaterials(
        AlbedoField(region.stretched(albedo), bounds, contracted=region.contracted),
        None
        if scene.features.is_diffuse
        else RoughnessField(region.stretched(roughness), bounds, None, region.contracted, cells),
    )
    if geometry is not None:
        know_lamps(materials, scene, geometry)
    return materials


def know_lamps(
    materials: FittedMaterials, scene: Scene, geometry: Geometry, meshes: frozenset[int] = frozenset()
) -> None:
    """Let emitting surfaces have the albedo and roughness of the scene file.

    Args:
        materials: whose fields are read elsewhere.
        scene: with the lamps.
        geometry: of the scene.
        meshes: further meshes that are known: those that shone while the fields were fitted, and photographs did not
            show what they reflect.
    """
    if scene.features.has_area_lights or meshes:
        textures = ([m.albedo for m in scene.materials], 3), ([m.roughness for m in scene.materials], 1)
        for part, texture in zip((materials.albedo, materials.roughness), textures, strict=True):
            if isinstance(part, AlbedoField | RoughnessField):
                part.known = OnEmitters(*texture, geometry, meshes).to(geometry.vertices.device)
    materials.known_meshes = meshes | set(lamps_of_scene(scene))


def build_radiance(scene: Scene, config: RadianceConfig, region: Region | None = None) -> RadianceField:
    """The radiance field, its units still those of the scene: set ``scale`` once the photographs are known. Its grid
    spans ``region``, by default all triangles.
    """
    region = region or Region(scene.bounds)
    config = region.stretched(config.resolved(scene.features.is_diffuse))
    return RadianceField(config, torch.from_numpy(region.bounds), contracted=region.contracted)


def make_guide(scene: Scene, cells: int, method: Method, region: Region) -> Guide | None:
    """A guide with ``cells`` cells along the longest side of the region; what lies outside shares its outermost cells.

    None for 0 cells, for a method whose samples come without the radiance that arrived, and for a diffuse scene.
    """
    if cells == 0 or not method.estimates_Li or scene.features.is_diffuse:
        return None
    return Guide(torch.from_numpy(region.bounds), cells)


def make_focus(scene: Scene, fraction: float, materials: FittedMaterials | TrueMaterials) -> Focus | None:
    """What draws a fraction of the pixels where they tell of roughness; None where there is none to recover."""
    recovers = isinstance(materials, FittedMaterials) and materials.roughness is not None
    return Focus([view.camera for view in scene.train], fraction) if recovers and fraction > 0 else None


@dataclass(frozen=True)
class Assembly:
    """The parts of one run: what is trained, and the scene that it is trained in."""

    scene: Scene
    settings: ModelSettings
    world: World
    materials: FittedMaterials | TrueMaterials
    radiance: RadianceField | None
    """None for a method that reads none."""
    average: PolyakAverage | None
    """Averages of the materials' parameters; None where they are known or no average is wanted."""
    region: Region
    """What the grids of fields and guide resolve."""
    focus: Focus | None = None
    """By which a fraction of the pixels is drawn; None where all are drawn in turn."""
    development: FittedDevelopment | None = None
    """How the photographs were taken, as far as it is recovered; None where it is known."""

    @property
    def environment(self) -> FittedEnvironment | None:
        """The environment that is recovered; None where it is known."""
        return fitted_environment(self.world)

    @property
    def lamps(self) -> FittedLamps | None:
        """The lamps whose radiance the photographs say; None where it is known."""
        return recovered_lamps(self.world)

    @property
    def correction(self) -> Correction | None:
        """What a closing step adds to the roughness; None in a run that makes none."""
        if self.radiance is None or not isinstance(self.materials, FittedMaterials) or self.materials.roughness is None:
            return None
        return self.materials.roughness.correction

    @property
    def estimator(self) -> Estimator:
        """The method's estimates with these materials and this radiance field."""
        return Estimator(self.world, self.materials, self.radiance, self.settings.method)

    def modules(self) -> Iterator[tuple[str, nn.Module]]:
        """The modules with parameters or state, by the names that they have in a checkpoint."""
        for name in ("world", "materials", "average", "radiance", "focus", "development"):
            part = getattr(self, name)
            if isinstance(part, nn.Module):
                yield name, part


def assemble(
    scene: Scene,
    settings: ModelSettings,
    hide_environment: bool = False,
    device: torch.device | str = "cpu",
    known_emitters: bool = True,
) -> Assembly:
    """Build world, materials and, for a method that reads it, the radiance field, all on the CPU.

    Seeds torch's generator with the run's seed, from which the fields are initialised.

    Args:
        scene: a checked scene.
        settings: of the model.
        hide_environment: as in :func:`build_world`.
        device: where the camera rays are traced that decide how fine a grid must be.
        known_emitters: emitting surfaces keep the albedo and roughness of the scene file, shaded by the fitted model;
            False fits those, too, which only a scene whose every surface emits needs.
    """
    torch.manual_seed(settings.seed)
    sampling, optimization = settings.sampling, settings.optimization
    environment = unknown_environment(scene, settings.lighting)
    world = build_world(scene, settings.tracer, hide_environment, environment, sampling.specular_fraction)
    lamps = unknown_lamps(scene, world.geometry, settings.lighting)
    if lamps is not None:
        world.lights = make_lights(scene, world.geometry, environment, lamps)
    region = training_region(world, scene, device)
    adapt(world, region)
    world.guide = make_guide(scene, sampling.guide, settings.method, region)
    # Not counted: these rays train nothing.
    cells = cache(partial(finest_cells, world.tracer.tracer, scene, device, region))
    materials: FittedMaterials | TrueMaterials
    average = None
    if settings.materials == "known":
        materials = TrueMaterials(scene, world.geometry)
    else:
        albedo, roughness = resolve_finest(settings.albedo, cells), resolve_finest(settings.roughness, cells)
        if isinstance(roughness, RoughnessConfig) and (environment is not None or not settings.method.needs_field):
            roughness = replace(roughness, closing_step=False)  # residuals are then not those of materials alone
        materials = build_materials(scene, albedo, roughness, world.geometry if known_emitters else None, region)
        if optimization.average > 0:
            average = PolyakAverage(materials, optimization.average)
    needs_field = settings.method.needs_field
    radiance = build_radiance(scene, resolve_finest(settings.radiance, cells), region) if needs_field else None
    return Assembly(
        scene, settings, world, materials, radiance, average, region, make_focus(scene, sampling.focus, materials),
        FittedDevelopment.of(scene.train, scene.photography),
    )  # fmt: skip
