"""The parts of a run, built from what its scene has; what a scene does not need is not built."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, partial

import torch
from torch import nn

from neurad.assembly.fitted_materials import FittedMaterials, build_materials
from neurad.assembly.lighting import (
    draw_by_openings,
    fitted_environment,
    recovered_lamps,
    unknown_environment,
    unknown_lamps,
)
from neurad.assembly.model_settings import ModelSettings
from neurad.assembly.region import Region, finest_cells, resolve_finest, training_paths, training_region
from neurad.bsdf.table import make_bsdf
from neurad.core.errors import InputError
from neurad.core.parameters import METALLIC, ROUGHNESS, SurfaceParameter, recovered
from neurad.core.protocols import Emitter
from neurad.core.reflection import PrincipledModel, ReflectionModel
from neurad.core.scene_records import DIELECTRIC
from neurad.emitters.fitted import FittedEnvironment
from neurad.emitters.fitted_lamps import FittedLamps
from neurad.emitters.lights import Lights, make_lights
from neurad.emitters.punctual import FlashLight
from neurad.fields.development import FittedDevelopment
from neurad.fields.hierarchy import Hierarchy
from neurad.fields.metalness import Metalness
from neurad.fields.radiance import RadianceField
from neurad.fields.settings import RadianceConfig
from neurad.integrators.delta import DeltaSurfaces
from neurad.integrators.estimator import Estimator
from neurad.integrators.focus import PixelImportance
from neurad.integrators.guide import Guide
from neurad.integrators.method import Method
from neurad.integrators.world import World
from neurad.optim.polyak_average import PolyakAverage
from neurad.scene.description import Scene
from neurad.scene.geometry import Geometry
from neurad.scene.textures import TrueMaterials
from neurad.tracing.counting import CountingTracer
from neurad.tracing.select import make_tracer


def build_world(
    scene: Scene,
    tracer: str = "embree",
    hide_environment: bool = False,
    fitted: FittedEnvironment | None = None,
    specular_fraction: float = 0.5,
    lights: Emitter | None = None,
    openings: bool = True,
) -> World:
    """Geometry, tracer, lights and BSDF of a scene, on the CPU (``.to(device)`` moves them).

    Args:
        tracer: 'embree', 'open3d' or 'warp'.
        hide_environment: camera rays that miss see black, as in photographs whose alpha is below 1 there.
        fitted: an environment to be recovered, in place of the scene's own.
        openings: find those that light of an environment enters by; False where the caller does.

    Raises:
        InputError: the scene has no light, unknown tracer, or its package is missing.
    """
    geometry = Geometry(scene)
    two_sided = torch.tensor([m.two_sided for m in scene.materials])[geometry.material]
    world = World(
        geometry=geometry,
        tracer=CountingTracer(make_tracer(tracer, geometry.vertices, geometry.faces)),
        lights=make_lights(scene, geometry, fitted) if lights is None else lights,
        bsdf=make_bsdf(scene.features, specular_fraction),
        features=scene.features,
        two_sided=two_sided,
        hide_environment=hide_environment,
        delta=DeltaSurfaces(scene, geometry) if scene.features.has_delta else None,
        flash=None if scene.flash is None else FlashLight(scene.flash),
    )
    if openings:
        draw_by_openings(world, scene)
    return world


def build_radiance(
    scene: Scene, config: RadianceConfig, region: Region | None = None, weighted: bool = False
) -> RadianceField:
    """The radiance field, its units still those of the scene: set ``scale`` once the photographs are known. Its grid
    spans ``region``, by default all triangles; ``weighted`` gives it blending weights.
    """
    region = region or Region(scene.bounds)
    config = region.stretched(config.resolved(scene.features.is_diffuse, scene.features.has_flash))
    return RadianceField(config, torch.from_numpy(region.bounds), contracted=region.contracted, weighted=weighted)


def make_guide(scene: Scene, cells: int, method: Method, region: Region) -> Guide | None:
    """A guide with ``cells`` cells along the longest side of the region; what lies outside shares its outermost cells.

    None for 0 cells, for a method whose samples come without the radiance that arrived, and for a diffuse scene.
    """
    if cells == 0 or not method.estimates_Li or scene.features.is_diffuse:
        return None
    return Guide(torch.from_numpy(region.bounds), cells)


def make_focus(scene: Scene, fraction: float, materials: FittedMaterials | TrueMaterials) -> PixelImportance | None:
    """What draws a fraction of the pixels where they tell of roughness; None where there is none to recover."""
    recovers = isinstance(materials, FittedMaterials) and ROUGHNESS.name in materials.recovered
    return PixelImportance([view.camera for view in scene.train], fraction) if recovers and fraction > 0 else None


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
    focus: PixelImportance | None = None
    """By which a fraction of the pixels is drawn; None where all are drawn without replacement."""
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
    def fitted_model(self) -> ReflectionModel:
        """The model that recovered surfaces have."""
        model = self.scene.features.fitted_model
        if not isinstance(model, PrincipledModel):
            return model
        return replace(model, diffuse="lambert" if float(self.world.lambert) > 0.5 else "burley")

    @property
    def radiance_inputs(self) -> list[str] | None:
        """What the radiance field reads; None without one."""
        return None if self.radiance is None else list(self.radiance.inputs)

    @property
    def hierarchy(self) -> Hierarchy | None:
        """What a roughness refinement finds; None in a run that makes none."""
        if not isinstance(self.materials, FittedMaterials):
            return None
        field = self.materials.recovered.get(ROUGHNESS.name)
        return None if field is None else field.hierarchy

    @property
    def metalness(self) -> Metalness | None:
        """What finds metals; None in a run that does not look for any."""
        return self.materials.metalness if isinstance(self.materials, FittedMaterials) else None

    @property
    def parameters(self) -> tuple[SurfaceParameter, ...]:
        """What the surfaces have as they were found."""
        has_metal = self.metalness is not None and self.metalness.found
        return (*self.scene.parameters, METALLIC) if has_metal else self.scene.parameters

    @property
    def estimator(self) -> Estimator:
        """The method's estimates with these materials and this radiance field."""
        return Estimator(self.world, self.materials, self.radiance, self.settings.method)

    def notes(self) -> list[str]:
        """What is to be said of the scene when a fit begins, a sentence each."""
        scene = self.scene
        said = [*scene.notes, scene.scores_are_of, self.region.sentence(scene)]
        if self.settings.materials == "fit" and scene.replaced:
            said.insert(0, f"to be recovered as principled: {', '.join(scene.replaced)}")
        return [sentence for sentence in said if sentence]

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
    fits: bool = True,
) -> Assembly:
    """Build world, materials and, for a method that reads it, the radiance field, all on the CPU.

    Seeds torch's generator with the run's seed, from which the fields are initialised.

    Args:
        device: where the camera rays are traced that decide how fine a grid must be.
        known_emitters: emitting surfaces keep the albedo and roughness of the scene file, shaded by the fitted model;
            False fits those, too, which only a scene whose every surface emits needs.
        fits: False for what a fit has found: the scene may lack a light that was recovered then.
    """
    torch.manual_seed(settings.seed)
    by_files = {"none": True, "auto": METALLIC in scene.parameters, "fit": False}[settings.metallic.recover]
    finds_metal = settings.materials == "fit" and not by_files and ROUGHNESS in scene.parameters  # else all is diffuse
    if finds_metal:  # no more than of albedo and roughness
        scene = replace(scene, materials=[replace(material, metallic=DIELECTRIC) for material in scene.materials])
    sampling, optimization = settings.sampling, settings.optimization
    environment = unknown_environment(scene, settings.lighting, fits)
    world = build_world(
        scene, settings.tracer, hide_environment, environment, sampling.specular_fraction, openings=False
    )
    if settings.lighting.flash == "fit" and world.flash is not None:
        world.flash.gain.requires_grad_(True)
    elif settings.lighting.flash == "fit" and fits:
        raise InputError(f"scene {scene.name}: model.lighting.flash is fit, but no photograph has a flash")
    lamps = unknown_lamps(scene, world.geometry, settings.lighting, fits)
    if lamps is not None:
        world.lights = make_lights(scene, world.geometry, environment, lamps)
    paths = training_paths(world, scene, device)
    draw_by_openings(world, scene, paths)
    region = training_region(scene, paths)
    if region.contracted:
        for lights in (part for part in world.modules() if isinstance(part, Lights)):
            lights.radius = region.radius  # kinds of lights are chosen by what the region gets of them
    world.guide = make_guide(scene, sampling.guide, settings.method, region)
    # Not counted: these rays train nothing.
    cells = cache(partial(finest_cells, world.tracer.tracer, scene, device, region))
    materials: FittedMaterials | TrueMaterials
    average = None
    if settings.materials == "known":
        materials = TrueMaterials(scene, world.geometry)
    else:
        configs = {p.name: resolve_finest(getattr(settings, p.name), cells) for p in recovered(scene.parameters)}
        looks = settings.diffuse_lobe == "auto" and ROUGHNESS in scene.parameters
        begin = float(world.lambert) if looks else None
        materials = build_materials(scene, configs, world.geometry, region, known_emitters, begin, finds_metal)
        if settings.diffuse_lobe not in ("auto", "files"):
            world.set_lambert(float(settings.diffuse_lobe == "lambert"))
        if optimization.average > 0:
            average = PolyakAverage(materials, optimization.average)
    radiance = None
    if settings.method.needs_field:
        radiance = build_radiance(scene, resolve_finest(settings.radiance, cells), region, settings.method.blends)
    return Assembly(
        scene, settings, world, materials, radiance, average, region, make_focus(scene, sampling.focus, materials),
        FittedDevelopment.of(scene.train, scene.photography),
    )  # fmt: skip
